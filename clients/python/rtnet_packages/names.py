"""Names of mailboxes: `0.Odometry.1.3` is the number 0x00120103.

    31        24        16         8         0
    +---------+---------+----------+---------+
    | system  | class   | instance | local   |
    +---------+---------+----------+---------+
"""

from typing import Union

#: The class of each name, and its number.
CLASSES = {
    "System": 0x00, "GDOS": 0x01, "GUI": 0x02, "Test": 0x10, "Chassis": 0x11, "Odometry": 0x12, "Position": 0x13, "Ladar": 0x14,
    "Camera": 0x15, "Gps": 0x16, "Joystick": 0x17, "Pilot": 0x18, "Scan2d": 0x19, "Datalog": 0x1A, "ObjRecog": 0x1B,
    "Clock": 0x1C, "Vehicle": 0x1D, "Gyro": 0x1E, "Io": 0x1F, "ServoDrive": 0x20, "Scan3d": 0x21, "Planner": 0x22,
    "FeatureMap": 0x23, "GridMap": 0x24, "Path": 0x25, "Mcl": 0x26, "PtzDrive": 0x27, "Compass": 0x28,
}
_NUMBERS = {name.lower(): number for name, number in CLASSES.items()}
_NAMES = {number: name for name, number in CLASSES.items()}

#: Nobody's name; the router's own where it is asked something.
NOBODY = 0

Name = Union[int, str]


def name(of: Name) -> int:
    """The number of a name: of `0.Pilot.0`, `0.0x18.0.1` or `0x00180000`; a number stays what it is.

    ValueError if it is none.
    """
    if isinstance(of, int):
        if not 0 <= of < 1 << 32:
            raise ValueError(f"{of} is no name: a name has 32 bits")
        return of
    parts = of.split(".")
    if len(parts) == 1:
        return name(_number(of, of, 0xFFFFFFFF))
    if len(parts) not in (3, 4):
        raise ValueError(f"'{of}' is no name: write SYSTEM.CLASS.INSTANCE, as in 0.Pilot.0, or SYSTEM.CLASS.INSTANCE.LOCAL")
    system, kind, instance = parts[:3]
    number = _NUMBERS.get(kind.lower())
    if number is None:
        number = _number(of, kind, 0xFF)
    local = parts[3] if len(parts) == 4 else "0"
    return _number(of, system, 0xFF) << 24 | number << 16 | _number(of, instance, 0xFF) << 8 | _number(of, local, 0xFF)


def priority_of(sender: int) -> int:
    """The priority of a mailbox's packages where none is given: 255 for the classes 0 to 15, and 8 less for each 16 further."""
    return 255 - 8 * (sender >> 20 & 0xF)


def _number(of: str, text: str, most: int) -> int:
    try:
        number = int(text, 16) if text.lower().startswith("0x") else int(text)
    except ValueError:
        raise ValueError(f"'{of}' is no name: '{text}' is no number from 0 to {most}, and no class") from None
    if not 0 <= number <= most:
        raise ValueError(f"'{of}' is no name: {text} is not from 0 to {most}")
    return number


def shown(number: int) -> str:
    """A name as people read it: `Odometry(0/1).3`."""
    system, kind, instance, local = number.to_bytes(4, "big")
    called = _NAMES.get(kind, f"{kind:#04x}")
    return f"{called}({system}/{instance})" + (f".{local}" if local else "")
