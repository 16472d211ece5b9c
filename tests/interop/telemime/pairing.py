"""Pairing (§14): its messages, and the code that both users compare."""

import hashlib
import re

from .codec import WireError

MAGIC = b"TLMP"
NAME = re.compile(rb"[A-Za-z0-9._-]{1,64}\Z")
NAMED, NONCE, BARE = {1: "Offer", 2: "Commit"}, {3: "Nonce", 4: "Reveal"}, {5: "Confirm", 6: "Stored"}
KINDS = {name: kind for kind, name in {**NAMED, **NONCE, **BARE, 7: "Abort"}.items()}


def _short(text):
    return bytes([len(text)]) + text


def encode(message):
    """The bytes of a message: {name: fields}, or the name alone."""
    name, fields = (message, {}) if isinstance(message, str) else next(iter(message.items()))
    kind = KINDS[name]
    out = MAGIC + bytes([kind])
    if name == "Abort":
        return out + fields["code"].to_bytes(2, "little") + _short(fields["text"].encode())
    out += fields.get("commitment", b"") + fields.get("nonce", b"")
    return out + _short(fields["name"].encode()) if kind in NAMED else out


def parse(data):
    """(message, number of bytes) from the beginning of a stream, or None while it is not complete."""
    if data[:4] != MAGIC[: len(data)]:
        raise WireError("Magic", "another protocol")
    if len(data) < 5:
        return None
    kind, at, fields = data[4], 5, {}
    if kind not in KINDS.values():
        raise WireError("Kind", f"message of kind {kind}")
    if kind in BARE:
        return BARE[kind], at
    if kind in (2, 3, 4):
        if len(data) < at + 32:
            return None
        fields["commitment" if kind == 2 else "nonce"] = bytes(data[at : at + 32])
        at += 32
    if kind in NONCE:
        return {NONCE[kind]: fields}, at
    if kind == 7:
        if len(data) < at + 2:
            return None
        fields["code"] = int.from_bytes(data[at : at + 2], "little")
        at += 2
    if len(data) < at + 1:
        return None
    if kind in NAMED and data[at] > 64:
        raise WireError("Name", f"a name of {data[at]} bytes")
    if len(data) < at + 1 + data[at]:
        return None
    text, at = bytes(data[at + 1 : at + 1 + data[at]]), at + 1 + data[at]
    if kind == 7:
        try:
            return {"Abort": {**fields, "text": text.decode("utf-8")}}, at
        except UnicodeDecodeError as e:
            raise WireError("Text", f"not UTF-8: {e}") from None
    if not NAME.match(text):
        raise WireError("Name", f"name {text!r}")
    return {NAMED[kind]: {**fields, "name": text.decode("ascii")}}, at


def commitment(robot_nonce):
    return hashlib.sha256(b"telemime-pair/1 commitment" + robot_nonce).digest()


def code(exporter, operator, robot, operator_nonce, robot_nonce):
    """What both ends show."""
    digest = hashlib.sha256(
        b"telemime-pair/1 code" + exporter + operator + robot + operator_nonce + robot_nonce
    ).digest()
    digits = f"{int.from_bytes(digest[:8], 'big') % 10**8:08}"
    return f"{digits[:4]} {digits[4:]}"
