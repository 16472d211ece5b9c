"""Uploads a skill that `telemime learn` made, drives `telemime robot` by it, and asserts that both ends predict the same: the
robot compares the checksums of §7 and never says `Diverged`, until it is sent one that is wrong.

Usage: skilled.py PROGRAM, where PROGRAM is the `telemime` binary. Needs aioquic; `run` makes the environment.
"""

import asyncio
import pathlib
import subprocess
import sys
import tempfile

from client import dial, fingerprint
from drive import Circle, Hand, Robot, SECONDS, followed, identity, pair
from telemime import predict, skill, state

RATE_HZ, EVERY = 30, 4
PARAMS = {"gain": 255, "inflation": 128, "weights": [[12, 1, 1], [10, 3, 1], [8, 4, 1]]}


def learned(program, folder):
    """The encoding of a skill of going round, at a few speeds."""
    (folder / "round").mkdir()
    for i, turns_per_s in enumerate((0.36, 0.39, 0.42, 0.45)):
        circle = Circle(0.0, turns_per_s)
        rows = [(n / RATE_HZ, *circle.at(n / RATE_HZ)[0]) for n in range(8 * RATE_HZ)]
        lines = ["t,x,y,z", *(",".join(map(repr, row)) for row in rows)]
        (folder / "round" / f"{i}.csv").write_text("\n".join(lines) + "\n")
    subprocess.run([program, "learn", "round"], cwd=folder, check=True, capture_output=True)
    return skill.read_file((folder / "round.skill").read_bytes())


class Skilled(Hand):
    """A hand whose motions name a skill and tell what it foretells."""

    def __init__(self, tag, model, *hand):
        super().__init__(*hand)
        self.tag, self.model, self.wrong, self.sums, self.apart = tag, model, False, 0, 0

    def engage(self):
        request = super().engage()
        request["Engage"]["drive"]["Mirror"].update(model=self.tag, params=PARAMS)
        return request

    def checksum(self, wire):
        """Of what the state says *as it travels*."""
        hand = state.Hand.of_wire(wire)
        told = predict.checksum(hand, predict.place(hand, PARAMS, self.model))
        self.sums += 1
        self.apart += told != predict.checksum(hand, predict.place(hand, PARAMS))
        return told ^ self.wrong

    def motion(self):
        message = super().motion()
        motion = message["Motion"]
        if self.tag:
            motion.update(model=self.tag, params=PARAMS)
            if self.wrong or self.seq % EVERY == 0:
                motion["checksum"] = self.checksum(motion["state"])
        return message


async def engaged(operator, hand):
    hand.sample()
    operator.say(hand.engage())
    return await operator.hear("Engaged")


async def released(operator, engagement):
    """`hear` ends at a `Refused`, so this also asserts that there was none."""
    operator.say({"Release": {"engagement": engagement}})
    while (told := await operator.hear("State"))["state"] != "Ready" or told["cause"] != "Requested":
        pass


async def session(robot, key, certificate, encoding):
    pin = await pair(robot, key, certificate)
    (name, tag), model = skill.identity(encoding), predict.Model(skill.read(encoding)["predictor"])
    async with dial(robot.host, robot.port, key, certificate, pin) as operator:
        operator.greet()
        info = await operator.hear("Info")
        assert info["model"] is None, info
        operator.say({"Model": {"id": list(name), "bytes": encoding}})
        stored = await operator.hear("ModelStored")
        assert bytes(stored["id"]) == name, stored
        while operator.pings < 8:
            await asyncio.sleep(0.02)

        hand = Skilled(tag, model, operator, Circle(operator.clock_us() * 1e-6), 1)
        told = await engaged(operator, hand)
        await hand.move(SECONDS)
        followed(operator, told, hand)
        await released(operator, 1)
        print(f"agreed:   {hand.sums} checksums of skill {name.hex()}, {hand.apart} of them not those of constant velocity")
        assert hand.sums > 20 and hand.apart > hand.sums // 2, (hand.sums, hand.apart)

        await asyncio.sleep(1.0)
        # Smaller: it begins where the first one ended, and the workspace ends 0.2 m from where that began.
        again = Skilled(tag, model, operator, Circle(operator.clock_us() * 1e-6), 2, 0.25)
        again.seq = hand.seq
        told = await engaged(operator, again)
        await again.move(1.0)
        again.wrong = True
        await again.move(0.1)
        refused = await operator.hear("Refused")
        assert refused["reason"] == "Diverged", refused
        print("a checksum that is wrong:", refused)
        # The engagement goes on, without a model at either end.
        again.tag = 0
        since = operator.clock_us() * 1e-6 + 0.5
        await again.move(3.5)
        followed(operator, told, again, since)
        await released(operator, 2)
        operator.say("Goodbye", end=True)
        await operator.hear("Closed")
    async with dial(robot.host, robot.port, key, certificate, pin) as operator:
        operator.greet()
        info = await operator.hear("Info")
        assert bytes(info["model"]) == name, info
        print("the next session need not send it again")
        operator.say("Goodbye", end=True)
        await operator.hear("Closed")


def main():
    key, certificate = identity()
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        encoding = learned(sys.argv[1], folder)
        robot = Robot(sys.argv[1], folder, "--pair", "--pair-expect", fingerprint(certificate))
        try:
            asyncio.run(session(robot, key, certificate, encoding))
        finally:
            robot.end()
    print("both ends predict the same by a skill that travelled")


if __name__ == "__main__":
    main()
