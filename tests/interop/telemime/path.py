"""The hand's path between knots (§8)."""

import math

from .codec import require, round_away

TICK = 1e-5


class Grid:
    """Steps that follow from a path bound."""

    def __init__(self, path_bound_um):
        n = math.floor(path_bound_um * 1e-6 / 4e-9 * (1 + 1e-9))
        require(1 <= n < 2**32, "path bound", path_bound_um)
        self.step = n * 1e-9
        self.speed_step = 16 * self.step


def knots(message, grid):
    """The knots of a `Motion` or `Path`: (tick, position in steps, tangent in steps, start)."""
    s = message["state"]
    tick = (s["t_us"] + 5) // 10
    at = [round_away(1e-4 * n / grid.step) for n in s["x"]]
    out = []
    for i, k in enumerate(message["knots"]):
        tick += k["dt"] // 2 if i else -(k["dt"] // 2)
        at = [a + d for a, d in zip(at, k["dx"])]
        require(all(abs(n) <= 1 << 30 for n in at + k["v"]), "knot", at + k["v"])
        out.append((tick, at, k["v"], bool(k["dt"] & 1)))
    return out


def evaluate(before, after, grid, t):
    """(x, v) at session time t (s) between two joined knots."""
    t0, t1 = before[0] * TICK, after[0] * TICK
    h = t1 - t0
    u = (t - t0) / h
    x, v = [], []
    for x0, x1, v0, v1 in zip(before[1], after[1], before[2], after[2]):
        x0, x1, v0, v1 = x0 * grid.step, x1 * grid.step, v0 * grid.speed_step, v1 * grid.speed_step
        c = (x1 - x0) / h
        b, a = 3 * c - 2 * v0 - v1, v0 + v1 - 2 * c
        x.append(x0 + h * (v0 * u + b * u * u + a * u**3))
        v.append(v0 + 2 * b * u + 3 * a * u * u)
    return x, v


def encode(state, knots, grid):
    """The `knots` of a message with this state: each (tick, position in steps, tangent in steps, start)."""
    tick = (state["t_us"] + 5) // 10
    at = [round_away(1e-4 * n / grid.step) for n in state["x"]]
    out = []
    for i, (t, x, v, start) in enumerate(knots):
        gap = t - tick if i else tick - t
        out.append({"dt": 2 * gap + start, "dx": [a - b for a, b in zip(x, at)], "v": list(v)})
        tick, at = t, x
    return out
