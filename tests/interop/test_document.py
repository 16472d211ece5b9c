"""The examples of docs/protocol.md, computed from what the document says."""

import unittest

import document
from telemime import (
    bend, codec, frames, greeting, lease, messages, pairing, path, plan, predict, rotation, skill, spline, state)  # fmt: skip

STATE = bytes.fromhex("fc808d5b00 fb401ffb9f0ffb50c3 2345 50e00060dc0464d80450e205")
PARAMS = {"gain": 255, "inflation": 136, "weights": [[13, 1, 1], [11, 2, 2], [8, 4, 3]]}


def hand():
    return state.Hand.of_wire(codec.decode(state.STATE, STATE, 100))


class Document(unittest.TestCase):
    def near(self, words, values, digits=9):
        self.assertEqual(len(words), len(values))
        for word, value in zip(words, values):
            self.assertAlmostEqual(float(word), value, delta=0.6 * 10**-digits)

    def test_greetings(self):
        for name, kinds, value in [
            ("hello", greeting.OPERATOR, {"Hello": {"min": 1, "max": 1, "features": 0}}),
            ("hello-ack", greeting.ROBOT, {"HelloAck": {"version": 1, "features": 0, "epoch": 7}}),
            ("reject", greeting.ROBOT, {"Reject": {"code": 2, "text": "another operator has authority"}}),
        ]:
            data = document.example(name)
            self.assertEqual(greeting.parse(data, kinds), (value, len(data)))
            self.assertIsNone(greeting.parse(data[:-1], kinds))
        self.assertEqual(greeting.hello(1, 1), document.example("hello"))
        self.assertEqual(greeting.hello_ack(1, 7), document.example("hello-ack"))
        self.assertEqual(greeting.reject(2, "another operator has authority"), document.example("reject"))

    def test_integers(self):
        for line in document.blocks("hex")["integers"]:
            left, right = line.split("=")
            (sign, n), data = left.split(), bytes.fromhex(right)
            kind = codec.U64 if sign == "u" else codec.I64
            self.assertEqual(codec.encode(kind, int(n)), data)
            self.assertEqual(codec.decode(kind, data, 9), int(n))

    def test_messages(self):
        kinds = {
            "operator control": "engage-mirror engage-play path path-pose reset",
            "robot control": "info engaged refused state arm",
            "operator datagram": "motion motion-pose go go-bend pong stop clock",
            "robot datagram": "ping telemetry reception",
        }
        for kind, names in kinds.items():
            for name in names.split():
                with self.subTest(name):
                    data = document.example(name)
                    self.assertEqual(messages.write(kind, messages.read(kind, data)), data)

    def test_what_the_comments_say(self):
        m = messages.read("operator datagram", document.example("motion"))["Motion"]
        self.assertEqual((m["epoch"], m["engagement"], m["seq"], m["lease_ms"]), (7, 1, 42, 650))
        self.assertEqual(m["state"]["x"], [4000, -2000, 25000])
        memory = m["state"]["memory"]
        self.assertEqual(state.exponents(memory), [2, 3, 4, 5])
        self.assertEqual(memory["offsets"], [[80, -32, 0], [96, -36, 4], [100, -40, 4], [80, -30, 5]])
        t = messages.read("robot datagram", document.example("telemetry"))["Telemetry"]
        self.assertEqual((t["seq"], t["state"], t["t_us"], t["age_ms"], t["grip"]), (300, "Engaged", 3_100_000, 180, 255))
        self.assertEqual(t["q"], [0.0, 1.0])
        r = messages.read("robot datagram", document.example("reception"))["Reception"]
        self.assertEqual((r["newest_seq"], r["received"], r["longest_loss_run"]), (42, 40, 2))
        self.assertEqual((r["delay_us"][2], r["age_us"][3]), (109_000, 310_000))
        s = messages.read("robot datagram", document.example("servo"))["Servo"]
        self.assertEqual((s["ticks"], s["overruns"], s["work_ns"][2], s["wake_ns"][1]), (60_000, 2, 12_000, 90_000))
        stream = document.example("frame")
        self.assertEqual(frames.parse(stream), (b"\x05", False, 5))
        self.assertEqual(messages.read("operator control", b"\x05"), "EmergencyStop")

    def test_state(self):
        says, h = document.numbers("state"), hand()
        self.assertEqual(h.wire(), codec.decode(state.STATE, STATE, 100))
        later = h.next(3.033, [0.41, -0.2, 2.5])
        for i in range(4):
            self.near(says[f"m{i + 1}"], h.m[i])
            self.near(says[f"next m{i + 1}"], later.m[i])

    def test_turn(self):
        says, h = document.numbers("turn"), hand()
        m = messages.read("operator datagram", document.example("motion-pose"))["Motion"]
        t = state.Turn.of_wire(m["pose"]["turn"])
        later = t.next(h, 3.033, rotation.exp([0.45, -0.3, 0.05]))
        for i in (1, 4):
            self.near(says[f"turn m{i}"], rotation.log(t.m[i - 1]))
        self.near(says["turn next m1"], rotation.log(later.m[0]))
        f = predict.turning(t, m["pose"]["turn"]["params"])
        d, sigma = f.at(0.1)
        self.near(says["turn cv(0.1)"], rotation.log(rotation.mul(t.q, rotation.exp(d))))
        self.near(says["turn cv sigma(0.1)"], [sigma])
        self.assertEqual(says["turn checksum"], [f"{predict.checksum(h, predict.place(h, m['params']), f):08x}"])

    def test_constant_velocity(self):
        says, h = document.numbers("constant velocity"), hand()
        v, a = predict.velocity([predict.sub(h.x, m) for m in h.m])
        self.near(says["v"], v)
        self.near(says["a"], a)
        f = predict.place(h, PARAMS)
        d, sigma = f.at(0.1)
        self.near(says["cv(0.1)"], [x + c for x, c in zip(h.x, d)])
        self.near(says["cv sigma(0.1)"], [sigma])
        self.assertEqual(says["cv checksum"], [f"{predict.checksum(h, f):08x}"])

    def test_path(self):
        says = document.numbers("path")
        m = messages.read("operator datagram", document.example("motion"))["Motion"]
        grid = path.Grid(20_000, 33_333)
        knots = path.decode(m["state"], m["knots"], grid)
        told = [[240_000, [35, -20, 250], [2, -4, 0], True], [270_000, [40, -20, 251], [0, 2, 0], False]]
        self.assertEqual([k.plain() for k in knots], told)
        self.assertEqual(path.encode(m["state"], knots, grid), m["knots"])
        later = messages.read("operator control", document.example("path"))["Path"]
        (last,) = path.decode(later["state"], later["knots"], grid, knots)
        self.assertEqual(last.plain(), [280_002, [43, -21, 251], [16, 0, -8], False])
        self.assertEqual(path.encode(later["state"], [last], grid, knots), later["knots"])
        x, v = path.evaluate(*knots, grid, 2_500_000_000)
        self.near(says["path x(2.5)"], x)
        self.near(says["path v(2.5)"], v)
        grid = path.Grid(20_000, 33_333, 50_000)
        m = messages.read("operator control", document.example("path-pose"))["Path"]
        poses = path.decode(m["state"], m["knots"], grid)
        self.assertEqual([k.x[:3] for k in poses], [k.x for k in (*knots, last)])
        self.assertEqual(path.encode(m["state"], poses, grid), m["knots"])
        x, _ = path.evaluate(*poses[:2], grid, 2_500_000_000)
        self.near(document.numbers("path-pose")["path q(2.5)"], path.orientation(x))

    def test_plan(self):
        says = document.numbers("plan")
        p = codec.decode(plan.PLAN, document.example("plan"), plan.LONGEST)["position"]
        self.assertEqual(p["points"], [(0, [100, 0, -300]), (250, [150, 50, -300]), (400, [200, 10, 700])])
        for name, value in zip("xva", spline.of_plan(p).at(0.1)):
            self.near(says[f"plan {name}(0.1)"], value)

    def test_bend(self):
        says = document.numbers("bend")
        bent = messages.read("operator datagram", document.example("go-bend"))["Go"]["bend"]
        self.near(says["bend plan(3.4)"], [bend.plan_time(bent, 0.2)])
        self.near(says["bend offset(3.4)"], bend.offset(bent, 0.2, 0.21))

    def test_pairing(self):
        offer = {"Offer": {"name": "laptop"}}
        commit = {"Commit": {"commitment": pairing.commitment(bytes([0x22] * 32)), "name": "arm"}}
        abort = {"Abort": {"code": 4, "text": "no"}}
        for name, message in [("pair-offer", offer), ("pair-commit", commit), ("pair-abort", abort)]:
            data = document.example(name)
            self.assertEqual(pairing.encode(message), data)
            self.assertEqual(pairing.parse(data), (message, len(data)))
            self.assertIsNone(pairing.parse(data[:-1]))
        code = pairing.code(*(bytes([n] * 32) for n in (0xE5, 0x0A, 0x0B, 0x11, 0x22)))
        self.assertEqual(" ".join(document.numbers("pairing")["pairing code"]), code)

    def test_lease(self):
        self.assertEqual(lease.until(10.0, 0.65, 0.2), 10.65)
        self.assertAlmostEqual(lease.until(10.0, 0.65, 0.7), 10.45)
        self.assertIsNone(lease.until(10.0, 0.65, 1.2))
        self.assertEqual(lease.until(10.0, 0.65, 0.2, 11.0), 11.0)
        self.assertEqual(lease.until(10.0, 60.0, 0.0), 11.0)
        self.assertAlmostEqual(lease.until(10.0, 65.0, 1.4), 10.1)
        self.assertIsNone(lease.until(10.0, 65.0, 1.6))
        self.assertEqual(lease.exchange(90.0, 3.0, 3.0, 90.2)[1], 90.2 - 90.0)
        self.assertIsNone(lease.exchange(90.0, 3.0, 2.9, 90.2))

    def test_skill(self):
        says, h, s = document.numbers("skill"), hand(), example()
        data = skill.write(s)
        self.assertEqual(skill.read(data), s)
        head, tag = skill.identity(data)
        self.assertEqual(says["skill bytes"], [str(len(data))])
        self.assertEqual(says["skill id"], [head.hex()])
        self.assertEqual(says["skill tag"], [str(tag)])
        model = predict.Model(s["predictor"])
        apart = [predict.sub(h.x, m) for m in h.m]
        novelty = model.respond(h.x + sum(apart, []))[2]
        self.near(says["novelty"], [novelty])
        self.near(says["familiarity"], [model.familiarity(novelty)])
        self.near(says["mixture(3)"], model.mixture(h.x + sum(apart, []))[0][2])
        generic = [sum(f * m[i] for f, m in zip(s["predictor"]["lead"][2], apart)) for i in range(3)]
        self.near(says["generic(3)"], generic)
        self.near(says["straight(3)"], predict.straight(predict.velocity(apart)[0], 0.1, predict.PLACE[1]))
        f = predict.place(h, PARAMS, model)
        d, sigma = f.at(0.1)
        self.near(says["fused(0.1)"], [x + c for x, c in zip(h.x, d)])
        v = f.covariance[3]
        self.near(says["fused V(3) diagonal"], [v[0], v[3], v[5]])
        self.near(says["fused V(3) xy xz yz"], [v[1], v[2], v[4]])
        self.near(says["fused sigma(0.1)"], [sigma])
        self.assertEqual(says["fused checksum"], [f"{predict.checksum(h, f):08x}"])


