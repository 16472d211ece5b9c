"""The predictor that both ends run (§7)."""

import math

from . import rotation, skill
from .codec import round_away
from .state import TAU

# Of a place and of an orientation: what constant velocity adds to its variance, and how far it goes at most.
PLACE, TURN = (0.25, 0.3), (1.0, 1.0)
CONSTANT_KNOTS, BANDS = 24, (3, 6, 12)
SYMMETRIC, IDENTITY = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), (1, 0, 0, 1, 0, 1)


def sub(a, b):
    return [x - y for x, y in zip(a, b)]


def norm2(a):
    return sum(x * x for x in a)


class Forecast:
    """Displacements, deviations and covariances at knots 1/30 s apart."""

    def __init__(self, d, sigma, covariance):
        self.d, self.sigma, self.covariance = d, sigma, covariance

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
            e = [(a - m) / s - mu for a, m, s, mu in zip(self.bent(f), self.p["mean"], self.p["scale"], c["mean"])]
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

    def bent(self, features):
        """The features with the differences to the two quickest memories bent."""
        out = list(features)
        for i, b in enumerate(self.p["bend"]):
            u = features[3 + 3 * i : 6 + 3 * i]
            length = math.sqrt(norm2(u))
            if b > 0 and length > 0:
                out[3 + 3 * i : 6 + 3 * i] = [c * (b * math.log(1 + length / b) / length) for c in u]
        return out

    def familiarity(self, novelty):
        """F: how much of the mixture's weight is left."""
        ratio = novelty / (6 * self.p["novelty90"])
        return 1 / (1 + ratio * ratio)

    def mixture(self, features):
        """(g, V, novelty): displacements and covariances, the latter as (xx, xy, xz, yy, yz, zz), knot by knot."""
        weights, apart, novelty = self.respond(features)
        told = []
        for r, c, e in zip(weights, self.components, apart):
            y = [
                [c["target"][i][j] + sum(c["gain"][a][i][j] * e[a] for a in range(15)) for i in range(3)]
                for j in range(self.knots)
            ]
            told.append((r, y, c["residual"]))
        g = [[sum(r * y[j][i] for r, y, _ in told) for i in range(3)] for j in range(self.knots)]
        v = [
            [sum(r * (res[n][j] + outer(sub(y[j], g[j]))[n]) for r, y, res in told) for n in range(6)]
            for j in range(self.knots)
        ]
        return g, v, novelty


def outer(d):
    """d·dᵀ, as (xx, xy, xz, yy, yz, zz)."""
    return [d[a] * d[b] for a, b in SYMMETRIC]


def velocity(apart):
    """(v, a) from the displacements since each memory."""
    s1, s2 = [d / TAU[0] for d in apart[0]], [d / TAU[1] for d in apart[1]]
    a = [(p - q) / (TAU[1] - TAU[0]) for p, q in zip(s1, s2)]
    return [s + b * TAU[0] for s, b in zip(s1, a)], a


def weights_at(params, j):
    """Of mixture, generic extrapolator and straight line at knot j."""
    rows = [[n / 15 for n in row] for row in params["weights"]]
    for (a, first), (b, last) in zip(zip(BANDS, rows), zip(BANDS[1:], rows[1:])):
        if j <= b:
            u = max(j - a, 0) / (b - a)
            return [(1 - u) * p + u * q for p, q in zip(first, last)]
    return rows[-1]


def straight(v, h, reach):
    """What the straight line says of horizon h: no farther than `reach`."""
    return [c * h / math.sqrt(1 + norm2(v) * h * h / (reach * reach)) for c in v]


def fuse(params, j, weights, told, covariances):
    """(displacement, covariance) at knot j of experts with these weights."""
    h, gain, inflation = j / 30, params["gain"] / 255, 2.0 ** ((params["inflation"] - 128) / 8)
    mean = [sum(w * y[i] for w, y in zip(weights, told)) for i in range(3)]
    v = [0.0] * 6
    for w, y, c in zip(weights, told, covariances):
        v = [a + w * (b + d) for a, b, d in zip(v, c, outer(sub(y, mean)))]
    return [gain * m for m in mean], [inflation * (a + e * 1e-4 * h * h) for a, e in zip(v, IDENTITY)]


def _forecast(apart, params, model, features, kind):
    noise, reach = kind
    v, a = velocity(apart)
    d, sigma, covariance = [[0.0] * 3], [0.0], [[0.0] * 6]
    if model:
        g, spread, novelty = model.mixture(features)
        known = model.familiarity(novelty)
        if not known > 0:
            known, g, spread = 0.0, [[0.0] * 3] * model.knots, [[0.0] * 6] * model.knots
        moved, usual = norm2(apart[2]), model.p["products"][5]
        scatter = (moved + usual / 10) / (usual + usual / 10)
    for j in range(1, (model.knots if model else CONSTANT_KNOTS) + 1):
        h = j / 30
        line, weights = straight(v, h, reach), weights_at(params, j)
        if model:
            w_m, others = weights[0], [*weights[1:], max(0.0, 1 - sum(weights))]
            s = w_m * (1 - known) / (sum(others) + 3 / 255)
            weights = [w_m * known, *(w + s * (w + 1 / 255) for w in others)]
            generic = [sum(f * m[i] for f, m in zip(model.p["lead"][j - 1], apart)) for i in range(3)]
            told = [g[j - 1], generic, line, [0.0] * 3]
            errors = model.p["errors"][j - 1]
            covariances = [[model.p["covariance"][j - 1] * c for c in spread[j - 1]]]
            covariances += [[e * errors[k] * scatter for e in IDENTITY] for k in (1, 2, 3)]
        else:
            w_s = weights[2] + 0.5 * (weights[0] + weights[1])
            weights, told = [w_s, 1 - w_s], [line, [0.0] * 3]
            c = h * h * (norm2(v) + noise + 0.25 * norm2(a) * h * h) / 3
            covariances = [[e * c for e in IDENTITY]] * 2
        mean, c = fuse(params, j, weights, told, covariances)
        d.append(mean)
        covariance.append(c)
        sigma.append(math.sqrt((c[0] + c[3] + c[5]) / 3))
    return Forecast(d, sigma, covariance)


def place(hand, params, model=None):
    """The forecast of a hand state's place; without a model, constant velocity."""
    apart = [sub(hand.x, m) for m in hand.m]
    return _forecast(apart, params, model, hand.x + sum(apart, []), PLACE)


def turning(turn, params, model=None):
    """The forecast of an orientation, in rotation vectors."""
    apart = [rotation.log(rotation.mul(rotation.inverse(m), turn.q)) for m in turn.m]
    features = None
    if model:
        features = [
            rotation.log(rotation.mul(rotation.inverse(chart), turn.q)) + sum(apart, []) for chart in model.charts
        ]
    return _forecast(apart, params, model, features, TURN)


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
