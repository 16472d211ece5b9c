"""A finished motion: points as bits, and the natural spline through them (§9)."""

import math

from . import spline
from .bits import BitReader, BitWriter
from .codec import Bytes, Kind, Option, Struct, WireError, require, zigzag

MOST, FAR = 4096, 1 << 30
LONGEST = 131_072
BYTES = Bytes(LONGEST)


def cost(n, k):
    """Bits of G(k) of n."""
    return 2 * ((n >> k) + 1).bit_length() - 1 + k


def expected(rule, older, last, t):
    """What a rule expects of a coordinate at tick t after (tick, value) twice; without an older point, the last value."""
    t1, x1 = last
    if older is None or rule == 0:
        return x1
    t0, x0 = older
    if rule == 3:
        return x0
    x = x1 + (x1 - x0) * (t - t1) // ((t1 - t0) * (1 if rule == 1 else 2))
    return max(-FAR, min(FAR, x))


def _power(n):
    """(digits, power) with the largest power of ten."""
    power = 0
    while n % 10 == 0 and power < 15:
        n, power = n // 10, power + 1
    return n, power


def _write_number(w, n):
    digits, power = _power(n)
    w.golomb(digits, 4)
    w.bits(power, 4)


def _tick(rate):
    return (1_000_000 + rate // 2) // rate


def _rate(tick):
    """The rate a tick is written as, or None."""
    rate = (1_000_000 + tick // 2) // tick
    is_one = 1 <= rate <= 1000 and _tick(rate) == tick
    return rate if is_one and cost(rate, 5) <= cost(_power(tick)[0], 4) + 4 else None


def _first(step):
    """The order of the first point's coordinates: that of a metre in steps."""
    return max(1, 1_000_000_000 // step).bit_length() - 1


def unpack(data, dims):
    """{step_nm, tick_us, points: [(tick, values)]} of a plan's bits."""
    r = BitReader(data)
    count = r.golomb(5)
    require(2 <= count <= MOST, "points", count)
    step = r.golomb(4) * 10 ** r.bits(4)
    if r.bits(1):
        rate = r.golomb(5)
        require(1 <= rate <= 1000, "rate", rate)
        tick = _tick(rate)
    else:
        tick = r.golomb(4) * 10 ** r.bits(4)
    require(step >= 1, "step_nm", step)
    points = [(r.golomb(0), [r.signed(_first(step)) for _ in range(dims)])]
    gaps = r.golomb(1)
    rules = []
    for _ in range(dims):
        rule = r.bits(2)
        rules.append((rule, rules[-1][1] + r.signed(0) if rules else r.golomb(2)))
    require(0 <= gaps <= 31 and all(0 <= k <= 31 for _, k in rules), "orders", (gaps, rules))
    for _ in range(count - 1):
        last, older = points[-1], points[-2] if len(points) > 1 else None
        t = last[0] + 1 + r.golomb(gaps)
        values = []
        for d, (rule, order) in enumerate(rules):
            before = None if older is None else (older[0], older[1][d])
            values.append(expected(rule, before, (last[0], last[1][d]), t) + r.signed(order))
        points.append((t, values))
    plan = {"step_nm": step, "tick_us": tick, "points": points}
    check(plan)
    r.end()
    return plan


def check(plan):
    """Raises unless everything is in its range."""
    require(1 <= plan["step_nm"] < 1 << 32, "step_nm", plan["step_nm"])
    require(1 <= plan["tick_us"] <= 1_000_000, "tick_us", plan["tick_us"])
    for tick, values in plan["points"]:
        require(tick < 1 << 32, "tick", tick)
        require(all(abs(n) <= FAR for n in values), "point", values)


def pack(plan):
    """The one encoding: for each column what costs least, of equals the lowest rule, of its orders the lowest."""
    points = plan["points"]
    dims = len(points[0][1])
    gap = [b[0] - a[0] - 1 for a, b in zip(points, points[1:])]
    order = min(range(32), key=lambda k: sum(cost(n, k) for n in gap))
    columns = []
    for d in range(dims):
        rests = []
        for rule in range(4):
            rest = []
            for i in range(1, len(points)):
                older = (points[i - 2][0], points[i - 2][1][d]) if i > 1 else None
                t, values = points[i]
                rest.append(values[d] - expected(rule, older, (points[i - 1][0], points[i - 1][1][d]), t))
            rests.append(rest)
        _, rule, k = min((sum(cost(zigzag(n), k) for n in rests[rule]), rule, k) for rule in range(4) for k in range(32))
        columns.append((rule, k, rests[rule]))
    w = BitWriter()
    w.golomb(len(points), 5)
    _write_number(w, plan["step_nm"])
    rate = _rate(plan["tick_us"])
    w.bits(1 if rate else 0, 1)
    if rate:
        w.golomb(rate, 5)
    else:
        _write_number(w, plan["tick_us"])
    w.golomb(points[0][0], 0)
    for n in points[0][1]:
        w.signed(n, _first(plan["step_nm"]))
    w.golomb(order, 1)
    for i, (rule, k, _) in enumerate(columns):
        w.bits(rule, 2)
        if i:
            w.signed(k - columns[i - 1][1], 0)
        else:
            w.golomb(k, 2)
    for i, n in enumerate(gap):
        w.golomb(n, order)
        for _, k, rest in columns:
            w.signed(rest[i], k)
    return w.bytes()


class Bits(Kind):
    """A plan of so many coordinates, among bytes: one that breaks a rule is malformed."""

    def __init__(self, dims):
        self.dims = dims

    def read(self, r):
        try:
            return unpack(BYTES.read(r), self.dims)
        except WireError as e:
            raise WireError("Malformed", str(e)) from None

    def write(self, value, out):
        BYTES.write(pack(value), out)


class Pose(Struct):
    """The plan of a whole motion."""

    def read(self, r):
        value = super().read(r)
        curves = Curves(value)
        if not curves.usable():
            raise WireError("Malformed", "an orientation or a gripper out of range")
        return value


class Curves:
    """What a whole plan says of any time."""

    def __init__(self, plan):
        self.plan = plan
        self.position, self.turn, self.grip = (
            plan[name] and spline.of_plan(plan[name]) for name in ("position", "turn", "grip")
        )

    def usable(self):
        if self.turn:
            if any(abs(math.hypot(*x) - 1) > 0.25 for x in self.turn.x):
                return False
            for a, b in zip(self.turn.t, self.turn.t[1:]):
                if any(math.hypot(*self.turn.at(a + (b - a) * i / 8)[0]) < 0.5 for i in range(1, 8)):
                    return False
        return not self.grip or all(-0.05 <= x[0] <= 1.05 for x in self.grip.x)

    def orientation(self, t):
        """The curve, normalised; of q and −q the one with w ≥ 0."""
        q = self.turn.at(t)[0]
        n = math.copysign(math.hypot(*q), q[0])
        return [c / n for c in q]

    def opening(self, t):
        return min(1.0, max(0.0, self.grip.at(t)[0][0]))


PLAN = Pose(("position", Bits(3)), ("turn", Option(Bits(4))), ("grip", Option(Bits(1))))
