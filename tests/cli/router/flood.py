"""A client of tests/cli/router/restarts.rs: it sends numbers to a mailbox until its standard input ends, answers questions, and receives
numbers, each larger than the one before. Then it says, again and again, how many packages were taken, were lost of these, were not passed on,
and are unconfirmed; and how many numbers came, and how many of those were not larger.

flood.py HOST PORT OWN TO      mailboxes as numbers
"""

import struct
import sys
import threading
import time

from rtnet_packages import NotConnected, Router

ASK, DATA, OK = 21, -6, 0
SENDS_EVERY = 0.002

host, port = sys.argv[1], int(sys.argv[2])
own, to = (int(name, 0) for name in sys.argv[3:])
is_over = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), is_over.set()), daemon=True).start()
with Router(host, port, timeout=30.0) as router:
    mailbox, taken, shown = router.mailbox(own), 0, 0.0
    came, again, newest = 0, 0, 0
    while True:
        try:
            package = mailbox.receive(timeout=SENDS_EVERY)
            if package is not None and package.kind == ASK:
                mailbox.reply(package, OK, package.body)
            if package is not None and package.kind == DATA:
                number = struct.unpack("<Q", package.body)[0]
                came, again, newest = came + 1, again + (number <= newest), number
            if not is_over.is_set():
                mailbox.send(to, DATA, struct.pack("<Q", taken))
                taken += 1
        except NotConnected:
            # It was not taken.
            pass
        if is_over.is_set() and time.monotonic() > shown + 0.1:
            shown = time.monotonic()
            print(taken, 0, sum(router.lost_at_router.values()), router.unconfirmed, came, again, flush=True)
