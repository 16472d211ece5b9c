"""tests/vectors/wire_v1.json: what the other implementation says of version 1, and what it rejects."""

import json
import math
import pathlib
import unittest

from telemime import bend, codec, frames, greeting, messages, pairing, path, plan, predict, rotation, skill, state

FILE = pathlib.Path(__file__).resolve().parents[1] / "vectors" / "wire_v1.json"
VECTORS = json.loads(FILE.read_text(encoding="utf-8"))["vectors"]
GREETINGS = {"operator greeting": greeting.OPERATOR, "robot greeting": greeting.ROBOT}


def plain(value):
    """As JSON has it: bytes as lists of numbers, tuples as lists."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, tuple, bytes)) else value


def decode(kind, data):
    """The value of bytes of a kind. Raises WireError."""
    if kind in messages.KINDS:
        return messages.read(kind, data)
    if kind in GREETINGS:
        return greeting.parse(data, GREETINGS[kind])[0]
    if kind == "pairing":
        return pairing.parse(data)[0]
    if kind == "frame":
        payload, ignorable, _ = frames.parse(data)
        return {"payload": payload.hex(), "ignorable": ignorable}
    if kind == "skill":
        return skill.read(data)
    item, limit = {
        "u64": (codec.U64, 16), "i64": (codec.I64, 16), "plan": (plan.PLAN, plan.LONGEST), "state": (state.STATE, 1100),
        "turn": (state.TURN, 1100), "bend": (messages.BEND, 1100)}[kind]  # fmt: skip
    return codec.decode(item, data, limit)


class Vectors(unittest.TestCase):
    def each(self, *kinds):
        """(bytes, value) of the vectors of these kinds; a failure says which one it was."""
        found = [v for v in VECTORS if v["kind"] in kinds and "value" in v]
        self.assertTrue(found, kinds)
        for v in found:
            self.current = f"{v['kind']}: {v['name']}"
            yield bytes.fromhex(v["hex"]), v["value"]

    def _formatMessage(self, msg, standard):
        return super()._formatMessage(f"{getattr(self, 'current', '')} {msg or ''}", standard)

    def near(self, said, ours):
        """The same within 10⁻⁹ of the larger of it and 1, whatever its shape."""
        if isinstance(said, list):
            self.assertEqual(len(said), len(ours))
            for a, b in zip(said, ours):
                self.near(a, b)
        else:
            self.assertTrue(math.isclose(said, ours, rel_tol=1e-9, abs_tol=1e-9), (said, ours))

    def same_rotation(self, said, ours):
        self.near(said, [math.copysign(1, ours[0]) * c for c in ours])

    def test_messages(self):
        for kind in ["u64", "i64", "frame", *GREETINGS, *messages.KINDS]:
            for data, value in self.each(kind):
                self.assertEqual(plain(decode(kind, data)), value)
                if kind in messages.KINDS:
                    self.assertEqual(messages.write(kind, decode(kind, data)), data)

    def test_rejects(self):
        rejects = [v for v in VECTORS if "error" in v]
        self.assertGreater(len(rejects), 50)
        for v in rejects:
            with self.subTest(v["kind"], name=v["name"]):
                with self.assertRaises(codec.WireError) as caught:
                    decode(v["kind"], bytes.fromhex(v["hex"]))
                self.assertEqual(caught.exception.name, v["error"], caught.exception)

    def test_states(self):
        for data, value in self.each("state"):
            h = state.Hand.of_wire(decode("state", data))
            self.near([value["x"], value["m"]], [h.x, h.m])
            # From 0 on: far from it a difference of times has fewer digits.
            h.t, after = 0.0, value["next"]
            self.near(after["m"], h.next(after["after_us"] * 1e-6, after["x"]).m)

    def test_turns(self):
        for data, value in self.each("turn"):
            t, h = state.Turn.of_wire(decode("turn", data)), state.Hand(0.0, [0.0] * 3)
            self.same_rotation(value["q"], t.q)
            after = value["next"]
            n = t.next(h, after["after_us"] * 1e-6, rotation.exp(after["rotation_vector"]))
            for said, ours in zip(value["m"] + after["m"], t.m + n.m):
                self.same_rotation(said, ours)

    def foretold(self, datagram, value, model=None, turn_model=None):
        m = messages.read("operator datagram", datagram)["Motion"]
        h = state.Hand.of_wire(m["state"])
        place, turn, turning = predict.place(h, m["params"], model), None, None
        if m["pose"]["turn"]:
            turn = state.Turn.of_wire(m["pose"]["turn"])
            turning = predict.turning(turn, m["pose"]["turn"]["params"], turn_model)
        for at in value["ahead"]:
            d, sigma = place.at(at["h_s"])
            self.near([at["x"], at["sigma_m"]], [[a + b for a, b in zip(h.x, d)], sigma])
            if turn:
                d, sigma = turning.at(at["h_s"])
                self.same_rotation(at["q"], rotation.mul(turn.q, rotation.exp(d)))
                self.near(at["sigma_rad"], sigma)
        self.assertEqual(value["checksum"], predict.checksum(h, place, turning))

    def test_constant_velocity(self):
        for data, value in self.each("constant velocity"):
            self.foretold(data, value)

    def test_skills(self):
        for data, value in self.each("skill"):
            s = skill.read(data)
            self.assertEqual(skill.write(s), data)
            head, tag = skill.identity(data)
            self.assertEqual((s["name"], s["duration_s"], head.hex(), tag), tuple(value[k] for k in ("name", "duration_s", "id", "tag")))
            model = predict.Model(s["predictor"])
            self.assertEqual(model.knots, value["knots"])
            turn = s["turn"] and predict.Model(s["turn"]["predictor"], s["turn"]["charts"])
            for told in value["foretold"]:
                self.foretold(bytes.fromhex(told["motion"]), told["foretold"], model, turn)

    def test_bends(self):
        for data, value in self.each("bend"):
            b = decode("bend", data)
            for at in value["at"]:
                self.near(at["plan_s"], bend.plan_time(b, at["h_s"]))
                self.near(at["offset_m"], bend.offset(b, at["h_s"], at["k_s"]))

    def test_pairing(self):
        for data, value in self.each("pairing"):
            message, used = pairing.parse(data)
            self.assertEqual((used, pairing.encode(message)), (len(data), data))
            self.assertEqual(message if isinstance(message, str) else {
                name: {k: v.hex() if isinstance(v, bytes) else v for k, v in fields.items()}
                for name, fields in message.items()}, value)  # fmt: skip

    def test_paths(self):
        for data, value in self.each("path"):
            grid = path.Grid(value["path_bound_um"], value["sample_us"], value["path_turn_bound_urad"])
            m = messages.read("operator control", data)["Path"]
            knots = [path.Knot(*k) for k in value["knots"]]
            held, sent = knots[: value["before"]], knots[value["before"] :]
            found = path.decode(m["state"], m["knots"], grid, held)
            self.assertEqual([k.plain() for k in found], [k.plain() for k in sent])
            self.assertEqual(path.encode(m["state"], sent, grid, held), m["knots"])
            joined = [(a, b) for a, b in zip(knots, knots[1:]) if not b.start]
            for (a, b), at in zip(joined, value["at"], strict=True):
                x, v = path.evaluate(a, b, grid, at["t_ns"])
                self.near([at["x"], at["v"]], [x[:3], v[:3]])
                if at["q"] is not None:
                    self.near(at["q"], path.orientation(x))

    def test_plans(self):
        for data, value in self.each("plan"):
            p = decode("plan", data)
            self.assertEqual(plain(p), {k: value[k] for k in ("position", "turn", "grip")})
            curves = plan.Curves(p)
            for at in value["at"]:
                x, v, a = curves.position.at(at["t_s"])
                self.near(at["x"], x)
                if at["v"]:
                    self.near([at["v"], at["a"]], [v, a])
                if at["q"]:
                    self.near(at["q"], curves.orientation(at["t_s"]))
                    self.near(at["grip"], curves.opening(at["t_s"]))


if __name__ == "__main__":
    unittest.main()
