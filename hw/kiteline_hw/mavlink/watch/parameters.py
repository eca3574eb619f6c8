"""The parameters of ArduPilot and PX4 that decide whether poses are used, and what they should be. Pure."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from kiteline_hw.mavlink.watch.findings import Finding, FindingLevel
from kiteline_hw.mavlink.watch.messages import ARDUPILOT, PX4

TOPIC, FORWARD_TOPIC = "parameters", "forwarding"
_NO_FORWARD = 1024  # in SERIALx_OPTIONS
_NO_FORWARD_4_7 = 2  # in MAVn_OPTIONS; n counts MAVLink ports, it is not x
_MAVLINK_1, _MAVLINK_2 = 1, 2  # SERIALx_PROTOCOL
_LEAST_BAUD = 115  # SERIALx_BAUD in thousands; 30 poses a second take 7.5 kB/s
_SERIAL_PORTS = range(1, 7)
_CHANNELS = range(1, 5)
_INSTANCES = range(3)


@dataclass(frozen=True, slots=True)
class Rule:
    """What a parameter should be. needed: without it poses are ignored or wrong. want: the value in words."""

    name: str
    good: Callable[[float], bool]
    want: str
    why: str
    needed: bool = True


def _is(*values: float) -> Callable[[float], bool]:
    return lambda value: any(abs(value - v) < 1e-6 for v in values)


def _has(bit: int) -> Callable[[float], bool]:
    return lambda value: bool(int(value) & bit)


RULES: Mapping[int, tuple[Rule, ...]] = {
    ARDUPILOT: (
        Rule("AHRS_EKF_TYPE", _is(3), "3", "EKF3 is the filter that takes poses"),
        Rule("EK3_ENABLE", _is(1), "1", "EKF3 is the filter that takes poses"),
        Rule("VISO_TYPE", _is(1, 2, 3), "3", "ODOMETRY is dropped; restart the controller after the change"),
        Rule("VISO_TYPE", _is(3), "3", "1 and 2 do not continue after a second restart of the agent", needed=False),
        Rule("VISO_ORIENT", _is(0), "0", "poses are in the vehicle's axes already"),
        Rule("VISO_SCALE", _is(1), "1", "poses are in metres"),
        Rule("VISO_DELAY_MS", lambda v: 0 <= v <= 100, "what the agent says", "poses are rarely so late", needed=False),
        Rule("VISO_QUAL_MIN", lambda v: v <= 50, "at most 50", "good poses are dropped too", needed=False),
        Rule("VISO_POS_X", _is(0), "0", "an offset is applied by the agent", needed=False),
        Rule("VISO_POS_Y", _is(0), "0", "an offset is applied by the agent", needed=False),
        Rule("VISO_POS_Z", _is(0), "0", "an offset is applied by the agent", needed=False),
        Rule("EK3_SRC1_POSXY", _is(6), "6 (external navigation)", "positions are ignored"),
        Rule("EK3_SRC1_VELXY", _is(6), "6", "velocities are ignored", needed=False),
        Rule("EK3_SRC1_POSZ", _is(6, 1), "6, or 1 (barometer)", "heights have another source", needed=False),
        Rule("EK3_SRC1_VELZ", _is(6, 0), "6, or 0", "climb rates have another source", needed=False),
        Rule("EK3_SRC1_YAW", _is(6, 1), "6, or 1 (compass)", "the heading has another source", needed=False),
    ),
    PX4: (
        Rule("EKF2_EN", _is(1), "1", "EKF2 is the filter that takes poses"),
        Rule("EKF2_EV_CTRL", _has(1), "15", "horizontal positions are ignored"),
        Rule("EKF2_EV_CTRL", _has(2), "15", "heights are ignored", needed=False),
        Rule("EKF2_EV_CTRL", _has(4), "15", "velocities are ignored", needed=False),
        Rule("EKF2_HGT_REF", _is(0, 3), "3 (vision), or 0 (barometer)", "heights have another reference", needed=False),
        Rule("EKF2_EV_DELAY", lambda v: abs(v) <= 10, "0", "TIMESYNC converts the stamps: a delay counts twice", False),
        Rule("EKF2_EV_POS_X", _is(0), "0", "an offset is applied by the agent", needed=False),
        Rule("EKF2_EV_POS_Y", _is(0), "0", "an offset is applied by the agent", needed=False),
        Rule("EKF2_EV_POS_Z", _is(0), "0", "an offset is applied by the agent", needed=False),
        Rule("EKF2_EV_NOISE_MD", _is(0), "0", "the covariances of the poses are not used", needed=False),
        Rule("EKF2_EV_QMIN", lambda v: v >= 1, "1 to 50", "poses that are not tracked are used, too", needed=False),
        Rule("EKF2_EV_QMIN", lambda v: v <= 50, "1 to 50", "good poses are dropped too", needed=False),
    ),
}  # fmt: skip


def names(autopilot: int) -> list[str]:
    """The parameters to read of a flight controller (MAV_AUTOPILOT)."""
    wanted = list(dict.fromkeys(rule.name for rule in RULES.get(autopilot, ())))
    if autopilot == ARDUPILOT:
        wanted += [f"SERIAL{n}_{part}" for n in _SERIAL_PORTS for part in ("PROTOCOL", "BAUD", "OPTIONS")]
        wanted += [f"MAV{n}_OPTIONS" for n in _CHANNELS]
    elif autopilot == PX4:
        wanted += [f"MAV_{n}_{part}" for n in _INSTANCES for part in ("CONFIG", "FORWARD")]
    return wanted


def compare(autopilot: int, values: Mapping[str, float]) -> list[Finding]:
    """Findings about wrong parameters, worst first; a single one that says so if all are right."""
    rules = [rule for rule in RULES.get(autopilot, ()) if rule.name in values]
    wrong = [
        Finding(
            rule.name, FindingLevel.ERROR if rule.needed else FindingLevel.WARNING,
            f"{rule.name} is {values[rule.name]:g}, expected {rule.want}: {rule.why}", "",
            f"set {rule.name} to {rule.want}",
        )
        for rule in rules
        if not rule.good(values[rule.name])
    ]  # fmt: skip
    said: dict[str, Finding] = {}
    for finding in sorted(wrong, key=lambda f: f.level):
        said.setdefault(finding.topic, finding)
    wanted = {rule.name for rule in RULES.get(autopilot, ())}
    if not rules:
        text = "no parameter was told" if wanted else "this firmware has no table here"
        return [
            Finding(TOPIC, FindingLevel.WARNING, text, "", "is the link good in both directions?" if wanted else "")
        ]
    out = list(said.values())
    if not any(f.level is FindingLevel.ERROR for f in out):
        fine = len({rule.name for rule in rules} - set(said))
        out.append(Finding(TOPIC, FindingLevel.INFO, f"{fine} are as kiteline needs them", ""))
    if missing := sorted(wanted - set(values)):
        text = f"not told: {', '.join(missing)}"
        out.append(Finding(TOPIC, FindingLevel.WARNING, text, "", "this firmware may lack them: update it"))
    return out


def compare_forwarding(autopilot: int, values: Mapping[str, float]) -> list[Finding]:
    """Whether the port to this computer keeps ODOMETRY off the telemetry radio, and is fast enough."""
    if autopilot == ARDUPILOT:
        return _ardupilot_ports(values)
    return _px4_ports(values) if autopilot == PX4 else []


def _ardupilot_ports(values: Mapping[str, float]) -> list[Finding]:
    ports = {n: values.get(f"SERIAL{n}_PROTOCOL") for n in _SERIAL_PORTS}
    out = [
        Finding(
            FORWARD_TOPIC, FindingLevel.WARNING, f"SERIAL{n} speaks MAVLink 1, which has no ODOMETRY", "",
            f"if it leads here: set SERIAL{n}_PROTOCOL to 2",
        )
        for n, protocol in ports.items() if protocol == _MAVLINK_1
    ]  # fmt: skip
    carrying = [n for n, protocol in ports.items() if protocol in (_MAVLINK_1, _MAVLINK_2)]
    quiet = [f"SERIAL{n}" for n in carrying if int(values.get(f"SERIAL{n}_OPTIONS", 0)) & _NO_FORWARD]
    quiet += [f"MAV{n}" for n in _CHANNELS if int(values.get(f"MAV{n}_OPTIONS", 0)) & _NO_FORWARD_4_7]
    slow = [n for n in carrying if 0 < values.get(f"SERIAL{n}_BAUD", 1e3) < _LEAST_BAUD]
    listed = ", ".join(f"SERIAL{n}" for n in carrying) or "no serial port"
    if quiet:
        text = f"MAVLink on {listed}; {', '.join(quiet)} does not forward"
        out.append(
            Finding(
                FORWARD_TOPIC,
                FindingLevel.INFO,
                text,
                "",
                "that must be the port here; a mavlink: link needs forwarding",
            )
        )
    else:
        new = any(f"MAV{n}_OPTIONS" in values for n in _CHANNELS)
        bit = f"{_NO_FORWARD_4_7} in MAVn_OPTIONS" if new else f"{_NO_FORWARD} in SERIALx_OPTIONS"
        text = f"MAVLink on {listed}; each forwards, so ODOMETRY also goes out on the telemetry radio"
        remedy = f"set {bit} of the port here (unless a mavlink: link goes through it: that ends it)"
        out.append(Finding(FORWARD_TOPIC, FindingLevel.WARNING, text, "", remedy))
    if slow and len(slow) == len(carrying):
        text = f"each MAVLink port is slower than {_LEAST_BAUD}200 baud: 30 poses a second take 7.5 kB/s"
        out.append(Finding(FORWARD_TOPIC, FindingLevel.WARNING, text, "", "set SERIALx_BAUD of the port here to 921"))
    return out


def _px4_ports(values: Mapping[str, float]) -> list[Finding]:
    used = [n for n in _INSTANCES if values.get(f"MAV_{n}_CONFIG", 0) > 0]
    forwarding = [f"MAV_{n}_FORWARD" for n in used if values.get(f"MAV_{n}_FORWARD", 0) > 0]
    if forwarding:
        text = f"{', '.join(forwarding)} is 1: ODOMETRY also goes out on the telemetry radio"
        remedy = "set it to 0 for the port here (unless a mavlink: link goes through it: that needs forwarding)"
        return [Finding(FORWARD_TOPIC, FindingLevel.WARNING, text, "", remedy)]
    if not used:
        return [Finding(FORWARD_TOPIC, FindingLevel.INFO, "no serial MAVLink instance, so none forwards", "")]
    listed = ", ".join(f"MAV_{n}" for n in used)
    return [Finding(FORWARD_TOPIC, FindingLevel.INFO, f"MAVLink on {listed}; none forwards", "")]
