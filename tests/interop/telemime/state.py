"""What is known of the hand (§7): a place, an orientation, and four memories of each."""

import math

from . import rotation
from .codec import I8, I16, I32, I64, U8, Array, Option, Struct, WireError, require, round_away, unzigzag, zigzag

TAU = (0.05, 0.1333, 0.3333, 0.8333)
PLACE, MEMORY, ANGLE, TURN_MEMORY = 1e-4, 25e-6, 1e-4, 25e-6


def _state_ranges(s):
    require(abs(s["t_us"]) <= (2**63 - 1) // 1000, "t_us", s["t_us"])
    require(all(abs(n) <= 1_000_000 for n in s["x"]), "x", s["x"])


def _rotation_range(name):
    return lambda s: require(all(abs(n) <= 31_416 for n in s[name]), name, s[name])


def _turn_ranges(s):
    _rotation_range("q")(s)
    require(all(e <= 10 for e in exponents(s["memory"])), "memory", s["memory"])


def _weights(p):
    require(all(sum(row) <= 15 for row in p["weights"]), "weights", p["weights"])


PARAMS = Struct(("gain", U8), ("inflation", U8), ("weights", Array(Array(U8, 3), 3)), check=_weights)
ROTATION = Array(I16, 3)
MEMORIES = Struct(("exponents", Array(U8, 2)), ("offsets", Array(Array(I8, 3), 4)))
STATE = Struct(("t_us", I64), ("x", Array(I32, 3)), ("memory", MEMORIES), check=_state_ranges)
TURN = Struct(("q", ROTATION), ("memory", MEMORIES), ("params", PARAMS), check=_turn_ranges)
POSE = Struct(("turn", Option(TURN)), ("grip", Option(U8)))


def exponents(memory):
    """Of each of the four, first the high half of a byte."""
    return [half for byte in memory["exponents"] for half in (byte >> 4, byte & 15)]


def remembered(memory, unit):
    """The four vectors, in units of 1."""
    return [[unit * 2.0**e * n for n in row] for e, row in zip(exponents(memory), memory["offsets"])]


def write_params(b, p):
    """Parameters in a motion (§5)."""
    b.bits(int(p["gain"] == 255), 1)
    if p["gain"] != 255:
        b.bits(p["gain"], 8)
    b.bits(p["inflation"], 8)
    for n in sum(p["weights"], []):
        b.bits(n, 4)


def read_params(b):
    gain = 255 if b.bits(1) else b.bits(8)
    return {"gain": gain, "inflation": b.bits(8), "weights": [[b.bits(4) for _ in range(3)] for _ in range(3)]}


def expected(offsets, e, i, axis):
    """What the memory before leads to expect of a component."""
    return max(-127, min(127, 3 * offsets[i - 1][axis] * 2 ** e[i - 1] // 2 ** (e[i] + 1))) if i else 0


def write_memory(b, memory):
    e = exponents(memory)
    b.bits(e[0], 4)
    for last, this in zip(e, e[1:]):
        b.signed(this - last, 0)
    for i, row in enumerate(memory["offsets"]):
        for axis, n in enumerate(row):
            b.signed(n - expected(memory["offsets"], e, i, axis), 4)


def read_memory(b):
    e = [b.bits(4)]
    for _ in range(3):
        e.append(_within("exponent", e[-1] + b.signed(0), 0, 15))
    offsets = []
    for i in range(4):
        offsets.append([])
        for axis in range(3):
            offsets[i].append(_within("memory", expected(offsets, e, i, axis) + b.signed(4), -128, 127))
    return {"exponents": [e[0] << 4 | e[1], e[2] << 4 | e[3]], "offsets": offsets}


def _within(what, n, low, high):
    if not low <= n <= high:
        raise WireError("Malformed", f"{what} {n}")
    return n


def write_state(b, s):
    ticks = zigzag((s["t_us"] + 5) // 10)
    size = next(i for i in range(4) if i == 3 or ticks < 1 << 30 + 8 * i)
    b.bits(size, 2)
    b.bits(ticks, 30 + 8 * size)
    for n in s["x"]:
        b.signed(n, 14)
    write_memory(b, s["memory"])


def read_state(b):
    t_us = 10 * unzigzag(b.bits(30 + 8 * b.bits(2)))
    x = [_within("x", b.signed(14), -(2**31), 2**31 - 1) for _ in range(3)]
    return {"t_us": t_us, "x": x, "memory": read_memory(b)}


def write_turn(b, turn):
    for n in turn["q"]:
        b.bits(n % 2**16, 16)
    write_memory(b, turn["memory"])
    write_params(b, turn["params"])


def read_turn(b):
    q = [(b.bits(16) + 2**15) % 2**16 - 2**15 for _ in range(3)]
    return {"q": q, "memory": read_memory(b), "params": read_params(b)}


class Hand:
    """A hand state in SI units: t in s, x and memories in m."""

    def __init__(self, t, x, memories=None):
        self.t, self.x = t, list(x)
        self.m = memories or [list(x) for _ in TAU]

    @classmethod
    def of_wire(cls, w):
        x = [PLACE * n for n in w["x"]]
        return cls(w["t_us"] * 1e-6, x, [[a - b for a, b in zip(x, way)] for way in remembered(w["memory"], MEMORY)])

    def wire(self):
        """As it travels: for each memory the least exponent for which every component fits."""
        x = [round_away(a / PLACE) for a in self.x]
        steps, rows = [], []
        for m in self.m:
            way = [a - b for a, b in zip(self.x, m)]
            steps.append(next(e for e in range(16) if max(map(abs, way)) <= 127 * MEMORY * 2.0**e))
            rows.append([round_away(d / (MEMORY * 2.0 ** steps[-1])) for d in way])
        packed = [steps[0] << 4 | steps[1], steps[2] << 4 | steps[3]]
        return {"t_us": 10 * round_away(self.t * 1e5), "x": x, "memory": {"exponents": packed, "offsets": rows}}

    def step(self, t):
        """(e, r) of each memory for a next sample at t."""
        dt = max(t - self.t, 1e-4)
        for tau in TAU:
            e = math.exp(-dt / tau)
            yield e, (1 - e) * tau / dt

    def next(self, t, x):
        """After a later sample; one that is not later changes nothing."""
        if not (t > self.t and all(map(math.isfinite, x))):
            return self
        m = [
            [e * a + (1 - q) * new + (q - e) * old for a, new, old in zip(row, x, self.x)]
            for (e, q), row in zip(self.step(t), self.m)
        ]
        return Hand(t, x, m)


class Turn:
    """An orientation with its memories: unit quaternions."""

    def __init__(self, q, memories=None):
        self.q, self.m = q, memories or [q for _ in TAU]

    @classmethod
    def of_wire(cls, w):
        q = rotation.exp([ANGLE * n for n in w["q"]])
        ways = remembered(w["memory"], TURN_MEMORY)
        return cls(q, [rotation.mul(q, rotation.exp([-n for n in way])) for way in ways])

    def next(self, hand, t, q):
        """After a later sample; `hand` is the hand's state before it."""
        m = []
        for (e, r), old in zip(hand.step(t), self.m):
            back = rotation.log(rotation.mul(rotation.inverse(q), old))
            straight = rotation.log(rotation.mul(rotation.inverse(q), self.q))
            m.append(rotation.mul(q, rotation.exp([e * a + (r - e) * b for a, b in zip(back, straight)])))
        return Turn(q, m)
