"""Seed corpora from tests/vectors/wire_v1.json: protocol/fuzz/corpus/TARGET, robot/fuzz/…, operator/fuzz/…

Usage: python3 protocol/fuzz/seed.py
"""

import hashlib
import json
import pathlib
import struct
import zlib

ROOT = pathlib.Path(__file__).resolve().parents[2]
MESSAGES = {
    "operator control": 0, "robot control": 1, "operator datagram": 2, "robot datagram": 3, "constant velocity": 2,
    "operator greeting": 5, "robot greeting": 6, "frame": 7}  # fmt: skip


def put(crate, target, data):
    folder = ROOT / crate / "fuzz" / "corpus" / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)


def raw(tag, data):
    """An operation of the sessions' targets that hands over bytes as they are."""
    return bytes([tag]) + len(data).to_bytes(2, "little") + data


PAIRING = [
    b"TLMP\1\6laptop", b"TLMP\2" + bytes(range(32)) + b"\3arm", b"TLMP\3" + bytes(32), b"TLMP\4" + bytes(32), b"TLMP\5", b"TLMP\6",
    b"TLMP\7\4\0\2no"]  # fmt: skip
TRACKER = [
    '{"t":1.5,"x":0.1,"y":-0.2,"z":2.0,"engage":true}', '{"x":1,"y":2,"z":3,"qw":1,"qx":0,"qy":0,"qz":0,"grip":0.5}',
    '{"joints":{"RightHand":[1,2,3],"head":{"x":1,"y":2,"z":3}}}', '{"joints":{"right_hand":[1,2,3,1,0,0,0]},"t":0}',
    '{"engage":false}', '{"x":NaN}', '{"joints":{"right_hand":null}}']  # fmt: skip
PAGE = [
    {"do": "hold", "what": "play", "skill": "wave", "t": 1, "x": [0, 0, 1]}, {"do": "hold", "what": "hand", "t": 1, "x": [0.1, 0, 1]},
    {"do": "hand", "t": 20.5, "x": [0, 0.5, 1]}, {"do": "alive"}, {"do": "release"}, {"do": "stop"}, {"do": "reset"},
    {"do": "predict", "gain": 0.5}, {"do": "discard"}, {"do": "learn", "name": "wave"}, {"do": "use", "skill": "wave"},
    {"do": "link", "delay_ms": 100, "jitter_ms": 20, "loss_percent": 1}]  # fmt: skip
HOME = [0.0] * 7


def driver():
    """Lines of a driver, before each but the first a byte of time."""
    names = [f"joint{i}" for i in range(1, 8)]
    yield json.dumps({"telemime_driver": 1, "joints": names, "rate_hz": 250.0}).encode()
    for i in range(12):
        yield b"\4" + json.dumps({"q": HOME, "qd": HOME, "seq": 4 * i, "opening": 0.5}).encode()
    yield b"\4" + b'{"fault":"too hot"}'


def hand(width, height):
    """Rows of depth: a body at 2 m, and a hand before it."""
    for v in range(height):
        yield [900 if 24 <= u < 30 and 10 <= v < 16 else 2000 if 6 <= u < 28 else 0 for u in range(width)]


def png(width, height):
    """The same as a PNG of 16 bits a pixel."""
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + struct.pack(f">{width}H", *row) for row in hand(width, height))
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def of_text():
    """Seeds of what is no message of the protocol's versions."""
    for message in PAIRING:
        put("protocol", "pair", message)
    put("protocol", "pair", b"".join(PAIRING))
    # Version 2's Pong.
    put("protocol", "messages", b"\4" + bytes.fromhex("02 07 fc 00 95 ba 0a fc 80 8d 5b 00 05"))
    for line in TRACKER:
        put("operator", "input", b"\0" + line.encode())
    put("operator", "input", b"\0" + "\n".join(TRACKER).encode())
    for command in PAGE:
        put("operator", "console", json.dumps(command).encode())
    put("operator", "depth", b"\0" + png(40, 32))
    put("operator", "depth", b"\1" + b"".join(struct.pack("<40H", *row) for row in hand(40, 32)) * 2)
    put("robot", "driver", b"\n".join(driver()))
    # A whole record with a byte changed here and there, near its beginning and in its rows.
    for at in (0, 40, 20_000, 60_000):
        put("robot", "blackbox", b"\2" + struct.pack("<I", at | 1 << 24))
    put("robot", "blackbox", b"\2")


def main():
    of_text()
    vectors = json.loads((ROOT / "tests/vectors/wire_v1.json").read_text(encoding="utf-8"))["vectors"]
    of_kind = {}
    for v in vectors:
        data, kind = bytes.fromhex(v["hex"]), v["kind"]
        of_kind.setdefault(kind, []).append(data)
        if kind in MESSAGES:
            put("protocol", "messages", bytes([MESSAGES[kind]]) + data)
        if kind == "operator datagram":
            put("protocol", "messages", b"\4" + data)
        if kind in ("plan", "skill"):
            put("protocol", kind, data)
    # A session of each end: the clock becomes known, the arm is driven, and everything else is thrown in.
    known = bytes([3, 1, 0, 20]) * 8
    for i, data in enumerate(of_kind["operator control"] + of_kind["operator datagram"] + of_kind["constant velocity"]):
        tag = 1 if data in of_kind["operator control"] else 2
        if len(data) < 60_000:
            put("robot", "session", known + bytes([4, 1, 10, 3, 0, 30, 5, 9, 9, 9, 200, 0, 30]) + raw(tag, data) + bytes([0, i]))
    for data in of_kind["robot control"] + of_kind["robot datagram"]:
        tag = 1 if data in of_kind["robot control"] else 2
        put("operator", "session", bytes([5, 1, 0, 5, 1, 1, 3, 9, 9, 9, 4, 0, 4, 6, 1, 5, 2, 2, 1, 0, 30, 3, 8, 9, 9]) + raw(tag, data) + bytes([3, 5, 5, 5, 0, 90]))


if __name__ == "__main__":
    main()
