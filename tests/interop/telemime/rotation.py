"""Unit quaternions (w, x, y, z) and rotation vectors (§7)."""

import math


def mul(a, b):
    """a·b: b first, then a."""
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]


def inverse(q):
    return [q[0], -q[1], -q[2], -q[3]]


def exp(v):
    """The unit quaternion of a rotation vector."""
    angle = math.sqrt(sum(c * c for c in v))
    if angle < 1e-9:
        k = 0.5
    else:
        k = math.sin(angle / 2) / angle
    return [math.cos(angle / 2)] + [k * c for c in v]


def log(q):
    """The rotation vector of a unit quaternion, the same for q and −q."""
    if q[0] < 0:
        q = [-c for c in q]
    s = math.sqrt(sum(c * c for c in q[1:]))
    k = 2.0 if s < 1e-9 else 2 * math.atan2(s, q[0]) / s
    return [k * c for c in q[1:]]


def rotate(q, v):
    """v in the axes that q turns to."""
    return mul(mul(q, [0.0, *v]), inverse(q))[1:]
