"""A component of tests/cli/router/meet.rs: it asks all others until each has answered, and answers them.

meet.py HOST PORT OWN OTHER...      mailboxes as numbers
"""

import sys
import time

from rtnet_packages import NotConnected, Router

ASK, OK = 21, 0
PATIENCE = 30.0

host, port = sys.argv[1], int(sys.argv[2])
own, *others = (int(name, 0) for name in sys.argv[3:])
left = set(others)
with Router(host, port, timeout=30.0) as router:
    mailbox = router.mailbox(own)
    deadline = time.monotonic() + PATIENCE
    while not left or time.monotonic() < deadline:
        try:
            for other in left:
                mailbox.send(other, ASK, b"who")
            while True:
                package = mailbox.receive(timeout=0.05)
                if package is None:
                    break
                if package.kind == ASK:
                    mailbox.reply(package, OK, package.body)
                elif package.kind == OK and package.sender in left:
                    left.discard(package.sender)
                    if not left:
                        print("met", flush=True)
        except NotConnected:
            router.wait_until_connected(1.0)
