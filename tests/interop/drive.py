"""Drives `telemime robot` from Python: pairs with it, greets, answers pings, engages, streams a circle with its path, and asserts
that the arm followed, that silence stops it, and that a stranger and a version of the future are turned away.

Usage: drive.py PROGRAM, where PROGRAM is the `telemime` binary. Needs aioquic; `run` makes the environment.
"""

import asyncio
import datetime
import json
import math
import pathlib
import subprocess
import sys
import tempfile

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ed25519

from client import dial, fingerprint, introduce
from telemime import path, state

RADIUS, TURNS_PER_S, SECONDS, SCALE = 0.12, 0.4, 6.0, 0.5
BOUND_UM, SAMPLE_US, LEASE_MS = 5_000, 33_333, 650
CONSTANT_VELOCITY = {"gain": 255, "inflation": 128, "weights": [[0, 0, 15]] * 3}


def identity():
    """A key and its self-signed certificate."""
    key = ed25519.Ed25519PrivateKey.generate()
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "interop")])
    begin = datetime.datetime(2020, 1, 1)
    certificate = x509.CertificateBuilder(
        name, name, key.public_key(), x509.random_serial_number(), begin, begin + datetime.timedelta(days=36500)
    ).sign(key, None)
    return key, certificate


class Robot:
    """A `telemime robot` process and what it prints."""

    def __init__(self, program, folder, *more):
        command = [program, "robot", "--listen", "127.0.0.1:0", "--json", "--follow-stdin", *more]
        command += ["--identity", str(folder / "robot.key"), "--peer-file", str(folder / "peers")]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True)
        listening = self.event("listening")
        self.host, _, port = listening["addr"].rpartition(":")
        self.port, self.fingerprint = int(port), listening["fingerprint"]

    def event(self, kind, **wanted):
        """The next event of this kind and with these fields."""
        for line in self.process.stdout:
            event = json.loads(line)
            if event["event"] == kind and all(event[name] == value for name, value in wanted.items()):
                return event
        raise AssertionError(f"the robot ended without {kind} {wanted}")

    async def tells(self, kind, **wanted):
        """The same, while this process goes on answering."""
        async with asyncio.timeout(10):
            return await asyncio.to_thread(self.event, kind, **wanted)

    def type(self, line):
        """What its user types."""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end(self):
        self.process.terminate()
        self.process.communicate(timeout=20)


async def pair(robot, key, certificate):
    """Pairs with a robot that expects this key; the robot's key, pinned by nothing but the code."""
    async with introduce(robot.host, robot.port, key, certificate) as pairing:
        code = await pairing.agree("interop", certificate)
        pairing.say("Confirm")
        await pairing.hear("Stored")
        told = await robot.tells("pairing", stage="paired")
        assert (told["code"], told["name"], told["fingerprint"]) == (code, "interop", fingerprint(certificate)), (told, code)
        print("paired: ", code, "at both ends")
        return pairing.peer()


class Circle:
    """A hand that sets out from rest and goes round, sampled by whoever asks."""

    def __init__(self, begin, turns_per_s=TURNS_PER_S):
        self.begin, self.turns_per_s = begin, turns_per_s

    def at(self, t):
        """(place, velocity) at session time t."""
        s, full = t - self.begin, 2 * math.pi * self.turns_per_s
        # The angle's speed rises within half a second: a + bt would begin with a jump.
        if s < 0.5:
            angle, speed = full * s * s, 2 * full * s
        else:
            angle, speed = full * (s - 0.25), full
        c, d = math.cos(angle), math.sin(angle)
        return (
            [RADIUS * (c - 1), RADIUS * d, 0.3 * RADIUS * d],
            [-RADIUS * d * speed, RADIUS * c * speed, 0.3 * RADIUS * c * speed],
        )


class Hand:
    """What is known of the hand, and the knots of its path that are not acknowledged."""

    def __init__(self, operator, circle, engagement, scale=SCALE):
        self.operator, self.circle, self.engagement, self.scale = operator, circle, engagement, scale
        self.grid = path.Grid(BOUND_UM, SAMPLE_US)
        self.state, self.knots, self.seq = None, [], 0

    def sample(self):
        t = self.operator.clock_us() * 1e-6
        x, v = self.circle.at(t)
        self.state = self.state.next(t, x) if self.state else state.Hand(t, x)
        last = self.knots[-1] if self.knots else None
        if not last or t - last.tick * path.TICK > 0.1:
            self.knots.append(path.quantise(self.grid, t, x, v, last))

    def block(self, wire, first, most):
        """The knots from number `first` on, relative to those before them."""
        return path.encode(wire, self.knots[first : first + most], self.grid, self.knots[:first])

    def acknowledged(self):
        told = [t for t in self.operator.telemetry if t["engagement"] == self.engagement]
        return told[-1]["path_frontier"] if told else 0

    def motion(self):
        wire, first = self.state.wire(), self.acknowledged()
        self.seq += 1
        return {"Motion": {
            "epoch": self.operator.epoch, "engagement": self.engagement, "seq": self.seq, "lease_ms": LEASE_MS, "model": 0,
            "params": CONSTANT_VELOCITY, "checksum": None, "state": wire, "pose": {"turn": None, "grip": None},
            "first_knot": first, "knots": self.block(wire, first, 32),
        }}  # fmt: skip

    def engage(self):
        drive = {"Mirror": {
            "state": self.state.wire(), "model": 0, "params": CONSTANT_VELOCITY, "pose": {"turn": None, "grip": None}}}  # fmt: skip
        return {"Engage": {
            "engagement": self.engagement, "t_us": self.operator.clock_us(), "drive": drive, "scale": self.scale,
            "rotation": [1.0, 0.0, 0.0, 0.0], "path_bound_um": BOUND_UM, "path_turn_bound_urad": 0, "sample_us": SAMPLE_US, "lease_ms": LEASE_MS,
        }}  # fmt: skip

    async def move(self, seconds):
        """Samples and speaks, thirty times a second."""
        end = self.operator.clock_us() + seconds * 1e6
        while self.operator.clock_us() < end:
            self.sample()
            self.operator.datagram(self.motion())
            await asyncio.sleep(SAMPLE_US * 1e-6)


