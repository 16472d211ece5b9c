"""Every message of version 1 (§4, §5), field by field."""

from . import path
from .bits import BitReader, BitWriter
from .codec import (
    F32, I8, I32, I64, U8, U16, U32, U64, Array, Bytes, Enum, Kind, Option, Struct, Text, Vec, WireError, decode, encode, finite,
    require)  # fmt: skip
from .frames import LONGEST
from .state import (
    PARAMS, POSE, ROTATION, STATE, _rotation_range, read_params, read_state, read_turn, write_params, write_state, write_turn)  # fmt: skip

DATAGRAM = 1100
ID = Array(U8, 16)


class Knots(Bytes):
    """Knots as bits: a block's number of knots is looked at with the message, all else once the path before it is there."""

    def __init__(self, most):
        super().__init__(DATAGRAM if most == 32 else LONGEST)
        self.knots = most

    def check(self, value):
        try:
            n = path.count(value)
        except WireError as e:
            raise WireError("Invalid", str(e)) from None
        require(n <= self.knots, "knots", n)


STATES = Enum("Idle", "Ready", "Engaged", "Coasting", "Holding", "Stopped")
CAUSES = Enum(
    "Requested", "NewsArrived", "NewsLate", "LeaseExpired", "PlanFinished",
    "ConnectionLost", "OperatorStop", "LocalStop", "ClockStep", "Fault", "ArmFault",
)  # fmt: skip
REASONS = Enum(
    "Stopped", "AlreadyEngaged", "OldEngagement", "StaleReference", "ClockUnknown", "BadModel",
    "BadPlan", "BadMapping", "Moving", "Diverged", "NotYours",
)  # fmt: skip


def _engage(m):
    finite("scale", m["scale"], m["rotation"])
    require(0 < m["scale"] <= 10, "scale", m["scale"])
    require(abs(sum(c * c for c in m["rotation"]) - 1) <= 1e-3, "rotation", m["rotation"])
    require(m["path_bound_um"] > 0, "path_bound_um", 0)
    require(m["path_turn_bound_urad"] <= 3_141_592, "path_turn_bound_urad", m["path_turn_bound_urad"])
    require(1 <= m["sample_us"] <= 1_000_000, "sample_us", m["sample_us"])


def _info(m):
    for name in ("speed_m_s", "accel_m_s2", "radius_m"):
        finite(name, m[name])
        require(m[name] > 0, name, m[name])
    require(0 <= m["lag_s"] <= 2, "lag_s", m["lag_s"])


def _engaged(m):
    finite("Engaged", m["hand_m"], m["tip_m"])
    if m["hand_q"] is not None:
        _rotation_range("hand_q")(m)
    _rotation_range("tip_q")(m)


def _unit(what, numbers):
    require(abs(sum(n * n for n in numbers) - 1) < 1e-3, what, numbers)


def _place(m):
    require(all(abs(n) <= 100 for n in m["m"]), "m", m["m"])
    _unit("q", m["q"])


def _joint(m):
    _unit("axis", m["axis"])
    if m["limits"] is not None:
        finite("limits", m["limits"])
        require(m["limits"][0] <= m["limits"][1], "limits", m["limits"])


def _arm(m):
    for capsule in m["capsules"]:
        require(all(abs(n) <= 100 for n in capsule["from"] + capsule["to"]), "capsule", capsule)
        require(0 < capsule["radius_m"] <= 100, "radius_m", capsule["radius_m"])
        require(capsule["link"] <= len(m["joints"]), "link", capsule["link"])


def _telemetry(m):
    finite("Telemetry", m["tip_m"], m["q"])
    _rotation_range("tip_q")(m)


