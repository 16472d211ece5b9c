"""A driver that does everything right for a while, and then one thing wrong: python3 faulty.py HOW Q1,Q2,…"""

import json
import os
import select
import sys
import time

RATE_HZ = 250
HOW, Q = sys.argv[1], [float(v) for v in sys.argv[2].split(",")]


def say(line):
    print(line if isinstance(line, str) else json.dumps(line), flush=True)


def main():
    say({"telemime_driver": 1, "joints": [f"joint{i + 1}" for i in range(len(Q))], "rate_hz": RATE_HZ})
    q, qd, seq, heard, said = Q, [0.0] * len(Q), 0, b"", 0
    due = time.monotonic()
    if HOW == "moved":
        say({"q": q, "qd": qd})
        q = [q[0] + 0.1, *q[1:]]
    while True:
        say({"q": q, "qd": qd, "seq": seq})
        said += 1
        due += 1 / RATE_HZ
        while (wait := due - time.monotonic()) > 0:
            if not select.select([0], [], [], wait)[0]:
                break
            block = os.read(0, 1 << 16)
            if not block:
                return
            *lines, heard = (heard + block).split(b"\n")
            if lines:
                setpoint = json.loads(lines[-1])
                q, qd, seq = setpoint["q"], setpoint["qd"], setpoint["seq"]
        # Once it has obeyed a few.
        if seq == 0 or said < RATE_HZ:
            continue
        if HOW == "die":
            return
        if HOW == "mute":
            os.close(1)
            time.sleep(3600)
        if HOW == "ahead":
            seq += 1000
        if HOW == "stall":
            time.sleep(3600)
        if HOW == "garbage":
            say('{"q": [NaN')
        if HOW == "leap":
            q = [q[0] + 1.0, *q[1:]]
            say({"q": q, "qd": qd, "seq": seq})
            time.sleep(3600)
        if HOW == "deaf":
            while True:
                say({"q": q, "qd": qd, "seq": seq})
                time.sleep(1 / RATE_HZ)
        if HOW == "fault":
            say({"fault": "joint 3 is too warm"})


main()
