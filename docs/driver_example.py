#!/usr/bin/env python3
"""An arm behind `telemime robot --driver`, as short as it gets: put your arm's own calls where the comments say.

    telemime robot --driver "python3 docs/driver_example.py 0.1,0.4,0.2,-1.4,0.1,1.0,0.1"
"""

import json
import sys
import threading
import time

RATE_HZ = 250
q = [float(v) for v in sys.argv[1].split(",")]  # your arm: read the joints
newest = {"seq": 0, "q": q, "qd": [0.0] * len(q), "opening": 1.0}  # your gripper: how far it is open, if it can tell


def say(line):
    print(json.dumps(line), flush=True)


def hear():
    global newest
    for line in sys.stdin:  # setpoints; the end of input is the end of the driver
        newest = json.loads(line)


say({"telemime_driver": 1, "joints": [f"joint{i + 1}" for i in range(len(q))], "rate_hz": RATE_HZ})
ears = threading.Thread(target=hear, daemon=True)
ears.start()
due = time.monotonic()
while ears.is_alive():
    setpoint = newest  # your arm: move the joints to setpoint["q"], at ["qd"], with ["tau"]; and read them:
    say({"q": setpoint["q"], "qd": setpoint["qd"], "opening": setpoint["opening"], "seq": setpoint["seq"]})
    due += 1 / RATE_HZ
    time.sleep(max(0.0, due - time.monotonic()))
# Your arm: hold the last position, with the brakes or actively; never let it drop.
