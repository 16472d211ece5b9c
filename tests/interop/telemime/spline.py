"""The natural interpolating cubic (§9)."""


class Spline:
    """The C² cubic through points (t, values) with zero acceleration at both ends."""

    def __init__(self, points):
        self.t = [t for t, _ in points]
        self.x = [list(x) for _, x in points]
        n, dims = len(points), len(points[0][1])
        h = [b - a for a, b in zip(self.t, self.t[1:])]
        # Second derivatives by elimination of a tridiagonal system; 0 at both ends.
        self.a = [[0.0] * dims for _ in range(n)]
        upper, right = [0.0] * n, [[0.0] * dims for _ in range(n)]
        for i in range(1, n - 1):
            pivot = 2 * (h[i - 1] + h[i]) - h[i - 1] * upper[i - 1]
            upper[i] = h[i] / pivot
            for d in range(dims):
                jump = (self.x[i + 1][d] - self.x[i][d]) / h[i] - (self.x[i][d] - self.x[i - 1][d]) / h[i - 1]
                right[i][d] = (6 * jump - h[i - 1] * right[i - 1][d]) / pivot
        for i in range(n - 2, 0, -1):
            self.a[i] = [right[i][d] - upper[i] * self.a[i + 1][d] for d in range(dims)]

    def at(self, t):
        """(x, v, a) at t; outside the ends their value, at rest."""
        if not self.t[0] <= t <= self.t[-1]:
            end = self.x[0] if t < self.t[0] else self.x[-1]
            return list(end), [0.0] * len(end), [0.0] * len(end)
        i = next(i for i in range(len(self.t) - 1) if t <= self.t[i + 1])
        h = self.t[i + 1] - self.t[i]
        p, q = (self.t[i + 1] - t) / h, (t - self.t[i]) / h
        x, v, a = [], [], []
        for x0, x1, a0, a1 in zip(self.x[i], self.x[i + 1], self.a[i], self.a[i + 1]):
            x.append(p * x0 + q * x1 + ((p**3 - p) * a0 + (q**3 - q) * a1) * h * h / 6)
            v.append((x1 - x0) / h + ((3 * q * q - 1) * a1 - (3 * p * p - 1) * a0) * h / 6)
            a.append(p * a0 + q * a1)
        return x, v, a


def of_plan(plan, unit=1e-9):
    """The spline of an unpacked plan: seconds, and metres (a step of orientation and gripper is 10⁻⁹ as well)."""
    tick, step = plan["tick_us"] * 1e-6, plan["step_nm"] * unit
    return Spline([(t * tick, [n * step for n in x]) for t, x in plan["points"]])
