"""A million datagrams of garbage against a robot process that somebody is driving: asserts that its memory stays within a bound,
that the servo is hardly later for it, and that the session goes on.

Usage: flood.py PROGRAM [DATAGRAMS]
"""

import asyncio
import multiprocessing
import pathlib
import random
import socket
import sys
import tempfile
import time

from client import dial, fingerprint
from drive import Circle, Hand, Robot, identity

# What the flood may cost: memory, and late ticks a second beside what the same flood to a socket of somebody else costs.
MEMORY_MIB, LATE_A_SECOND = 16, 100


def throw(address, count):
    """Random bytes, half of them nearly first packets of QUIC version 1, from ever new ports."""
    rng, sent = random.Random(1), 0
    packets = [rng.randbytes(rng.randrange(1, 1200)) for _ in range(500)]
    packets += [b"\xc3\0\0\0\1\x08" + rng.randbytes(1194) for _ in range(500)]
    while sent < count:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            for packet in packets:
                try:
                    s.sendto(packet, address)
                except OSError:
                    time.sleep(1e-3)
            sent += len(packets)


def resident_mib(pid):
    """What a process has in memory, MiB."""
    for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise ValueError("no VmRSS")


async def session(robot, key, certificate, count):
    async with dial(robot.host, robot.port, key, certificate, robot.fingerprint) as operator:
        operator.greet()
        await operator.hear("Info")
        while operator.pings < 8:
            await asyncio.sleep(0.02)
        hand = Hand(operator, Circle(operator.clock_us() * 1e-6), 1)
        hand.sample()
        operator.say(hand.engage())
        await operator.hear("Engaged")

        async def look():
            """The next that the robot says of its ticks, which it does about once a second."""
            before = operator.servo
            while operator.servo is before:
                await hand.move(0.25)
            s = operator.servo
            return s["ticks"] * 1e-3, s["overruns"], time.monotonic()

        await hand.move(1.0)
        memory, looks, told, peak = resident_mib(robot.process.pid), [await look()], len(operator.telemetry), 0.0
        await hand.move(4.0)
        looks.append(await look())
        # The same to a socket that nobody reads: what the flood costs this computer without the robot's doing.
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as aside:
            aside.bind(("127.0.0.1", 0))
            for address in (aside.getsockname(), (robot.host, robot.port)):
                flood = multiprocessing.Process(target=throw, args=(address, count))
                flood.start()
                while flood.is_alive():
                    await hand.move(0.25)
                    peak = max(peak, resident_mib(robot.process.pid))
                flood.join()
                looks.append(await look())
        await hand.move(0.5)
        states = {t["state"] for t in operator.telemetry[told:]}
        calm, elsewhere, here = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(looks, looks[1:])]
        dropped = operator.telemetry[-1]["dropped"]
        print(f"{count} datagrams in {looks[3][2] - looks[2][2]:.1f} s; resident {memory:.1f} MiB, at most {peak:.1f} MiB")
        print(f"late ticks a second: {calm:.1f} in peace, {elsewhere:.1f} with the flood elsewhere, {here:.1f} with it here")
        print(f"states {sorted(states)}; {dropped} dropped")
        operator.say("Goodbye", end=True)
        closed = await operator.hear("Closed")
        assert closed["code"] == 0, closed
        assert states <= {"Engaged", "Coasting"} and len(operator.telemetry) - told > 10, states
        assert peak - memory < MEMORY_MIB, (memory, peak)
        assert here < max(calm, elsewhere) + LATE_A_SECOND, (calm, elsewhere, here)
        assert dropped == 0, "garbage reached the session"


def main():
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000
    key, certificate = identity()
    with tempfile.TemporaryDirectory() as folder:
        robot = Robot(sys.argv[1], pathlib.Path(folder), "--peer", fingerprint(certificate))
        try:
            asyncio.run(session(robot, key, certificate, count))
        finally:
            robot.end()


if __name__ == "__main__":
    main()
