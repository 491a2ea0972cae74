"""Bytes: what real peers were seen to send, and what is no package."""

import random
import unittest
from typing import List

from rtnet_packages import LONGEST, Package, ProtocolError, name, shown
from rtnet_packages.wire import HEAD, Decoder, control

SEEN = {
    "03000000 00000000 00000000 10000000": control(0),
    "01154d2a 00021000 00011000 15000000 68656c6c6f": Package(0x00100200, 0x00100100, 21, b"hello", 77, 42, False),
    "03fd052b 00011000 00631000 10000000": Package(0x00100100, 0x00106300, -3, b"", 5, 43),
    "03840100 00000100 00001100 1b000000 4d6f64756c65206f6e0a00": Package(0x00010000, 0x00110000, -124, b"Module on\n\0", 1),
}


class Wire(unittest.TestCase):
    def test_bytes_are_those_seen_between_real_peers(self) -> None:
        for text, package in SEEN.items():
            data = bytes.fromhex(text)
            self.assertEqual(Decoder().feed(data), [package])
            if package.little:
                self.assertEqual(package.encode(), data)

    def test_big_endian_heads_are_read(self) -> None:
        data = bytes.fromhex("00154d2a 00100200 00100100 00000015 68656c6c6f")
        self.assertEqual(Decoder().feed(data), [Package(0x00100200, 0x00100100, 21, b"hello", 77, 42, False)])

    def test_packages_are_the_same_however_their_bytes_come(self) -> None:
        packages = [Package(1, 2, kind, bytes(length)) for kind, length in [(1, 0), (-6, 5), (127, 300), (-128, 4096)]]
        data = b"".join(package.encode() for package in packages)
        chance = random.Random(7)
        for _ in range(200):
            decoder, at, seen = Decoder(), 0, []  # type: Decoder, int, List[Package]
            while at < len(data):
                piece = chance.randint(1, 40)
                seen += decoder.feed(data[at : at + piece])
                at += piece
            self.assertEqual(seen, packages)

    def test_lengths_that_no_package_has_end_the_connection(self) -> None:
        self.assertEqual(len(Decoder().feed(Package(1, 2, 3, bytes(LONGEST - HEAD)).encode())), 1)
        for length in [0, 15, LONGEST + 1, 2**32 - 1]:
            with self.assertRaises(ProtocolError):
                Decoder().feed(Package(1, 2, 3).encode()[:12] + length.to_bytes(4, "little"))
        with self.assertRaises(ValueError):
            Package(1, 2, 3, bytes(LONGEST)).encode()
        for wrong in [Package(1, 2, 128), Package(-1, 2, 0), Package(1, 2, 0, priority=256), Package(1, 2, 0, id=-1)]:
            with self.assertRaises(ValueError):
                wrong.encode()


class Names(unittest.TestCase):
    def test_a_name_is_written_in_several_ways(self) -> None:
        for of in ["0.Odometry.1.3", "0.odometry.1.3", "0.0x12.1.3", "0x00120103", "0.18.1.3"]:
            self.assertEqual(name(of), 0x00120103)
        self.assertEqual(name(0x00120103), 0x00120103)
        self.assertEqual((shown(0x00120103), shown(0x01800000)), ("Odometry(0/1).3", "0x80(1/0)"))

    def test_what_is_no_name_is_refused_with_what_is_wrong(self) -> None:
        for of, what in [("0.Nobody.1", "Nobody"), ("256.Pilot.0", "256"), ("Pilot", "Pilot"), ("0.Pilot", "SYSTEM"), ("1.2.3.4.5", "SYSTEM")]:
            with self.assertRaisesRegex(ValueError, what):
                name(of)
        for number in [-1, 2**32]:
            with self.assertRaises(ValueError):
                name(number)


if __name__ == "__main__":
    unittest.main()
