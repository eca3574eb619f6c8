"""What is said about modelled ArduPilot and PX4, with the faults that users have."""

from collections.abc import Callable
from dataclasses import replace
from math import radians, sin

import numpy as np
import pytest

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_session import ControllerSession
from kiteline_hw.mavlink.coordinate_frames import R_L_O, mounting
from kiteline_hw.mavlink.messages import Heartbeat
from kiteline_hw.mavlink.watch.attitude import CANDIDATES, attitude_rotation
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.mavlink.watch.findings import Finding, FindingLevel, FindingLog
from kiteline_hw.mavlink.watch.latency import LatencyWatch
from kiteline_hw.ports import PoseSample
from kiteline_hw.sim.autopilot import Faults, ModelledAutopilot

S = 1_000_000_000
STEP_NS = 20_000_000
LATENCY_NS = 30_000_000
KINDS = ("ardupilot", "px4")
Angles = tuple[float, float, float]


def carried(t_s: float) -> Angles:
    """Roll, pitch, yaw of a vehicle that is carried about by hand."""
    return radians(12.0) * sin(1.9 * t_s), radians(10.0) * sin(1.3 * t_s + 1.0), radians(40.0) * sin(0.7 * t_s)


def still(t_s: float) -> Angles:
    """A vehicle on level ground."""
    return 0.0, 0.0, 0.3


class Bench:
    """A session with its watch, and a modelled controller in a vehicle that turns as `motion` says.

    used, true: axes that the agent was told, and those by which its body is mounted. heading: of the odometry frame.
    """

    def __init__(
        self, controller: ModelledAutopilot, *, used: str = "flu", true: str = "flu",
        motion: Callable[[float], Angles] = carried, url: str = "udp:1.2.3.4:14550",
    ) -> None:  # fmt: skip
        self.controller, self.motion = controller, motion
        self.watch = ControllerWatch(mounting(used), url)
        self.session = ControllerSession(mounting(used), watch=self.watch)
        self.T_b_f = mounting(true)
        self.now_ns = 5 * S
        self.found: list[tuple[float, Finding]] = []
        self.device_fault = ""
        self.rng = np.random.default_rng(1)
        self.R_l_n: F64 = np.asarray(se3.so3_exp(np.array([0.0, 0.0, 1.1])))  # our heading is not the compass's

    def pose(self, t_ns: int, quality: int) -> PoseSample:
        noise = se3.so3_exp(self.rng.normal(0.0, 0.003, 3))
        r_l_f = self.R_l_n @ attitude_rotation(self.motion(t_ns / S)) @ noise
        T_o_b = np.eye(4)
        T_o_b[:3, :3] = R_L_O.T @ r_l_f @ self.T_b_f[:3, :3].T
        return PoseSample(t_ns, T_o_b, quality > 0, quality)

    def run(self, seconds: float, *, poses: bool = True, quality: int = 80) -> list[Finding]:
        """Fly on; what was found."""
        start = len(self.found)
        for i in range(round(seconds * S / STEP_NS)):
            self.now_ns += STEP_NS
            out = self.session.step(self.pose(self.now_ns - LATENCY_NS, quality) if poses and i % 2 == 0 else None,
                                    self.now_ns)  # fmt: skip
            out += self.session.watch(self.now_ns, self.device_fault)
            self.controller.angles_rad = self.motion(self.now_ns / S)
            back = [a for m in out for a in self.controller.receive(m, self.now_ns)]
            for data in back + self.controller.poll(self.now_ns):
                for answer in self.session.receive(data, self.now_ns, datagram=True):
                    self.controller.receive(answer, self.now_ns)
            self.found += [(self.now_ns / S - 5.0, f) for f in self.watch.take()]
        return [f for _, f in self.found[start:]]

    def texts(self) -> list[str]:
        return [f.text for _, f in self.found]

    def topic(self, topic: str) -> list[Finding]:
        return [f for _, f in self.found if f.topic == topic]


@pytest.mark.parametrize("kind", KINDS)
def test_a_good_flight_says_each_thing_once(kind: str) -> None:
    bench = Bench(ModelledAutopilot(kind, system=7))  # type: ignore[arg-type]
    bench.run(25.0)
    assert sorted(f.topic for _, f in bench.found) == ["axes", "controller", "latency", "poses"]
    assert {f.level for _, f in bench.found} == {FindingLevel.INFO}
    name = {"ardupilot": "ArduPilot", "px4": "PX4"}[kind]
    assert bench.topic("controller")[0].text == f"flight controller: found: {name} 4.6.3, quadrotor, system 7"
    assert "axes flu are right" in bench.topic("axes")[0].text
    assert "uses them" in bench.topic("poses")[0].text
    delay = {"ardupilot": "VISO_DELAY_MS 30", "px4": "EKF2_EV_DELAY 0"}[kind]
    assert delay in bench.topic("latency")[0].text
    # each goes out as STATUSTEXT too, whole
    assert sorted(m.text for m in bench.controller.texts) == sorted(f.short for _, f in bench.found)
    assert all(len(f.short) <= 50 and f.short.startswith("kiteline: ") for _, f in bench.found)


