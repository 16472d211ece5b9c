"""The predictor that both ends run (§7)."""

import math

from . import rotation, skill
from .codec import round_away
from .state import TAU

NOISE, TURN_NOISE = 0.25, 1.0
CONSTANT_KNOTS = 24


def sub(a, b):
    return [x - y for x, y in zip(a, b)]


def norm2(a):
    return sum(x * x for x in a)


class Forecast:
    """Displacements and deviations at knots 1/30 s apart."""

    def __init__(self, d, sigma):
        self.d, self.sigma = d, sigma

    def at(self, h):
        """(displacement, deviation) at horizon h (s)."""
        last = len(self.d) - 1
        u = min(max(h, 0.0) / (1 / 30), last)
        i = min(math.floor(u), last - 1)
        s = u - i
        return (
            [(1 - s) * a + s * b for a, b in zip(self.d[i], self.d[i + 1])],
            (1 - s) * self.sigma[i] + s * self.sigma[i + 1],
        )


class Model:
    """A skill's predictor, decoded from integers."""

    def __init__(self, predictor, charts=None):
        p = self.p = predictor
        e = p["exponents"]
        j = self.knots = len(e)
        self.charts, self.components = charts, []
        for c in p["components"]:
            low, at = [], 0
            for i in range(15):
                low.append([n / 512 for n in c["factor"][at : at + i + 1]])
                at += i + 1
            rows = lambda data: [skill.values(data[a : a + j], e) for a in range(0, len(data), j)]  # noqa: E731
            gain = rows(c["gain"])
            residual = [
                [math.ldexp(32.0 * w, 2 * x) for w, x in zip(skill.running(c["residual"][a : a + j]), e)]
                for a in range(0, 6 * j, j)
            ]
            self.components.append({
                "weight": c["weight"], "mean": [n / 512 for n in c["mean"]], "low": low, "target": rows(c["target"]),
                "gain": [gain[3 * a : 3 * a + 3] for a in range(15)], "residual": residual,
            })  # fmt: skip

    def respond(self, features):
        """(weights, standardised differences, novelty): `features` holds 15 numbers, or 15 for each component."""
        apart, novelty, logs = [], math.inf, []
        for k, c in enumerate(self.components):
            f = features[k] if self.charts else features
            e = [(a - m) / s - mu for a, m, s, mu in zip(f, self.p["mean"], self.p["scale"], c["mean"])]
            z = []
            for row, value in zip(c["low"], e):
                z.append((value - sum(a * b for a, b in zip(row, z))) / row[-1])
            d2 = norm2(z)
            novelty = min(novelty, d2)
            logs.append(math.log(c["weight"]) - sum(math.log(row[-1]) for row in c["low"]) - 0.5 * d2)
            apart.append(e)
        top = max(logs)
        r = [math.exp(0.5 * (v - top)) for v in logs] if top > -math.inf else [1.0] * len(logs)
        total = sum(r)
        r = [a / total for a in r]
        r = [a if a >= 1e-12 else 0.0 for a in r]
        total = sum(r)
        return [a / total for a in r], apart, novelty

    def share(self, trust, novelty):
        """w: the mixture's share in the forecast."""
        ratio = novelty / (8 * self.p["novelty90"])
        return trust / (1 + ratio * ratio)

    def mixture(self, features):
        """(g, trace of V, novelty), g and trace knot by knot."""
        weights, apart, novelty = self.respond(features)
        told = []
        for r, c, e in zip(weights, self.components, apart):
            y = [[c["target"][i][j] + sum(c["gain"][a][i][j] * e[a] for a in range(15)) for i in range(3)] for j in range(self.knots)]
            told.append((r, y, c["residual"]))
        g = [[sum(r * y[j][i] for r, y, _ in told) for i in range(3)] for j in range(self.knots)]
        trace = [
            sum(r * (sum(res[i][j] for i in (0, 3, 5)) + norm2(sub(y[j], g[j]))) for r, y, res in told)
            for j in range(self.knots)
        ]
        return g, trace, novelty


def velocity(apart):
    """(v, a) from the displacements since each memory."""
    s1, s2 = [d / TAU[0] for d in apart[0]], [d / TAU[1] for d in apart[1]]
    a = [(p - q) / (TAU[1] - TAU[0]) for p, q in zip(s1, s2)]
    return [s + b * TAU[0] for s, b in zip(s1, a)], a


def _forecast(apart, params, model, features, noise):
    gain, trust, damping = (params[name] / 255 for name in ("gain", "trust", "cv_damping"))
    v, a = velocity(apart)
    if model is None:
        d, sigma = [[0.0] * 3], [0.0]
        for j in range(1, CONSTANT_KNOTS + 1):
            h = j / 30
            d.append([c * (damping * h * gain) for c in v])
            sigma.append(h * math.sqrt((norm2(v) + noise + 0.25 * norm2(a) * h * h) / 3))
        return Forecast(d, sigma)
    g, trace, novelty = model.mixture(features)
    w = model.share(trust, novelty)
    d, sigma = [[0.0] * 3], [0.0]
    for j in range(model.knots):
        h = (j + 1) / 30
        straight = [c * damping * h for c in v]
        mean = g[j] if w > 0 else straight
        share = w if w > 0 else 0.0
        d.append([gain * (share * m + (1 - share) * s) for m, s in zip(mean, straight)])
        apart2 = norm2(sub(mean, straight))
        sigma.append(math.sqrt(
            share * model.p["covariance"][j] * trace[j] / 3
            + (1 - share) * (model.p["straight_m2"][j] + share * apart2 / 3)))  # fmt: skip
    return Forecast(d, sigma)


def place(hand, params, model=None):
    """The forecast of a hand state's place; without a model, constant velocity."""
    apart = [sub(hand.x, m) for m in hand.m]
    return _forecast(apart, params, model, hand.x + sum(apart, []), NOISE)


def turning(turn, params, model=None):
    """The forecast of an orientation, in rotation vectors."""
    apart = [rotation.log(rotation.mul(rotation.inverse(m), turn.q)) for m in turn.m]
    features = None
    if model:
        features = [
            rotation.log(rotation.mul(rotation.inverse(chart), turn.q)) + sum(apart, []) for chart in model.charts
        ]
    return _forecast(apart, params, model, features, TURN_NOISE)


def checksum(hand, forecast, turn_forecast=None):
    """FNV-1a of what is foretold at 0.1, 0.2 and 0.4 s."""
    rows = [[x + d for x, d in zip(hand.x, forecast.at(h)[0])] for h in (0.1, 0.2, 0.4)]
    if turn_forecast:
        rows += [turn_forecast.at(h)[0] for h in (0.1, 0.2, 0.4)]
    out = 0x811C9DC5
    for value in sum(rows, []):
        for byte in round_away(value * 1e6).to_bytes(8, "little", signed=True):
            out = (out ^ byte) * 0x01000193 & 0xFFFFFFFF
    return out