def _bend(b):
    require(abs(b["plan_us"]) <= (2**63 - 1) // 1000, "plan_us", b["plan_us"])
    require(b["rate"] <= 192, "rate", b["rate"])
    require(all(abs(n) <= 1_000_000 for n in b["left"]), "left", b["left"])


def _held(h):
    for i, n in enumerate(h["weight"]):
        low, high = (0, 127) if i in (0, 2, 5) else (-64, 64)
        require(low <= n <= high, "weight", h["weight"])


HELD = Struct(("state", STATE), ("gain", U8), ("straight", U8), ("weight", Array(I8, 6)), check=_held)
BEND = Struct(("plan_us", I64), ("rate", U8), ("left", Array(I32, 3)), ("held", Option(HELD)), check=_bend)
DRIVE = Enum(
    ("Mirror", Struct(("state", STATE), ("model", U16), ("params", PARAMS), ("pose", POSE))),
    ("Play", Struct(("plan", U32))),
)
PLACE = Struct(("m", Array(F32, 3)), ("q", Array(F32, 4)), check=_place)
JOINT = Struct(
    ("place", PLACE), ("axis", Array(F32, 3)), ("kind", Enum("Revolute", "Prismatic")), ("limits", Option(Array(F32, 2))),
    check=_joint)  # fmt: skip
CAPSULE = Struct(("link", U8), ("from", Array(F32, 3)), ("to", Array(F32, 3)), ("radius_m", F32))
OPERATOR_CONTROL = Enum(
    ("Model", Struct(("id", ID), ("bytes", Bytes(524_288)))),
    ("Plan", Struct(("id", U32), ("bytes", Bytes(131_072)))),
    ("Engage", Struct(
        ("engagement", U32), ("t_us", I64), ("drive", DRIVE), ("scale", F32), ("rotation", Array(F32, 4)),
        ("path_bound_um", U32), ("path_turn_bound_urad", U32), ("sample_us", U32), ("lease_ms", U16), check=_engage)),
    ("Path", Struct(("engagement", U32), ("state", STATE), ("first_knot", U32), ("knots", Knots(1024)))),
    ("Release", Struct(("engagement", U32))),
    "EmergencyStop",
    ("Reset", Struct(("changes", U32))),
    "Goodbye",
)  # fmt: skip
ROBOT_CONTROL = Enum(
    ("Info", Struct(
        ("name", Text(64)), ("joints", U8), ("speed_m_s", F32), ("accel_m_s2", F32), ("radius_m", F32), ("lag_s", F32),
        ("model", Option(ID)), ("state", STATES), check=_info)),
    ("ModelStored", Struct(("id", ID))),
    ("PlanStored", Struct(("id", U32))),
    ("Engaged", Struct(
        ("engagement", U32), ("t_us", I64), ("hand_m", Array(F32, 3)), ("tip_m", Array(F32, 3)),
        ("hand_q", Option(ROTATION)), ("tip_q", ROTATION), check=_engaged)),
    ("Refused", Struct(("reason", REASONS))),
    ("State", Struct(("state", STATES), ("cause", CAUSES), ("changes", U32))),
    ("Arm", Struct(("joints", Vec(JOINT, 10)), ("tip", PLACE), ("capsules", Vec(CAPSULE, 64)), check=_arm)),
)  # fmt: skip


class Motion(Kind):
    """The one message of bits (§5)."""

    FIELDS = Struct(
        ("epoch", U32), ("engagement", U32), ("seq", U32), ("lease_ms", U16), ("model", U16), ("params", PARAMS),
        ("checksum", Option(U32)), ("state", STATE), ("pose", POSE), ("first_knot", U32), ("knots", Knots(32)))  # fmt: skip

    def check(self, m):
        self.FIELDS.check(m)

    def read(self, r):
        b = BitReader(r.data)
        checksum, model, turn, grip, knots = (b.bits(1) for _ in range(5))
        b.bits(3)
        m = {"epoch": _number(b, 3), "engagement": _number(b, 3), "seq": _number(b, 8), "lease_ms": 10 * b.bits(8)}
        m["model"] = b.bits(16) if model else 0
        m["params"] = read_params(b)
        m["checksum"] = b.bits(32) if checksum else None
        m["state"] = read_state(b)
        m["pose"] = {"turn": read_turn(b) if turn else None, "grip": b.bits(8) if grip else None}
        m["first_knot"] = _number(b, 8) if knots else 0
        r.at = (b.at + 7) // 8
        m["knots"] = bytes(r.take(len(r.data) - r.at)) if knots else b""
        return m

    def write(self, m, out):
        b, turn, grip = BitWriter(), m["pose"]["turn"], m["pose"]["grip"]
        for has in (m["checksum"] is not None, m["model"] != 0, turn is not None, grip is not None, bool(m["knots"])):
            b.bits(int(has), 1)
        b.bits(0, 3)
        b.golomb(m["epoch"], 3)
        b.golomb(m["engagement"], 3)
        b.golomb(m["seq"], 8)
        b.bits(min(m["lease_ms"] // 10, 255), 8)
        if m["model"]:
            b.bits(m["model"], 16)
        write_params(b, m["params"])
        if m["checksum"] is not None:
            b.bits(m["checksum"], 32)
        write_state(b, m["state"])
        if turn is not None:
            write_turn(b, turn)
        if grip is not None:
            b.bits(grip, 8)
        if m["knots"]:
            b.golomb(m["first_knot"], 8)
        out += b.bytes() + m["knots"]


def _number(b, order):
    n = b.golomb(order)
    if n >> 32:
        raise WireError("Malformed", f"{n} is more than 32 bits")
    return n


class OperatorDatagram(Enum):
    """A motion, if the low three bits of the first byte are 0; else the first byte is the variant's index (§5)."""

    def read(self, r):
        if r.data and r.data[0] % 8 and r.data[0] >= len(self.variants):
            raise WireError("Malformed", f"no message {r.data[0]}")
        if r.data and r.data[0] % 8 == 0:
            return {"Motion": MOTION.read(r)}
        return super().read(r)

    def write(self, value, out):
        if "Motion" in value:
            MOTION.write(value["Motion"], out)
        else:
            super().write(value, out)


MOTION = Motion()
OPERATOR_DATAGRAM = OperatorDatagram(
    ("Motion", MOTION),
    ("Go", Struct(
        ("epoch", U32), ("engagement", U32), ("seq", U32), ("t_us", I64), ("lease_ms", U16), ("bend", Option(BEND)))),
    ("Pong", Struct(("epoch", U32), ("t1_us", I64), ("t2_us", I64), ("t3_us", I64))),
    ("Stop", Struct(("epoch", U32))),
    ("Clock", Struct(("epoch", U32), ("clock", Struct(("ahead_us", I64), ("dispersion_us", U32))))),
)  # fmt: skip
ROBOT_DATAGRAM = Enum(
    ("Ping", Struct(("epoch", U32), ("t1_us", I64))),
    ("Telemetry", Struct(
        ("epoch", U32), ("seq", U32), ("state", STATES), ("engagement", U32), ("t_us", I64), ("clock_uncertainty_us", U32),
        ("age_ms", U16), ("delay_ms", U16), ("path_frontier", U32), ("received", U32), ("newest_seq", U32), ("dropped", U32),
        ("clamps", U32), ("tip_m", Array(F32, 3)),
        ("tip_q", ROTATION), ("grip", Option(U8)), ("q", Vec(F32, 10)), check=_telemetry)),
    ("Reception", Struct(
        ("epoch", U32), ("newest_seq", U32), ("received", U32), ("duplicates", U32), ("reordered", U32), ("loss_runs", U32),
        ("longest_loss_run", U32), ("jitter_us", U32), ("delay_us", Array(U32, 4)), ("age_us", Array(U32, 4)))),
    ("Servo", Struct(
        ("epoch", U32), ("ticks", U64), ("overruns", U32), ("mean_ns", U32), ("work_ns", Array(U32, 4)), ("wake_ns", Array(U32, 4)))),
)  # fmt: skip

# Who sends what, and how long it may be.
KINDS = {
    "operator control": (OPERATOR_CONTROL, LONGEST),
    "robot control": (ROBOT_CONTROL, LONGEST),
    "operator datagram": (OPERATOR_DATAGRAM, DATAGRAM),
    "robot datagram": (ROBOT_DATAGRAM, DATAGRAM),
}


def read(kind, data):
    """The message of one of KINDS."""
    return decode(KINDS[kind][0], data, KINDS[kind][1])


def write(kind, message):
    """The bytes of a message of one of KINDS."""
    return encode(KINDS[kind][0], message)
