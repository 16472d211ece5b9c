"""Frames on the control stream (§4)."""

from .codec import WireError

LONGEST = 525_312
IGNORABLE = 1 << 31


def frame(payload, ignorable=False):
    """Header and payload."""
    if len(payload) > LONGEST:
        raise WireError("TooLong", f"{len(payload)} bytes in a frame")
    return (len(payload) | (IGNORABLE if ignorable else 0)).to_bytes(4, "little") + payload


def parse(data):
    """(payload, ignorable, number of bytes) of the first frame, or None while it is not complete."""
    if len(data) < 4:
        return None
    header = int.from_bytes(data[:4], "little")
    n = header & ~IGNORABLE
    if n > LONGEST:
        raise WireError("TooLong", f"a frame of {n} bytes")
    if len(data) < 4 + n:
        return None
    return bytes(data[4 : 4 + n]), bool(header & IGNORABLE), 4 + n
