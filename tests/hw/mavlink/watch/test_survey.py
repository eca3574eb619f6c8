"""The survey of a flight controller, against models of both autopilots with wrong parameters and faults."""

import pytest

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, RadioStatus
from kiteline_hw.mavlink.watch import messages as wire
from kiteline_hw.mavlink.watch.findings import Finding, FindingLevel
from kiteline_hw.mavlink.watch.messages import ParamValue, StatusText
from kiteline_hw.mavlink.watch.presence import LinkState
from kiteline_hw.mavlink.watch.stream_rates import StreamRate
from kiteline_hw.mavlink.watch.survey import ControllerSurvey
from kiteline_hw.sim.autopilot import Faults, ModelledAutopilot

KINDS = ("ardupilot", "px4")
STEP_NS = 5_000_000


def survey(model: ModelledAutopilot, *extra: bytes, delay_steps: int = 1, lost: int = 0) -> list[Finding]:
    """Survey a model over a link with a delay that loses each `lost`-th message (0: none)."""
    asked, codec, now_ns, received, sent = ControllerSurvey("udp:1.2.3.4:14550"), MavlinkCodec(), 7_000_000_000, 0, 0
    on_the_way: list[list[bytes]] = [[] for _ in range(delay_steps)]
    for data in extra:
        for message in codec.receive(data, datagram=True):
            asked.receive(message, now_ns)
    while not asked.done:
        now_ns += STEP_NS
        assert now_ns < 60_000_000_000
        out = [codec.encode(m) for m in asked.step(now_ns, LinkState(received, received))]
        back: list[bytes] = []
        for data in out:
            sent += 1
            if not (lost and sent % lost == 0):
                back += model.receive(data, now_ns)
        on_the_way.append(back + model.poll(now_ns))
        for data in on_the_way.pop(0):
            for message in codec.receive(data, datagram=True):
                received += 1
                for answer in asked.receive(message, now_ns):
                    model.receive(codec.encode(answer), now_ns)
    for message in asked.stop():
        model.receive(codec.encode(message), now_ns)
    return asked.findings()


def topic(found: list[Finding], name: str) -> list[Finding]:
    return [f for f in found if f.topic == name]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lost", [0, 5])
def test_a_controller_that_is_set_up_well(kind: str, lost: int) -> None:
    model = ModelledAutopilot(kind, system=3)  # type: ignore[arg-type]
    found = survey(model, lost=lost)
    assert {f.level for f in found} == {FindingLevel.INFO}, found
    assert "system 3" in topic(found, "heartbeat")[0].text
    count = {"ardupilot": 15, "px4": 9}[kind]
    assert topic(found, "parameters")[0].text == f"{count} are as kiteline needs them"
    assert topic(found, "streams")[0].text.startswith("HIGHRES_IMU: 200 Hz of 200")
    assert "round trip 5.0 ms" in topic(found, "timesync")[0].text or lost
    assert not model._streams  # set back


WRONG = [
    ("ardupilot", {"VISO_TYPE": 0}, FindingLevel.ERROR),
    ("ardupilot", {"VISO_TYPE": 2}, FindingLevel.WARNING),
    ("ardupilot", {"EK3_SRC1_POSXY": 3}, FindingLevel.ERROR),
    ("ardupilot", {"AHRS_EKF_TYPE": 2}, FindingLevel.ERROR),
    ("ardupilot", {"VISO_ORIENT": 4}, FindingLevel.ERROR),
    ("ardupilot", {"VISO_DELAY_MS": 220}, FindingLevel.WARNING),
    ("px4", {"EKF2_EV_CTRL": 0}, FindingLevel.ERROR),
    ("px4", {"EKF2_EV_CTRL": 9}, FindingLevel.WARNING),
    ("px4", {"EKF2_EV_DELAY": 175.0}, FindingLevel.WARNING),
    ("px4", {"EKF2_HGT_REF": 1}, FindingLevel.WARNING),
]


@pytest.mark.parametrize(("kind", "wrong", "level"), WRONG)
def test_each_wrong_parameter_is_named_with_its_value(kind: str, wrong: dict[str, float], level: FindingLevel) -> None:
    found = survey(ModelledAutopilot(kind, parameters=wrong))  # type: ignore[arg-type]
    ((name, value),) = wrong.items()
    (said,) = topic(found, name)
    assert said.level is level
    assert said.text.startswith(f"{name} is {value:g}, expected ") and said.remedy.startswith(f"set {name} to ")


def test_parameters_that_the_firmware_lacks_are_named() -> None:
    found = survey(ModelledAutopilot("px4", parameters={"EKF2_EV_CTRL": None, "EKF2_EV_QMIN": None}))
    assert any("not told: EKF2_EV_CTRL, EKF2_EV_QMIN" in f.text for f in topic(found, "parameters"))


