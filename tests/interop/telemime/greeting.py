"""The greeting of §2: frozen layout, negotiation."""

import struct

from .codec import WireError

MAGIC = b"TLMM"
LONGEST = 263


def hello(lowest, highest, features=0):
    """`Hello`: the versions the operator speaks."""
    return MAGIC + struct.pack("<BHHQ", 1, lowest, highest, features)


def hello_ack(version, epoch, features=0):
    """`HelloAck`: what the robot chose."""
    return MAGIC + struct.pack("<BHQI", 2, version, features, epoch)


def reject(code, text):
    """`Reject`: why the robot declines."""
    data = text.encode("utf-8")
    return MAGIC + struct.pack("<BHB", 3, code, len(data)) + data


OPERATOR, ROBOT = (1,), (2, 3)


def parse(data, kinds=ROBOT):
    """(greeting, number of bytes) from the beginning of a stream, or None while it is not complete. `kinds`: who sent it."""
    if data[:4] != MAGIC[: len(data)]:
        raise WireError("Magic", "another protocol")
    if len(data) < 5:
        return None
    kind = data[4]
    if kind not in kinds:
        raise WireError("Kind", f"greeting of kind {kind}")
    if kind == 3:
        if len(data) < 8:
            return None
        (code, n) = struct.unpack_from("<HB", data, 5)
        if len(data) < 8 + n:
            return None
        try:
            return {"Reject": {"code": code, "text": data[8 : 8 + n].decode("utf-8")}}, 8 + n
        except UnicodeDecodeError as e:
            raise WireError("Text", f"not UTF-8: {e}") from None
    layout = {1: ("Hello", "<HHQ", ("min", "max", "features")), 2: ("HelloAck", "<HQI", ("version", "features", "epoch"))}
    name, code, fields = layout[kind]
    end = 5 + struct.calcsize(code)
    if len(data) < end:
        return None
    value = dict(zip(fields, struct.unpack_from(code, data, 5)))
    if name == "Hello" and value["min"] > value["max"]:
        raise WireError("Range", f"versions {value['min']} to {value['max']}")
    return {name: value}, end


def negotiate(ours, theirs):
    """The version for two ranges (lowest, highest): the lower of the two maxima, if both know it; else None."""
    version = min(ours[1], theirs[1])
    return version if version >= max(ours[0], theirs[0]) else None
