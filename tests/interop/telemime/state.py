"""What is known of the hand (§7): a place, an orientation, and four memories of each."""

import math

from . import rotation
from .codec import I8, I16, I32, I64, U8, Array, Option, Struct, require, round_away

TAU = (0.05, 0.1333, 0.3333, 0.8333)
PLACE, MEMORY, ANGLE, TURN_MEMORY = 1e-4, 25e-6, 1e-4, 25e-6


def _state_ranges(s):
    require(abs(s["t_us"]) <= (2**63 - 1) // 1000, "t_us", s["t_us"])
    require(all(abs(n) <= 1_000_000 for n in s["x"]), "x", s["x"])
    require(s["memory_exponent"] <= 20, "memory_exponent", s["memory_exponent"])


def _rotation_range(name):
    return lambda s: require(all(abs(n) <= 31_416 for n in s[name]), name, s[name])


def _turn_ranges(s):
    _rotation_range("q")(s)
    require(s["memory_exponent"] <= 10, "memory_exponent", s["memory_exponent"])




def _weights(p):
    require(all(sum(row) <= 255 for row in p["weights"]), "weights", p["weights"])


PARAMS = Struct(("gain", U8), ("inflation", U8), ("weights", Array(Array(U8, 3), 3)), check=_weights)
ROTATION = Array(I16, 3)
STATE = Struct(
    ("t_us", I64), ("x", Array(I32, 3)), ("memory_exponent", U8), ("memory", Array(Array(I8, 3), 4)), check=_state_ranges
)
TURN = Struct(
    ("q", ROTATION), ("memory_exponent", U8), ("memory", Array(Array(I8, 3), 4)), ("params", PARAMS), check=_turn_ranges
)
POSE = Struct(("turn", Option(TURN)), ("grip", Option(U8)))


class Hand:
    """A hand state in SI units: t in s, x and memories in m."""

    def __init__(self, t, x, memories=None):
        self.t, self.x = t, list(x)
        self.m = memories or [list(x) for _ in TAU]

    @classmethod
    def of_wire(cls, w):
        step = MEMORY * 2.0 ** w["memory_exponent"]
        x = [PLACE * n for n in w["x"]]
        return cls(w["t_us"] * 1e-6, x, [[a - step * n for a, n in zip(x, row)] for row in w["memory"]])

    def wire(self):
        """As it travels: the least exponent for which every component fits."""
        x = [round_away(a / PLACE) for a in self.x]
        place = [PLACE * n for n in x]
        apart = [[a - b for a, b in zip(place, m)] for m in self.m]
        for e in range(21):
            rows = [[round_away(d / (MEMORY * 2.0**e)) for d in row] for row in apart]
            if all(abs(n) <= 127 for row in rows for n in row):
                break
        return {"t_us": round_away(self.t * 1e6), "x": x, "memory_exponent": e, "memory": rows}

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
        step = TURN_MEMORY * 2.0 ** w["memory_exponent"]
        q = rotation.exp([ANGLE * n for n in w["q"]])
        return cls(q, [rotation.mul(q, rotation.exp([-step * n for n in row])) for row in w["memory"]])

    def next(self, hand, t, q):
        """After a later sample; `hand` is the hand's state before it."""
        m = []
        for (e, r), old in zip(hand.step(t), self.m):
            back = rotation.log(rotation.mul(rotation.inverse(q), old))
            straight = rotation.log(rotation.mul(rotation.inverse(q), self.q))
            m.append(rotation.mul(q, rotation.exp([e * a + (r - e) * b for a, b in zip(back, straight)])))
        return Turn(q, m)