def test_forwarding_to_the_radio() -> None:
    old = survey(ModelledAutopilot("ardupilot", parameters={"SERIAL2_OPTIONS": 0}))
    (said,) = topic(old, "forwarding")
    assert (
        said.level is FindingLevel.WARNING
        and "1024 in SERIALx_OPTIONS" in said.remedy
        and "mavlink: link" in said.remedy
    )
    new = survey(ModelledAutopilot("ardupilot", parameters={"SERIAL2_OPTIONS": 0, "MAV1_OPTIONS": 0}))
    assert "2 in MAVn_OPTIONS" in topic(new, "forwarding")[0].remedy
    quiet = survey(ModelledAutopilot("ardupilot", parameters={"SERIAL2_OPTIONS": 0, "MAV2_OPTIONS": 2}))
    assert topic(quiet, "forwarding")[0].level is FindingLevel.INFO
    px4 = survey(ModelledAutopilot("px4", parameters={"MAV_1_FORWARD": 1}))
    assert "MAV_1_FORWARD is 1" in topic(px4, "forwarding")[0].text
    one = survey(ModelledAutopilot("ardupilot", parameters={"SERIAL2_PROTOCOL": 1}))
    assert "SERIAL2 speaks MAVLink 1" in topic(one, "forwarding")[0].text
    slow = survey(ModelledAutopilot("ardupilot", parameters={"SERIAL2_BAUD": 57}))
    assert any("slower than 115200" in f.text for f in topic(slow, "forwarding"))


def test_faults_of_the_link() -> None:
    silent = survey(ModelledAutopilot("px4", faults=Faults(silent=True)))
    assert [f.level for f in silent] == [FindingLevel.ERROR] and "not found" in silent[0].text
    deaf = survey(ModelledAutopilot("px4", faults=Faults(deaf=True)))
    assert topic(deaf, "timesync")[0].level is FindingLevel.ERROR
    assert topic(deaf, "parameters")[0].text == "no parameter was told"
    fixed = survey(ModelledAutopilot("ardupilot", faults=Faults(fixed_rates=True)))
    assert all("the request was refused" in f.text for f in topic(fixed, "streams"))
    late = survey(ModelledAutopilot("px4"), delay_steps=8)
    assert topic(late, "timesync")[0].level is FindingLevel.WARNING
    mute = survey(ModelledAutopilot("ardupilot", faults=Faults(no_timesync=True)))
    assert topic(mute, "timesync")[0].level is FindingLevel.WARNING


def test_an_armed_vehicle_is_only_listened_to() -> None:
    model = ModelledAutopilot("px4", armed=True)
    found = survey(model)
    assert not model._streams
    assert "armed" in topic(found, "streams")[0].text


def test_radio_and_texts() -> None:
    radio, auto = MavlinkCodec(51, 68), MavlinkCodec(1, 1)
    good = survey(ModelledAutopilot("px4"), radio.encode(RadioStatus(90, 180, 170, 40)))
    assert topic(good, "radio")[0].level is FindingLevel.INFO
    full = survey(ModelledAutopilot("px4"), radio.encode(RadioStatus(10, 180, 170, 40)))
    assert "overloaded" in topic(full, "radio")[0].remedy
    weak = survey(ModelledAutopilot("px4"), radio.encode(RadioStatus(90, 50, 170, 40)))
    assert "weak" in topic(weak, "radio")[0].remedy
    text = survey(
        ModelledAutopilot("ardupilot"),
        auto.encode(Heartbeat(2, 3)),
        auto.encode(StatusText(4, "PreArm: VisOdom: not healthy")),
    )
    assert topic(text, "it says")[0].text == "PreArm: VisOdom: not healthy"


def test_integers_of_px4_are_bytes_and_those_of_ardupilot_values() -> None:
    assert ParamValue.of_px4("EKF2_EV_CTRL", 15).number(wire.PX4) == 15.0
    assert ParamValue("EKF2_EV_DELAY", 12.5, 9).number(wire.PX4) == 12.5
    assert ParamValue("VISO_TYPE", 3.0, 2).number(wire.ARDUPILOT) == 3.0


def test_rate_and_jitter() -> None:
    stream = StreamRate()
    assert stream.rate_hz is None and stream.jitter_ms == 0.0
    for i in range(101):
        stream.add(i * 10_000_000 + (4_000_000 if i % 2 else 0))
    assert stream.rate_hz == pytest.approx(100.0)
    assert stream.jitter_ms == pytest.approx(8.0)
