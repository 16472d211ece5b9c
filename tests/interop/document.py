"""The blocks of docs/protocol.md: bytes by name, and values by name."""

import pathlib
import re

PAGE = pathlib.Path(__file__).resolve().parents[2] / "docs" / "protocol.md"
_BLOCK = re.compile(r"^```(hex|values) ([^\n]+)\n(.*?)^```", re.M | re.S)


def blocks(kind):
    """{name: lines without comments} of all blocks of a kind."""
    out = {}
    for found, name, body in _BLOCK.findall(PAGE.read_text(encoding="utf-8")):
        if found == kind:
            out[name] = [line.split("#")[0].strip() for line in body.splitlines()]
    return out


def example(name):
    """The bytes of a hex block."""
    return bytes.fromhex(" ".join(blocks("hex")[name]))


def numbers(name):
    """{name of a value: its words} of a values block."""
    out = {}
    for line in blocks("values")[name]:
        key, _, value = line.partition("=")
        out[key.strip()] = value.split()
    return out
