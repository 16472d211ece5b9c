"""A skill (§10): encoding, checks, id, and its file."""

import hashlib
import math

from .codec import (F32, F64, I8, I32, U8, U32, U64, Array, Option, Struct, Text, Vec, WireError, decode, encode, finite, require)

LONGEST = 524_288
COMPONENTS, KNOTS, FEATURES = 64, 24, 15


def _positive_definite(packed, n):
    """Whether the symmetric matrix of this lower triangle, row by row, has a Cholesky factor."""
    low = []
    entries = iter(packed)
    for i in range(n):
        row = []
        for j in range(i + 1):
            s = next(entries) - sum(a * b for a, b in zip(row, low[j] if j < i else row))
            if j == i and not s > 0:
                return False
            row.append(math.sqrt(s) if j == i else s / low[j][j])
        low.append(row)
    return True


def _mixture(n):
    def check(components):
        for c in components:
            finite("mixture", [v for v in c.values() if not isinstance(v, list)], *[v for v in c.values() if isinstance(v, list)])
            require(0 < c["weight"] <= 1, "weight", c["weight"])
            require(_positive_definite(c["covariance"], n), "covariance", c["covariance"])
        total = sum(c["weight"] for c in components)
        require(abs(total - 1) <= 1e-6, "weights", total)

    return check


def _unit(q, what):
    finite(what, q)
    require(abs(math.sqrt(sum(c * c for c in q)) - 1) <= 5e-7, what, q)


class Mixture(Vec):
    """1 to 64 components and what must hold of all of them together."""

    def __init__(self, item, n):
        super().__init__(item, COMPONENTS, 1)
        self.together = _mixture(n)

    def check(self, values):
        super().check(values)
        self.together(values)