def test_a_delay_that_changes_little_is_said_once() -> None:
    log = FindingLog()
    watch = LatencyWatch(log)
    for delay_ms in (30, 36, 30, 41):
        for _ in range(watch.config.poses):
            watch.sent(delay_ms * 1_000_000, 3)
    assert [f.short for f in log.take()] == ["kiteline: set VISO_DELAY_MS 30", "kiteline: set VISO_DELAY_MS 41"]


@pytest.mark.parametrize("true", sorted(CANDIDATES))
def test_wrong_axes_are_named_within_five_seconds_of_motion(true: str) -> None:
    others = [used for used in ("flu", "urf") if used != true]
    for used in (others[sorted(CANDIDATES).index(true) % len(others)], *({"flu", "urf"} & {true})):
        bench = Bench(ModelledAutopilot("ardupilot"), used=used, true=true)
        bench.run(5.0)
        said = bench.topic("axes")
        if used == true:
            assert not said or (said[-1].level is FindingLevel.INFO and used in said[-1].text)
        else:
            assert said[-1].level is FindingLevel.ERROR
            assert said[-1].remedy.endswith(f"--axes {true}")
            assert f"--axes {used} are wrong" in said[-1].text


def test_wrong_axes_hold_poses_back_until_they_fit_and_arming_does_not_change_that() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"), used="flu", true="lbu")
    bench.run(6.0)
    assert bench.topic("held")[-1].level is FindingLevel.ERROR
    sent = bench.session.counters.odometry
    bench.controller.armed = True
    bench.run(6.0)
    assert bench.session.counters.odometry == sent and bench.session.counters.held > 100
    bench.T_b_f = mounting("flu")  # the camera is turned
    bench.run(40.0)
    assert bench.session.counters.odometry > sent + 100
    assert [f.level for f in bench.topic("held")] == [FindingLevel.ERROR, FindingLevel.INFO]


def test_a_controller_that_restarts_does_not_release_poses_by_wrong_axes() -> None:
    """What was known of the axes is forgotten then; that they fit is not known."""
    bench = Bench(ModelledAutopilot("ardupilot"), used="flu", true="lbu")
    bench.run(12.0)
    sent = bench.session.counters.odometry
    bench.controller.reboot()
    bench.motion = still
    bench.run(10.0)
    assert len(bench.topic("restart")) == 1
    assert bench.session.counters.odometry == sent
    assert [f.level for f in bench.topic("held")] == [FindingLevel.ERROR]


def test_a_vehicle_that_flies_goes_on_getting_poses_by_wrong_axes() -> None:
    """Poses that end in flight are a failsafe, too: the pilot is told, and decides."""
    bench = Bench(ModelledAutopilot("ardupilot", armed=True), used="flu", true="lbu")
    bench.run(8.0)
    assert "are wrong" in bench.topic("axes")[-1].text
    assert not bench.topic("held") and bench.session.counters.odometry > 190


def test_on_the_ground_axes_are_wrong_as_far_as_gravity_tells() -> None:
    upside_down = Bench(ModelledAutopilot("px4"), used="flu", true="frd", motion=still)
    upside_down.run(5.0)
    (said,) = upside_down.topic("axes")
    assert "are wrong" in said.text and "frd" in said.text and "Tilt and turn" in said.remedy
    turned = Bench(ModelledAutopilot("px4"), used="flu", true="lbu", motion=still)  # a quarter turn about the vertical
    turned.run(5.0)
    assert not turned.topic("axes")
    turned.motion = lambda t_s: carried(t_s) if t_s >= 10.0 else still(t_s)
    turned.run(5.0)
    assert turned.topic("axes")[-1].remedy.endswith("--axes lbu")


def test_a_hovering_vehicle_tells_its_axes_by_small_tilts() -> None:
    def hover(t_s: float) -> Angles:
        return radians(5.0) * sin(2.1 * t_s), radians(4.0) * sin(1.7 * t_s + 0.5), 0.0

    bench = Bench(ModelledAutopilot("ardupilot"), used="flu", true="lbu", motion=hover)
    bench.run(5.0)
    assert bench.topic("axes")[-1].remedy.endswith("--axes lbu")
    right = Bench(ModelledAutopilot("ardupilot"), motion=hover)
    right.run(25.0)
    assert [f.level for f in right.topic("axes")] == [FindingLevel.INFO]


