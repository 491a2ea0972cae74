"""Begins one TLS session after the other without a certificate, and sends nothing: strangers.py HOST PORT CA"""

import socket
import ssl
import sys
import threading

context = ssl.create_default_context(cafile=sys.argv[3])


def begin() -> None:
    while True:
        try:
            with socket.create_connection((sys.argv[1], int(sys.argv[2]))) as connection:
                context.wrap_socket(connection, server_hostname=sys.argv[1]).close()
        except ConnectionResetError:
            pass


# It ends with the test, at the latest.
threading.Thread(target=begin, daemon=True).start()
print("begins", flush=True)
sys.stdin.read()