def example():
    """The example skill of §10."""
    j, unit = 3, [[1.0], [0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    e = [-8] * j

    def second(values):
        n = [round(v / 2.0**x) for v, x in zip(values, e)]
        s = [b - a for a, b in zip([0, *n], n)]
        return [b - a for a, b in zip([0, *s], s)]

    def component(weight, first_mean, slope, gain):
        ramp = [0.25 * k for k in range(1, j + 1)]
        zero = [0] * j
        row = [round(0.0625 / (32 * 4.0 ** e[0]))] + zero[1:]
        gains = [zero] * (15 * 3)
        gains[3 * 3] = second([gain * k for k in range(1, j + 1)])
        return {
            "weight": weight, "mean": [round(512 * first_mean)] + [0] * 14,
            "factor": [512 if a == b else 0 for a in range(15) for b in range(a + 1)],
            "target": second([slope * k for k in range(1, j + 1)]) + zero + zero,
            "gain": sum(gains, []), "residual": row + zero + zero + row + zero + row,
        }  # fmt: skip

    return {
        "name": "wave", "duration_s": 2.0, "pace": [0.75, 0.125],
        "motion": [{"weight": 1.0, "mean": [1.0, 0.5, 0.0, 2.0], "covariance": sum(unit, [])}],
        "predictor": {
            "mean": [0.0] * 15, "scale": [0.5] * 15, "bend": [0.125, 0.0], "training": [0.03125, 8.0], "covariance": [2.0] * j, "novelty90": 16.0,
            "errors": [[0.03125, 0.0625, 0.25, 0.5]] * j, "lead": [[0.5 * k, 0.0, 0.125 * k, 0.0] for k in range(1, j + 1)],
            "products": [0.25] * 10, "exponents": e,
            "components": [component(0.75, 0, 0.125, 0.25), component(0.25, 1, -0.0625, 0.5)],
        },
        "turn": None, "grip": None, "task": None,
        "stats": {"speed": 4.0, "accel": 32.0, "reach": 0.5, "lower": [0.0, -0.5, 1.5], "upper": [0.5, 0.5, 2.5]},
        "samples": [60, 58],
        "provenance": {"producer": "example", "seed": 0, "sources": [{"name": "one", "sha256": [0xAB] * 32}]},
    }  # fmt: skip


if __name__ == "__main__":
    unittest.main()
