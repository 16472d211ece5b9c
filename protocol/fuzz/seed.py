"""Seed corpora from tests/vectors/wire_v1.json: protocol/fuzz/corpus/TARGET, robot/fuzz/…, operator/fuzz/…

Usage: python3 protocol/fuzz/seed.py
"""

import hashlib
import json
import pathlib

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


def main():
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