def test_a_jump_of_the_controllers_heading_is_no_wrong_axis() -> None:
    def jumping(t_s: float) -> Angles:
        roll, pitch, yaw = carried(t_s)
        return roll, pitch, yaw + 0.9 * (int(t_s) % 7 == 0)

    bench = Bench(ModelledAutopilot("ardupilot"))
    bench.run(2.0)
    bench.R_l_n = np.asarray(se3.so3_exp(np.array([0.0, 0.0, -0.7])))
    bench.run(20.0)
    assert [f.level for f in bench.topic("axes")] == [FindingLevel.INFO]


def test_a_tilted_camera_is_told_from_wrong_axes() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"), motion=still)
    bench.T_b_f = bench.T_b_f @ se3.from_rt(se3.so3_exp(np.array([0.0, radians(20.0), 0.0])), np.zeros(3))
    bench.run(10.0)
    (said,) = bench.topic("axes")
    assert said.level is FindingLevel.WARNING and "20 degrees off" in said.text


@pytest.mark.parametrize("kind", KINDS)
def test_ignored_poses_are_said_and_so_is_their_acceptance(kind: str) -> None:
    wrong = {"ardupilot": {"EK3_SRC1_POSXY": 3}, "px4": {"EKF2_EV_CTRL": 0}}[kind]
    bench = Bench(ModelledAutopilot(kind, parameters=wrong))  # type: ignore[arg-type]
    bench.run(12.0)
    (said,) = bench.topic("poses")
    assert said.level is FindingLevel.ERROR and "ignores them" in said.text
    assert ("EK3_SRC1_POSXY" if kind == "ardupilot" else "EKF2_EV_CTRL") in said.remedy
    bench.controller._values.update({"EK3_SRC1_POSXY": 6, "EKF2_EV_CTRL": 15})
    bench.run(8.0)
    assert len(bench.topic("poses")) == 2 and "uses them" in bench.topic("poses")[1].text


def test_rejected_poses_are_said() -> None:
    bench = Bench(ModelledAutopilot("px4", faults=Faults(rejects=True)))
    bench.run(8.0)
    (said,) = bench.topic("poses")
    assert said.level is FindingLevel.ERROR and "rejects" in said.text and "1.7 times" in said.text


def test_poses_of_failed_tracking_are_not_called_ignored() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"))
    bench.run(15.0, quality=-1)
    assert not bench.topic("poses")


def test_a_controller_that_stops_aiding_is_said() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"))
    bench.run(10.0)
    bench.run(20.0, poses=False)
    assert [f.text.split(": ")[1] for f in bench.topic("poses")][
        -1
    ] == "the flight controller's estimator stopped using them"
    bench.run(8.0)
    assert "uses them" in bench.topic("poses")[-1].text


def test_a_silent_controller_is_said_and_its_return() -> None:
    bench = Bench(ModelledAutopilot("ardupilot", faults=Faults(silent=True)))
    bench.run(4.5)
    assert not bench.found
    bench.run(15.0)
    (said,) = bench.topic("controller")
    assert "not found in 5 s at udp:1.2.3.4:14550: nothing is heard" in said.text
    bench.controller.faults.silent = False
    bench.run(5.0)
    assert "found: ArduPilot" in bench.topic("controller")[-1].text
    bench.controller.faults.silent = True
    bench.run(8.0)
    assert "silent for 5 s" in bench.topic("controller")[-1].text
    bench.controller.faults.silent = False
    bench.run(5.0)
    assert "is back" in bench.topic("controller")[-1].text
    assert len(bench.topic("controller")) == 4


def test_a_controller_that_comes_late_is_not_told_that_none_was_there() -> None:
    controller = ModelledAutopilot("ardupilot", faults=Faults(silent=True))
    bench = Bench(controller)
    bench.device_fault = "the device is missing"
    bench.run(1.0)
    bench.device_fault = ""
    bench.run(7.0)
    controller.faults.silent = False
    bench.run(4.0)
    texts = [text.text for text in controller.texts]
    assert any("sees ArduPilot" in text for text in texts)
    assert not any("not found" in text or "missing" in text for text in texts), texts


def test_a_controller_that_was_silent_does_not_ignore_the_poses_of_that_time() -> None:
    controller = ModelledAutopilot("ardupilot")
    bench = Bench(controller)
    bench.run(0.9)  # its first reports have no position yet
    controller.faults.silent = controller.faults.deaf = True
    bench.run(16.0)
    controller.faults.silent = controller.faults.deaf = False
    bench.run(20.0)
    assert not any("ignores them" in finding.text for finding in bench.topic("poses"))
    assert "uses them" in bench.topic("poses")[-1].text


def test_a_restarted_controller_is_said() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"))
    bench.run(8.0)
    bench.controller.reboot()
    bench.run(20.0)
    assert len(bench.topic("restart")) == 1
    assert [f.text.split(" (")[0] for f in bench.topic("poses")] == [
        "poses: the flight controller's estimator uses them"
    ] * 2


