"""What a hand makes of a plan that is played (§9)."""

import math

from . import predict, state

DECAY, FARTHEST = 0.3, 0.3


def plan_time(bend, h):
    """The plan's time (s), h seconds after the moment the bend is stated for."""
    return bend["plan_us"] * 1e-6 + bend["rate"] / 128 * h


def offset(bend, h, k):
    """The displacement then (m), which is k seconds after the state of the hand that holds on."""
    share = math.exp(-max(h, 0.0) / DECAY)
    out = [1e-4 * n * share for n in bend["left"]]
    held = bend["held"]
    if held:
        hand = state.Hand.of_wire(held["state"])
        params = {"gain": held["gain"], "inflation": 128, "weights": [[0, 0, held["straight"] * 15 / 255]] * 3}
        ahead = [x + d for x, d in zip(hand.x, predict.place(hand, params).at(min(k, FARTHEST))[0])]
        xx, yx, yy, zx, zy, zz = (n / 127 for n in held["weight"])
        for i, row in enumerate(((xx, yx, zx), (yx, yy, zy), (zx, zy, zz))):
            out[i] += sum(w * d for w, d in zip(row, ahead))
    return out