async def session(robot, key, certificate, pin):
    async with dial(robot.host, robot.port, key, certificate, pin) as operator:
        operator.greet()
        greeted = await operator.hear("HelloAck")
        print("greeted:", greeted)
        assert greeted["version"] == 1, greeted
        print("info:   ", await operator.hear("Info"))
        while operator.pings < 8:
            await asyncio.sleep(0.02)

        hand = Hand(operator, Circle(operator.clock_us() * 1e-6), 1)
        hand.sample()
        operator.say(hand.engage())
        engaged = await operator.hear("Engaged")
        await hand.move(SECONDS)
        # The path to its end: a knot at the newest sample, and what was not acknowledged, by the stream.
        last, first = hand.state, hand.acknowledged()
        if hand.knots[-1].tick < round(last.t / path.TICK):
            hand.knots.append(path.quantise(hand.grid, last.t, *hand.circle.at(last.t), hand.knots[-1]))
        wire = last.wire()
        operator.say({"Path": {
            "engagement": 1, "state": wire, "first_knot": first, "knots": hand.block(wire, first, 1024)}})  # fmt: skip
        operator.say({"Release": {"engagement": 1}})
        while (told := await operator.hear("State"))["state"] != "Ready" or told["cause"] != "Requested":
            pass
        followed(operator, engaged, hand)

        # A second time, and then silence: the lease, not the connection, stops the arm.
        await asyncio.sleep(1.0)
        again = Hand(operator, Circle(operator.clock_us() * 1e-6), 2)
        again.seq = hand.seq
        again.sample()
        operator.say(again.engage())
        await operator.hear("Engaged")
        await again.move(0.5)
        while (told := await operator.hear("State"))["state"] != "Holding":
            pass
        assert told["cause"] == "LeaseExpired", told
        print("silence stopped the arm:", told)
        operator.say("Goodbye", end=True)
        print("closed: ", await operator.hear("Closed"))


def followed(operator, engaged, hand, since=None):
    """Asserts from the telemetry that the tip went where the hand was, since it was eased in or a later time (s)."""
    errors, reach = [], 0.0
    since = since or engaged["t_us"] * 1e-6 + 1.0
    telemetry = [t for t in operator.telemetry if t["engagement"] == hand.engagement]
    for t in telemetry:
        when = t["t_us"] * 1e-6
        if t["state"] != "Engaged" or when < since or when > hand.state.t:
            continue
        where = hand.circle.at(when)[0]
        wanted = [a + hand.scale * (b - c) for a, b, c in zip(engaged["tip_m"], where, engaged["hand_m"])]
        errors.append(math.dist(t["tip_m"], wanted))
        reach = max(reach, math.dist(t["tip_m"], engaged["tip_m"]))
    frontier = max(t["path_frontier"] for t in telemetry)
    print(f"followed: {len(errors)} telemetries, largest error {1e3 * max(errors):.1f} mm of a way {1e3 * reach:.0f} mm across,")
    print(f"          {hand.seq} motions, {operator.telemetry[-1]['received']} received, {frontier} of {len(hand.knots)} knots acknowledged")
    assert len(errors) > 30, len(errors)
    assert max(errors) < 0.02, max(errors)
    assert reach > 0.16 * hand.scale, reach
    assert operator.telemetry[-1]["dropped"] == 0, operator.telemetry[-1]
    assert frontier >= len(hand.knots) - 8, (frontier, len(hand.knots))


async def turned_away(robot, key, certificate, pin):
    """A stranger has no session; an operator of the future is told why."""
    async with dial(robot.host, robot.port, key, certificate, pin) as operator:
        operator.greet(60, 99)
        answer = await operator.hear("Reject")
        assert answer["code"] == 1, answer
        print("a version of the future:", answer)
        await operator.hear("Closed")
    # One that speaks later versions too is answered in the first.
    async with dial(robot.host, robot.port, key, certificate, pin) as operator:
        operator.greet(1, 99)
        answer = await operator.hear("HelloAck")
        assert answer["version"] == 1, answer
        await operator.hear("Info")
        operator.say("Goodbye", end=True)
        await operator.hear("Closed")
    stranger = identity()
    try:
        async with dial(robot.host, robot.port, *stranger, pin) as operator:
            operator.greet()
            closed = await operator.hear("Closed")
    except ConnectionError:
        print("a stranger: no connection")
    else:
        assert closed["code"] == 0x131, closed
        print("a stranger:", closed)


async def paired(robot, key, certificate, play):
    await play(robot, key, certificate, await pair(robot, key, certificate))


def main():
    key, certificate = identity()
    # A robot of today, and one that speaks version 2 as well.
    for more, play in [((), turned_away), (("--protocol-max", "2"), session)]:
        with tempfile.TemporaryDirectory() as folder:
            expecting = ("--pair", "--pair-expect", fingerprint(certificate))
            robot = Robot(sys.argv[1], pathlib.Path(folder), *expecting, *more)
            try:
                asyncio.run(paired(robot, key, certificate, play))
            finally:
                robot.end()
    print("a robot and an operator of two makes work together")


if __name__ == "__main__":
    main()
