"""Begins one TLS session after the other without a certificate, and sends nothing: strangers.py HOST PORT CA"""

import socket
import ssl
import sys

context = ssl.create_default_context(cafile=sys.argv[3])
print("begins", flush=True)
while True:
    try:
        with socket.create_connection((sys.argv[1], int(sys.argv[2]))) as connection:
            context.wrap_socket(connection, server_hostname=sys.argv[1]).close()
    except OSError:
        pass
