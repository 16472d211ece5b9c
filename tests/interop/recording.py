"""Two daemons record; an independent reader opens both files, and rerun does too where it is installed.

Every schema and message is decoded by Foxglove's own Python packages, the JSON messages are held against the schema that
stands in the file, the frames are joined from base to tip and compared with the tip that was recorded, and an operator that is
killed leaves a file that a streaming reader takes.

Usage: recording.py PROGRAM, where PROGRAM is the `telemime` binary. Needs mcap and mcap-protobuf-support; `run` makes the
environment.
"""

import json
import math
import pathlib
import subprocess
import sys
import tempfile

from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Metadata
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

RATE_HZ, SECONDS = 60, 6.0
KINDS = {"string": str, "integer": int, "number": (int, float), "boolean": bool, "array": list}


def demonstration(path, phase):
    """A hand that waves, as a table."""
    with open(path, "w") as out:
        out.write("t,x,y,z\n")
        for i in range(int(RATE_HZ * SECONDS)):
            t = i / RATE_HZ
            angle = 2 * math.pi * 0.4 * t + phase
            rise = min(1.0, t)
            x, y = 0.25 * rise * math.sin(angle), 0.1 * rise * math.sin(2 * angle)
            out.write(f"{t},{x},{y},{2.0 + 0.05 * rise * math.cos(angle)}\n")


class Daemon:
    """A process of ours and what it prints."""

    def __init__(self, program, *args):
        self.process = subprocess.Popen(
            [program, *args, "--json"], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
        )

    def event(self, kind, wanted=lambda event: True):
        for line in self.process.stdout:
            event = json.loads(line)
            if event["event"] == kind and wanted(event):
                return event
        raise SystemExit(f"no event {kind}")

    def end(self):
        self.process.communicate(timeout=60)
        return self.process.returncode


def drive(program, folder, kill_at=None):
    """Drives the arm once; returns the two recordings. The operator is killed there if that is wanted."""
    robot_file, operator_file = folder / f"robot-{kill_at}.mcap", folder / f"operator-{kill_at}.mcap"
    ours = json.loads(
        subprocess.check_output([program, "identity", "--file", folder / "operator.key", "--json"], text=True)
    )["fingerprint"]
    robot = Daemon(
        program, "robot", "--listen", "127.0.0.1:0", "--identity", folder / "robot.key", "--peer", ours,
        "--record", robot_file,
    )
    listening = robot.event("listening")
    operator = Daemon(
        program, "operator", "--connect", listening["addr"], "--identity", folder / "operator.key", "--peer",
        listening["fingerprint"], "--learn", folder / "wave", "--replay", folder / "unseen.csv", "--record", operator_file,
    )
    if kill_at is None:
        assert operator.event("done")["completed"]
        assert operator.event("recording")["error"] is None
        assert operator.end() == 0
    else:
        operator.event("progress", lambda event: event["done"] > kill_at)
        operator.process.kill()
        operator.end()
    robot.process.terminate()
    recorded = robot.event("recording")
    assert recorded["error"] is None and recorded["dropped"] == 0, recorded
    assert robot.end() == 0
    return robot_file, operator_file


def rotated(q, v):
    """v turned by the quaternion (w, x, y, z)."""
    w, *u = q
    cross = lambda a, b: [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    twice = [2 * c for c in cross(u, v)]
    return [v[i] + w * twice[i] + c for i, c in enumerate(cross(u, twice))]


def tip_by(transforms):
    """Where the last frame is in the first one."""
    at = [0.0, 0.0, 0.0]
    for link in reversed(transforms):
        r, m = link.rotation, link.translation
        assert abs(r.w**2 + r.x**2 + r.y**2 + r.z**2 - 1) < 1e-6
        at = [a + b for a, b in zip(rotated((r.w, r.x, r.y, r.z), at), (m.x, m.y, m.z))]
    parents, children = [t.parent_frame_id for t in transforms], [t.child_frame_id for t in transforms]
    assert parents[0] == "base" and parents[1:] == children[:-1] and children[-1].endswith("tip"), children
    return at


def check(path, role):
    """Reads a whole recording; returns how many messages each topic has."""
    counts, frames, worst = {}, None, 0.0
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        names = {record.name: record.metadata for record in reader.iter_metadata()}
        assert names["telemime"]["role"] == role and names["telemime.end"]["dropped"] == "0", names
        summary = reader.get_summary()
        stream.seek(0)
        assert summary.statistics.message_count == int(names["telemime.end"]["messages"])
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.message_encoding != "json":
                continue
            content, stated = json.loads(message.data), json.loads(schema.data)
            assert set(stated["required"]) <= set(content) <= set(stated["properties"]), (schema.name, content)
            for key, value in content.items():
                assert isinstance(value, KINDS[stated["properties"][key]["type"]]), (schema.name, key, value)
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
        stream.seek(0)
        decode = make_reader(stream, decoder_factories=[DecoderFactory()])
        topics = [c.topic for c in summary.channels.values() if c.message_encoding == "protobuf"]
        for schema, channel, message, content in decode.iter_decoded_messages(topics=topics):
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            assert schema.name == "foxglove." + type(content).__name__, (schema.name, type(content))
            assert 0 < message.publish_time <= message.log_time, (channel.topic, message)
            if schema.name == "foxglove.FrameTransforms":
                frames = content.transforms
            elif channel.topic == f"/{role}/tip" and frames:
                at = content.pose.position
                worst = max(worst, math.dist(tip_by(frames), (at.x, at.y, at.z)))
    # A tick's report has the joints after its step and the tip before it.
    assert worst < 2e-3, f"the frames' tip is {worst} m from the one recorded"
    print(f"{path.name}: {summary.statistics.message_count} messages, {path.stat().st_size / 1e3:.0f} kB, {counts}")
    return counts


def check_cut(path):
    """A killed process's file, read as a stream."""
    messages, named = 0, False
    with open(path, "rb") as stream:
        records = StreamReader(stream).records
        try:
            for record in records:
                named |= isinstance(record, Metadata)
                messages += type(record).__name__ == "Message"
        except EndOfFile:
            pass
    assert named and messages > 50, messages
    print(f"{path.name}: killed, and {messages} messages are read all the same")


def check_rerun(paths):
    """Loads both files headless."""
    try:
        import rerun
    except ImportError:
        print("SKIPPED: rerun-sdk is not installed: the recordings were not opened with it", file=sys.stderr)
        return
    for path in paths:
        out = path.with_suffix(".rrd")
        recording = rerun.RecordingStream("telemime")
        recording.save(out)
        recording.log_file_from_path(path)
        recording.flush()
        recording.disconnect()
        assert out.stat().st_size > 10_000, out.stat().st_size
        print(f"rerun {rerun.__version__} makes {out.stat().st_size / 1e3:.0f} kB of {path.name}")


def main(program):
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(sys.argv[2]) if len(sys.argv) > 2 else pathlib.Path(name)
        (folder / "wave").mkdir(parents=True)
        for i in range(3):
            demonstration(folder / "wave" / f"{i}.csv", 0.1 * i)
        demonstration(folder / "unseen.csv", 0.05)
        paths = drive(program, folder)
        of_robot, of_operator = check(paths[0], "robot"), check(paths[1], "operator")
        assert of_robot["/robot/state"] > 500 and of_robot["/robot/arm"] >= 1, of_robot
        assert of_operator["/operator/hand"] > 300 and of_operator["/operator/knots"] > 20, of_operator
        check_cut(drive(program, folder, 0.8)[1])
        check_rerun(paths)


if __name__ == "__main__":
    main(sys.argv[1])
