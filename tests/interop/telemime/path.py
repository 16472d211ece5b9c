"""The hand's path between knots, and knots as bits (§8)."""

import math

from .bits import BitReader, BitWriter
from .codec import require, round_away, zigzag

TICK, TICK_NS = 1e-5, 10_000
FAR = 1 << 30
MEMORY = 8


class Grid:
    """Steps that follow from an engagement's path bounds, and the interval of its samples (µs)."""

    def __init__(self, path_bound_um, sample_us, path_turn_bound_urad=0):
        n = math.floor(path_bound_um * 1e-6 / 2e-9 * (1 + 1e-9))
        require(1 <= n < 2**32, "path bound", path_bound_um)
        self.step = n * 1e-9
        self.steps = [self.step] * 3
        if path_turn_bound_urad:
            self.steps += [250 * path_turn_bound_urad * 1e-9] * 4
        self.dims = len(self.steps)
        self.sample_us = sample_us

    def samples(self, dt):
        """The number of samples nearest to so many ticks."""
        return (20 * dt + self.sample_us) // (2 * self.sample_us)

    def ticks(self, samples):
        return (samples * self.sample_us + 5) // 10


class Column:
    """The order of a code, from what it coded before."""

    def __init__(self, total, count):
        self.total, self.count = total, count

    def order(self):
        return next((k for k in range(31) if 4 * self.count << k >= 3 * self.total), 31)

    def learn(self, n):
        self.total, self.count = self.total + n, self.count + 1
        if self.count == 32:
            self.total, self.count = self.total // 2, self.count // 2