def test_a_controller_that_hears_nothing_is_said() -> None:
    bench = Bench(ModelledAutopilot("px4", faults=Faults(deaf=True)), url="serial:/dev/ttyAMA0:921600")
    bench.run(15.0)
    (said,) = bench.topic("answers")
    assert "answers nothing" in said.text and "TX" in said.remedy


def test_why_nothing_is_found() -> None:
    def said(url: str, data: bytes) -> str:
        bench = Bench(ModelledAutopilot("px4", faults=Faults(silent=True)), url=url)
        for _ in range(7):
            bench.session.receive(data, bench.now_ns)
            bench.run(1.0)
        (found,) = bench.topic("controller")
        return found.line

    assert "no MAVLink. Set the port's baud rate" in said("serial:/dev/ttyAMA0:57600", b"\x91\x00\xfd\x17" * 30)
    ground = MavlinkCodec(255, 190).encode(Heartbeat(6, 8))
    assert "only others are heard (system 255)" in said("udp:1.2.3.4:14550", ground)
    assert "nothing is heard. Check address" in said("udp:1.2.3.4:14550", b"")


def test_a_missing_device_is_said_and_its_return() -> None:
    bench = Bench(ModelledAutopilot("px4"), url="serial:/dev/ttyACM0:921600")
    bench.controller.faults.silent = True
    bench.device_fault = "the device is missing"
    bench.run(20.0)
    assert bench.texts() == ["flight controller: serial:/dev/ttyACM0:921600: the device is missing"]
    bench.device_fault, bench.controller.faults.silent = "", False
    bench.run(3.0)
    assert [f.topic for _, f in bench.found][1:3] == ["device", "controller"]


def test_a_device_that_goes_in_flight_is_said_once_not_its_silence_too() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"), url="serial:/dev/ttyACM0:921600")
    bench.run(8.0)
    before = len(bench.found)
    bench.controller.faults.silent, bench.device_fault = True, "the device is missing"
    bench.run(12.0)
    bench.device_fault = ""
    bench.run(4.0)
    bench.controller.faults.silent = False
    bench.run(4.0)
    assert [f.topic for _, f in bench.found[before:]] == ["device", "device"]
    bench.controller.faults.silent, bench.device_fault = True, "the device is missing"
    bench.run(12.0)
    bench.device_fault = ""
    bench.run(8.0)  # it is there, but says nothing
    assert [f.topic for _, f in bench.found[before + 2 :]] == ["device", "device", "controller"]
    assert "silent for" in bench.found[-1][1].text


def test_signatures_without_a_key_are_said() -> None:
    bench = Bench(ModelledAutopilot("ardupilot"))
    bench.controller.codec._mav.signing.secret_key = b"k" * 32
    bench.controller.codec._mav.signing.sign_outgoing = True
    bench.controller.faults.deaf = True
    bench.run(10.0)
    (said,) = bench.topic("signing")
    assert "will refuse ours" in said.text
    assert "signed messages only" in bench.topic("answers")[0].remedy


def test_messages_of_another_vehicle_do_not_count() -> None:
    bench = Bench(ModelledAutopilot("ardupilot", parameters={"VISO_TYPE": 0}))
    other = ModelledAutopilot("ardupilot", system=2)
    bench.run(2.0)
    from kiteline_hw.mavlink.watch.messages import EkfStatusReport

    for _ in range(100):
        bench.session.receive(other.codec.encode(EkfStatusReport(8 | 16)), bench.now_ns, datagram=True)
        bench.run(0.1)
    assert "ignores them" in bench.topic("poses")[-1].text


@pytest.mark.parametrize(("late_s", "tilt_deg"), [(0.1, 8.0), (-0.1, 8.0), (0.2, 3.0)])
def test_late_stamps_and_a_slightly_tilted_camera_never_make_right_axes_wrong(late_s: float, tilt_deg: float) -> None:
    def shaken(t_s: float) -> Angles:
        return radians(22.0) * sin(5.0 * t_s), radians(22.0) * sin(4.0 * t_s + 1.0), 1.5 * t_s

    bench = Bench(ModelledAutopilot("ardupilot"), motion=shaken)
    bench.T_b_f = bench.T_b_f @ se3.from_rt(se3.so3_exp(np.radians([tilt_deg, tilt_deg / 2, tilt_deg])), np.zeros(3))
    true_pose = bench.pose

    def late_pose(t_ns: int, quality: int) -> PoseSample:
        return replace(true_pose(t_ns - round(late_s * S), quality), t_ns=t_ns)

    bench.pose = late_pose  # type: ignore[method-assign]
    bench.run(12.0)
    assert all("--axes" not in f.text for f in bench.topic("axes"))
    assert len(bench.topic("axes")) <= 1
