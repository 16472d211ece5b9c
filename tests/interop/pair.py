"""Pairs a Python operator with `telemime robot` by the code alone, and asserts that whatever differs ends without a pin: a code
that one user or the other refuses, a key that was not expected, a second attempt, a message out of turn or none, a session of a
stranger, and somebody in between who hands on every message of `telemime pair`.

Usage: pair.py PROGRAM, where PROGRAM is the `telemime` binary. Needs aioquic; `run` makes the environment.
"""

import asyncio
import contextlib
import json
import pathlib
import sys
import tempfile

from aioquic.asyncio import serve
from client import Pairing, configured, dial, fingerprint, introduce
from drive import Robot, identity

NOT_TRUSTED, DECLINED, OUT_OF_TURN = 5, 4, 7


@contextlib.contextmanager
def robot_at(program, folder, *more):
    robot = Robot(program, pathlib.Path(folder), *more)
    try:
        yield robot
    finally:
        robot.end()


async def refused(attempt, what):
    """Asserts that an attempt to connect comes to nothing."""
    try:
        async with attempt as end:
            end.greet() if hasattr(end, "greet") else end.say({"Offer": {"name": "again"}})
            closed = await end.hear("Closed")
    except ConnectionError:
        closed = {"reason": "no connection"}
    else:
        assert closed["code"] in (NOT_TRUSTED, 0x131), closed
    print(f"{what}: {closed['reason'] or hex(closed['code'])}")
    return closed


async def ended(robot, pairing, code, what):
    """Asserts that robot and operator agree that there was no pairing."""
    if code is not None:
        abort = await pairing.hear("Abort")
        assert abort["code"] == code, abort
    told = await robot.tells("pairing", stage="ended")
    print(f"{what}: {told['why']}")


async def by_the_code(program, folder):
    """Both users see the same code and agree; a robot that is started again still knows the key."""
    key, certificate = identity()
    with robot_at(program, folder, "--pair") as robot:
        async with introduce(robot.host, robot.port, key, certificate) as pairing:
            code = await pairing.agree("interop", certificate)
            shown = await robot.tells("pairing", stage="code")
            assert shown["code"] == code, (shown, code)
            print("both ends show", code)
            pairing.say("Confirm")
            robot.type("yes")
            await pairing.hear("Stored")
            await robot.tells("pairing", stage="paired")
            pin = pairing.peer()
    with robot_at(program, folder) as robot:
        async with dial(robot.host, robot.port, key, certificate, pin) as operator:
            operator.greet()
            await operator.hear("Info")
            operator.say("Goodbye", end=True)
            await operator.hear("Closed")


async def another_code(program, folder):
    """An operator that sees another code says no. The window is used up then, and nobody is trusted for it."""
    key, certificate = identity()
    with robot_at(program, folder, "--pair") as robot:
        address = robot.host, robot.port
        closed = await refused(dial(*address, *identity(), robot.fingerprint), "a stranger while the window is open")
        assert closed["code"] == NOT_TRUSTED, closed
        async with introduce(*address, key, certificate) as pairing:
            # As whoever is connected to somebody in between would have it: all is the same but the connection.
            own = pairing.exported
            pairing.exported = lambda: bytes(b ^ 1 for b in own())
            code = await pairing.agree("interop", certificate)
            shown = await robot.tells("pairing", stage="code")
            assert shown["code"] != code, code
            print(f"the operator would see {code}, the robot shows {shown['code']}")
            pairing.say({"Abort": {"code": DECLINED, "text": "the codes differ"}}, end=True)
            await ended(robot, pairing, None, "no at the operator")
        await refused(introduce(*address, key, certificate), "a second attempt in the same window")
        await refused(dial(*address, key, certificate, robot.fingerprint), "a session without a pairing")


async def no_at_the_robot(program, folder):
    key, certificate = identity()
    with robot_at(program, folder, "--pair") as robot:
        async with introduce(robot.host, robot.port, key, certificate) as pairing:
            await pairing.agree("interop", certificate)
            pairing.say("Confirm")
            await robot.tells("pairing", stage="code")
            robot.type("no")
            await ended(robot, pairing, DECLINED, "no at the robot")
        await refused(dial(robot.host, robot.port, key, certificate, robot.fingerprint), "a session all the same")


async def another_key(program, folder):
    key, certificate = identity()
    _, expected = identity()
    with robot_at(program, folder, "--pair", "--pair-expect", fingerprint(expected)) as robot:
        async with introduce(robot.host, robot.port, key, certificate) as pairing:
            await pairing.agree("interop", certificate)
            await ended(robot, pairing, DECLINED, "another key than was expected")


async def out_of_turn(program, folder):
    key, certificate = identity()
    with robot_at(program, folder, "--pair") as robot:
        async with introduce(robot.host, robot.port, key, certificate) as pairing:
            pairing.say("Confirm")
            await ended(robot, pairing, OUT_OF_TURN, "a Confirm before all else")


async def silent(program, folder):
    key, certificate = identity()
    with robot_at(program, folder, "--pair") as robot:
        async with introduce(robot.host, robot.port, key, certificate) as pairing:
            pairing.say({"Offer": {"name": "mute"}})
            await pairing.hear("Commit")
            await ended(robot, pairing, OUT_OF_TURN, "nothing where a Nonce is due")


async def hand_on(one, other):
    while "Closed" not in (message := await one.heard.get()):
        other.say(message)


async def in_between(program, folder):
    """Whoever ends both handshakes makes the codes differ; the robot's, typed at the operator, is a no there."""
    key, certificate = identity()
    taken = asyncio.get_running_loop().create_future()

    def take(*args, **kwargs):
        taken.set_result(Pairing(*args, **kwargs))
        return taken.result()

    with robot_at(program, folder, "--pair") as robot:
        configuration = configured("telemime-pair/1", key, certificate, is_client=False)
        server = await serve("127.0.0.1", 0, configuration=configuration, create_protocol=take)
        port = server._transport.get_extra_info("sockname")[1]
        async with introduce(robot.host, robot.port, key, certificate) as towards:
            operator = await asyncio.create_subprocess_exec(
                program, "pair", f"127.0.0.1:{port}", "--json", "--identity", f"{folder}/operator.key", "--peer-file",
                f"{folder}/robots", stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip
            between = await asyncio.wait_for(taken, 10)
            relays = [asyncio.create_task(hand_on(*way)) for way in ((between, towards), (towards, between))]
            theirs = json.loads(await asyncio.wait_for(operator.stdout.readline(), 10))
            shown = await robot.tells("pairing", stage="code")
            assert theirs["event"] == "code" and theirs["code"] != shown["code"], (theirs, shown)
            print(f"with somebody in between the operator shows {theirs['code']}, the robot {shown['code']}")
            out, why = await asyncio.wait_for(operator.communicate(shown["code"].encode() + b"\n"), 10)
            assert operator.returncode == 1 and not out, (operator.returncode, out)
            await ended(robot, towards, None, "the robot's code typed at that operator")
            for relay in relays:
                relay.cancel()
        server.close()
        peers = [pathlib.Path(folder) / name for name in ("robots", "peers")]
        assert not any(path.exists() and fingerprint(certificate) in path.read_text() for path in peers)


def main():
    for play in (by_the_code, another_code, no_at_the_robot, another_key, out_of_turn, silent, in_between):
        with tempfile.TemporaryDirectory() as folder:
            asyncio.run(play(sys.argv[1], folder))
    print("paired by the code, and by nothing else")


if __name__ == "__main__":
    main()