def _gaussian(n):
    return Struct(("weight", F64), ("mean", Array(F64, n)), ("covariance", Array(F64, n * (n + 1) // 2)))


MOTION = Mixture(_gaussian(4), 4)
COMPONENT = Struct(
    ("weight", F32), ("mean", Array(I32, FEATURES)), ("factor", Vec(I32, 120, 120)), ("target", Vec(I32, 3 * KNOTS)),
    ("gain", Vec(I32, FEATURES * 3 * KNOTS)), ("residual", Vec(I32, 6 * KNOTS)))  # fmt: skip


def _predictor(p):
    j = len(p["covariance"])
    finite("predictor", *(p[k] for k in ("mean", "scale", "bend", "training", "covariance", "errors", "novelty90", "lead", "products")))
    for name in ("scale", "covariance"):
        require(all(v > 0 for v in p[name]), name, p[name])
    require(all(v > 0 for row in p["errors"] for v in row), "errors", p["errors"])
    require(all(p["products"][i * (i + 3) // 2] > 0 for i in range(4)), "products", p["products"])
    require(all(v >= 0 for v in p["bend"] + p["training"]), "bend, training", p["bend"] + p["training"])
    require(p["novelty90"] > 0, "novelty90", p["novelty90"])
    require(all(len(p[name]) == j for name in ("errors", "lead", "exponents")), "lengths", j)
    require(all(-40 <= e <= 20 for e in p["exponents"]), "exponents", p["exponents"])
    for c in p["components"]:
        require(math.isfinite(c["weight"]) and c["weight"] > 0, "weight", c["weight"])
        require(all(c["factor"][i * (i + 3) // 2] > 0 for i in range(FEATURES)), "factor", "diagonal")
        sizes = {"target": 3 * j, "gain": FEATURES * 3 * j, "residual": 6 * j}
        for name, n in sizes.items():
            require(len(c[name]) == n, name, len(c[name]))
        for axis in (0, 3, 5):
            require(all(w >= 0 for w in running(c["residual"][axis * j : (axis + 1) * j])), "residual", axis)


PREDICTOR = Struct(
    ("mean", Array(F32, FEATURES)), ("scale", Array(F32, FEATURES)), ("bend", Array(F32, 2)), ("training", Array(F32, 2)),
    ("covariance", Vec(F32, KNOTS, 1)),
    ("errors", Vec(Array(F32, 4), KNOTS, 1)), ("novelty90", F32), ("lead", Vec(Array(F32, 4), KNOTS, 1)),
    ("products", Array(F32, 10)), ("exponents", Vec(I8, KNOTS, 1)),
    ("components", Vec(COMPONENT, COMPONENTS, 1)), check=_predictor)  # fmt: skip


def _turn(t):
    for c in t["motion"]:
        _unit(c["chart"], "chart")
    for c in t["charts"]:
        _unit(c, "chart")
    require(len(t["charts"]) == len(t["predictor"]["components"]), "charts", len(t["charts"]))


TURN = Struct(
    ("motion", Mixture(Struct(("weight", F64), ("t_s", F64), ("chart", Array(F64, 4)), ("covariance", Array(F64, 10))), 4)),
    ("predictor", PREDICTOR), ("charts", Vec(Array(F32, 4), COMPONENTS, 1)), check=_turn)  # fmt: skip


def _frame(f):
    finite("origin", f["origin"])
    _unit(f["turn"], "turn")


FRAME = Struct(
    ("name", Text(64, 1)), ("origin", Array(F64, 3)), ("turn", Array(F64, 4)), ("motion", MOTION), check=_frame)  # fmt: skip
STATS = Struct(
    ("speed", F64), ("accel", F64), ("reach", F64), ("lower", Array(F64, 3)), ("upper", Array(F64, 3)))  # fmt: skip


def _skill(s):
    finite("skill", s["duration_s"], s["pace"], *s["stats"].values())
    require(0 < s["duration_s"] <= 3600, "duration_s", s["duration_s"])
    require(s["pace"][1] > 0, "pace", s["pace"])
    names = [f["name"] for f in s["task"] or []]
    require(len(set(names)) == len(names), "task", names)
    for name in ("speed", "accel", "reach"):
        require(s["stats"][name] >= 0, name, s["stats"][name])
    require(all(a <= b for a, b in zip(s["stats"]["lower"], s["stats"]["upper"])), "box", s["stats"])
    require(all(n >= 1 for n in s["samples"]), "samples", s["samples"])


SKILL = Struct(
    ("name", Text(64, 1)), ("duration_s", F64), ("pace", Array(F64, 2)), ("motion", MOTION), ("predictor", PREDICTOR),
    ("turn", Option(TURN)), ("grip", Option(Mixture(_gaussian(2), 2))), ("task", Option(Vec(FRAME, 8, 1))), ("stats", STATS),
    ("samples", Array(U32, 2)),
    ("provenance", Struct(
        ("producer", Text(64)), ("seed", U64),
        ("sources", Vec(Struct(("name", Text(128)), ("sha256", Array(U8, 32))), 256)))),
    check=_skill)  # fmt: skip


def running(differences):
    """What a row of first differences stands for."""
    w, out = 0, []
    for n in differences:
        w += n
        out.append(w)
    return out


def values(second_differences, exponents):
    """What a row of second differences stands for: v_j · 2^e_j."""
    return [math.ldexp(float(v), e) for v, e in zip(running(running(second_differences)), exponents)]


def read(data):
    """The skill of these bytes."""
    return decode(SKILL, data, LONGEST)


def write(skill):
    """Its bytes."""
    return encode(SKILL, skill)


def identity(data):
    """(id, tag): the head of the SHA-256, and its first two bytes as `Motion` carries them, of which 0 is 1."""
    head = hashlib.sha256(data).digest()[:16]
    return head, max(1, int.from_bytes(head[:2], "little"))


def read_file(data):
    """The encoding inside a skill file."""
    body, digest = data[:-32], data[-32:]
    if hashlib.sha256(body).digest() != digest:
        raise WireError("Malformed", "the file's digest differs")
    line, _, encoding = body.partition(b"\n")
    if not line.startswith(b"telemime skill, format 1; "):
        raise WireError("Malformed", "not a skill file")
    return encoding
