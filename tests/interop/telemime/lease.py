"""Time and authority: clock exchanges (§6) and the motion lease (§11)."""

ACCEPTED_DELAY, LONGEST, COASTING = 0.5, 1.0, 0.26


def exchange(t1, t2, t3, t4):
    """(offset, round trip) of a clock exchange, or None if it is to be ignored."""
    round_trip = (t4 - t1) - (t3 - t2)
    if round_trip < 0 or t3 < t2:
        return None
    return ((t2 - t1) + (t3 - t4)) / 2, round_trip


def until(now, lease, age, deadline=None):
    """The deadline after a newer message with this lease and age (s); the old one if the message has nothing left to give."""
    left = min(lease, LONGEST) - max(0.0, age - ACCEPTED_DELAY)
    if left <= 0 or age < -ACCEPTED_DELAY:
        return deadline
    new = now + left
    return new if deadline is None else max(deadline, new)


def speed_share(now, news, deadline):
    """The share of the allowed speed: 1, falling linearly to 0 at the deadline from COASTING after the last news on."""
    begin = news + COASTING
    if now <= begin:
        return 1.0
    return max(0.0, (deadline - now) / (deadline - begin)) if deadline > begin else 0.0