def shift(dt):
    """s: tangents at the end of a span of dt ticks are multiples of 2^s."""
    return max(1, 100_000 // dt).bit_length() - 1


def clamp(n, limit):
    return max(-limit, min(limit, n))


class Knot:
    """A knot: tick, position and tangent in steps, and whether it is joined to the one before."""

    def __init__(self, tick, x, v, start):
        self.tick, self.x, self.v, self.start = tick, list(x), list(v), bool(start)

    def plain(self):
        return [self.tick, self.x, self.v, self.start]


class _Code:
    """What both directions share: columns, and what is expected of a joined knot."""

    def __init__(self, grid, before):
        self.grid, self.columns = grid, [Column(8, 2), Column(0, 2)]
        # Position and tangent; those of an orientation.
        self.columns += [Column(72, 6), Column(36, 6), Column(72, 6), Column(36, 6)]
        before = before[-MEMORY:]
        for a, b in zip(before, before[1:]):
            if not b.start:
                self.learn(*self.difference(a, b))

    def orders(self):
        """Of samples and jitter; of each position, and of each tangent."""
        a, b, c, d, e, f = (c.order() for c in self.columns)
        return a, b, [c] * 3 + [e] * 4, [d] * 3 + [f] * 4

    def learn(self, n, late, dx, dv):
        dx, dv = [zigzag(n) for n in dx], [zigzag(n) for n in dv]
        for column, numbers in zip(self.columns, ([n], [zigzag(late)], dx[:3], dv[:3], dx[3:], dv[3:])):
            for number in numbers:
                column.learn(number)

    def place(self, a, dt):
        return [clamp(x + (v * dt + 10_000) // 20_000, FAR) for x, v in zip(a.x, a.v)]

    def tangent(self, a, x, dt):
        unit = 1 << shift(dt)
        limit = FAR >> shift(dt)
        return [clamp((25_000 * (new - old) + dt * unit) // (2 * dt * unit), limit) for new, old in zip(x, a.x)]

    def difference(self, a, b):
        """The numbers that a joined knot b after a is written with."""
        dt = b.tick - a.tick
        n = self.grid.samples(dt)
        dx = [x - e for x, e in zip(b.x, self.place(a, dt))]
        dv = [(v >> shift(dt)) - e for v, e in zip(b.v, self.tangent(a, b.x, dt))]
        return n + 1, dt - self.grid.ticks(n), dx, dv


def _origin(state, grid):
    return (state["t_us"] + 5) // 10, [round_away(1e-4 * n / grid.step) for n in state["x"]] + [0] * (grid.dims - 3)


def count(data):
    """How many knots a block claims to hold."""
    return BitReader(data).golomb(0) + 1 if data else 0


def decode(state, data, grid, before=()):
    """The knots of a block after those `before` it. Raises WireError: then nothing of it counts."""
    if not data:
        return []
    tick, origin = _origin(state, grid)
    known, code, r = list(before), _Code(grid, list(before)), BitReader(data)
    for _ in range(r.golomb(0) + 1):
        a, b, c, d = code.orders()
        n = r.golomb(a) if known else 0
        if n == 0:
            gap = r.golomb(12)
            require(gap < 1 << 31, "ticks", gap)
            at, last = (known[-1].x, known[-1].tick + gap + 1) if known else (origin, tick - gap)
            x = [e + r.signed(6) for e in at]
            knot = Knot(last, x, [2 * r.signed(4) for _ in at], True)
        else:
            last = known[-1]
            late = r.signed(b)
            dt = grid.ticks(n - 1) + late
            require(1 <= dt < 1 << 31 and grid.samples(dt) == n - 1, "dt", dt)
            dx = [r.signed(k) for _, k in zip(last.x, c)]
            x = [e + o for e, o in zip(code.place(last, dt), dx)]
            dv = [r.signed(k) for _, k in zip(last.x, d)]
            v = [(e + o) << shift(dt) for e, o in zip(code.tangent(last, x, dt), dv)]
            knot = Knot(last.tick + dt, x, v, False)
            code.learn(n, late, dx, dv)
        require(all(abs(n) <= FAR for n in knot.x + knot.v), "knot", knot.plain())
        known.append(knot)
    r.end()
    return known[len(before) :]


def encode(state, knots, grid, before=()):
    """The block of knots after those `before`."""
    if not knots:
        return b""
    tick, origin = _origin(state, grid)
    known, code, w = list(before), _Code(grid, list(before)), BitWriter()
    w.golomb(len(knots) - 1, 0)
    for knot in knots:
        a, b, c, d = code.orders()
        if knot.start:
            if known:
                w.golomb(0, a)
            at, gap = (known[-1].x, knot.tick - known[-1].tick - 1) if known else (origin, tick - knot.tick)
            w.golomb(gap, 12)
            for x, e in zip(knot.x, at):
                w.signed(x - e, 6)
            for v in knot.v:
                w.signed(v // 2, 4)
        else:
            n, late, dx, dv = code.difference(known[-1], knot)
            w.golomb(n, a)
            w.signed(late, b)
            for n_x, k in zip(dx, c):
                w.signed(n_x, k)
            for n_v, k in zip(dv, d):
                w.signed(n_v, k)
            code.learn(n, late, dx, dv)
        known.append(knot)
    return w.bytes()


def quantise(grid, t, x, v, before=None):
    """The knot nearest to a place and a velocity at session time t (s); joined to `before`, if there is one."""
    tick = round(t / TICK)
    unit = 1 << (shift(tick - before.tick) if before else 1)
    speed = [unit * round_away(c / (8 * step) / unit) for c, step in zip(v, grid.steps)]
    return Knot(tick, [round_away(c / step) for c, step in zip(x, grid.steps)], speed, before is None)


def evaluate(before, after, grid, t_ns):
    """(x, v) at session time t_ns between two joined knots."""
    ticks = after.tick - before.tick
    h, u = ticks * TICK, (t_ns - before.tick * TICK_NS) / (ticks * TICK_NS)
    x, v = [], []
    for x0, x1, v0, v1, step in zip(before.x, after.x, before.v, after.v, grid.steps):
        x0, x1, v0, v1 = x0 * step, x1 * step, v0 * 8 * step, v1 * 8 * step
        c = (x1 - x0) / h
        b, a = 3 * c - 2 * v0 - v1, v0 + v1 - 2 * c
        x.append(x0 + h * (v0 * u + b * u * u + a * u**3))
        v.append(v0 + 2 * b * u + 3 * a * u * u)
    return x, v



def orientation(x):
    """The rotation in a point of a path that carries it; of q and −q the one with w ≥ 0."""
    q = x[3:]
    n = math.copysign(math.hypot(*q), q[0])
    return [c / n for c in q]
