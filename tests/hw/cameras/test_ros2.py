"""Topics of ROS 2 behind a model of rclpy's interface."""

import sys
import threading
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.cameras import ros2
from kiteline_hw.cameras.ros2 import RosSource
from kiteline_hw.ports import SourceError, is_live
from kiteline_hw.sensors import topic_clock
from kiteline_hw.sources.open import open_source

W, H, S = 64, 48, 1_000_000_000
CAMERA = "fx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\nwidth: 64\nheight: 48\n"
KALIBR = """\
cam0:
  camera_model: pinhole
  intrinsics: [50.0, 50.0, 31.5, 23.5]
  distortion_model: radtan
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [64, 48]
  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
IMU = """\
accelerometer_noise_density: 0.01
accelerometer_random_walk: 0.001
gyroscope_noise_density: 0.001
gyroscope_random_walk: 0.0001
update_rate: 200.0
"""


class Image: ...


class CompressedImage: ...


class Imu: ...


class Graph:
    """What is published reaches the subscriptions when the executor spins."""

    def __init__(self) -> None:
        self.subscriptions: list[tuple[type, str, Callable[[Any], None]]] = []
        self.waiting: list[tuple[type, str, Any]] = []
        self.new = threading.Condition()
        self.shut_down = False

    def publish(self, kind: type, topic: str, **fields: Any) -> None:
        message = kind()
        message.__dict__.update(fields)
        with self.new:
            self.waiting.append((kind, topic, message))
            self.new.notify()

    def spin_once(self, timeout_sec: float) -> None:
        with self.new:
            if not self.waiting:
                self.new.wait(timeout_sec)
            waiting, self.waiting = self.waiting, []
        for kind, topic, message in waiting:
            for wanted, name, callback in list(self.subscriptions):
                if (wanted, name) == (kind, topic):
                    callback(message)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    graph = Graph()

    def subscribe(kind: type, topic: str, callback: Callable[[Any], None], qos: str) -> Any:
        assert qos == "sensor data"
        graph.subscriptions.append((kind, topic, callback))
        return graph.subscriptions[-1]

    def shutdown(context: object) -> None:
        graph.shut_down = True

    node = SimpleNamespace(
        create_subscription=subscribe, destroy_subscription=graph.subscriptions.remove, destroy_node=lambda: None,
        count_publishers=lambda topic: 1,
    )  # fmt: skip
    executor = SimpleNamespace(add_node=lambda node: None, spin_once=graph.spin_once, shutdown=lambda: None)
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"context": SimpleNamespace(Context=object), "init": lambda context: None, "shutdown": shutdown,
                  "create_node": lambda name, context: node},
        "rclpy.executors": {"SingleThreadedExecutor": lambda context: executor},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": Image, "CompressedImage": CompressedImage, "Imu": Imu},
    }  # fmt: skip
    for name, content in contents.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return graph


def header(t_ns: int) -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=t_ns // S, nanosec=t_ns % S), frame_id="camera")


def image(graph: Graph, topic: str, t_ns: int, value: int) -> None:
    data = array("B", np.full((H, W), value, np.uint8).tobytes())
    graph.publish(Image, topic, header=header(t_ns), width=W, height=H, step=W, encoding="mono8", is_bigendian=0,
                  data=data)  # fmt: skip


def polled(source: RosSource, seconds: float = 5.0) -> Frame | ImuBatch:
    item = source.poll(time.monotonic_ns() + round(seconds * S))
    assert item is not None
    return item


def begun(source: RosSource, graph: Graph, topics: int) -> None:
    """Begin the capture: a camera's thread subscribes."""
    assert source.poll(time.monotonic_ns()) is None
    end_s = time.monotonic() + 5.0
    while len(graph.subscriptions) < topics:
        assert time.monotonic() < end_s
        time.sleep(0.005)


@pytest.fixture
def calibrated(tmp_path: Path) -> str:
    (tmp_path / "chain.yaml").write_text(KALIBR)
    (tmp_path / "imu.yaml").write_text(IMU)
    return f"{tmp_path / 'chain.yaml'},{tmp_path / 'imu.yaml'}"


def test_a_pair_of_topics_gives_frames_on_the_monotonic_clock(graph: Graph, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(CAMERA + "baseline_m: 0.1\n")
    source = open_source(f"ros2:/left/image,/right/image?calibration={path}")
    assert isinstance(source, RosSource) and is_live(source)
    begun(source, graph, 2)
    before_ns = time.monotonic_ns()
    t_ns = time.time_ns()
    image(graph, "/left/image", t_ns, 10)
    image(graph, "/right/image", t_ns + 200_000, 20)
    frame = polled(source)
    assert isinstance(frame, Frame) and frame.right is not None
    assert frame.left[0, 0] == 10 and frame.right[0, 0] == 20
    assert frame.t_ns == pytest.approx(before_ns, abs=50_000_000)
    assert any("/left/image: Image, 1 publisher" in line for line in source.take_messages())
    source.close()
    assert graph.shut_down and not graph.subscriptions


def test_mono16_of_ten_bits_is_not_dark(graph: Graph, tmp_path: Path) -> None:
    path, topic = tmp_path / "camera.yaml", "/camera/image_raw"
    path.write_text(CAMERA)
    source = open_source(f"ros2:{topic}?calibration={path}")
    assert isinstance(source, RosSource)
    begun(source, graph, 1)
    words = array("B", np.full((H, W), 800, "<u2").tobytes())
    graph.publish(Image, topic, header=header(time.time_ns()), width=W, height=H, step=2 * W, encoding="mono16",
                  is_bigendian=0, data=words)  # fmt: skip
    frame = polled(source)
    assert isinstance(frame, Frame) and frame.left[0, 0] == 200
    assert any("hold 10 bits" in line for line in source.take_messages())
    source.close()


def test_compressed_images_and_damaged_ones(graph: Graph, tmp_path: Path) -> None:
    import cv2

    path = tmp_path / "camera.yaml"
    path.write_text(CAMERA)
    topic = "/camera/image_raw/compressed"
    source = open_source(f"ros2:{topic}?calibration={path}")
    assert isinstance(source, RosSource)
    begun(source, graph, 1)
    png = cv2.imencode(".png", np.full((H, W), 30, np.uint8))[1].tobytes()
    graph.publish(CompressedImage, topic, header=header(time.time_ns()), format="png", data=array("B", png[:60]))
    graph.publish(CompressedImage, topic, header=header(time.time_ns()), format="png", data=array("B", png))
    frame = polled(source)
    assert isinstance(frame, Frame) and frame.left[0, 0] == 30
    assert frame.encoded[0].data == png  # logged as it came
    assert source.report.skipped["unreadable image"] == 1
    source.close()


def test_inertial_samples_come_before_their_frame(graph: Graph, calibrated: str) -> None:
    source = open_source("ros2:/image?imu=/imu/data", calibration=calibrated)
    assert isinstance(source, RosSource) and source.imu is not None and source.imu.gyro_noise == 0.001
    begun(source, graph, 2)
    t_ns = time.time_ns() - 100_000_000
    for k in range(4):
        rate, force = SimpleNamespace(x=0.1 * k, y=0.0, z=0.0), SimpleNamespace(x=0.0, y=0.0, z=9.8)
        graph.publish(Imu, "/imu/data", header=header(t_ns + 5_000_000 * k), angular_velocity=rate,
                      linear_acceleration=force)  # fmt: skip
    image(graph, "/image", t_ns + 12_000_000, 40)
    samples = polled(source)
    assert isinstance(samples, ImuBatch)
    np.testing.assert_allclose(samples.gyro[:, 0], [0.0, 0.1, 0.2])  # the last one is after the frame
    frame = polled(source)
    assert isinstance(frame, Frame) and samples.t_ns[-1] <= frame.t_ns
    image(graph, "/image", t_ns + 62_000_000, 40)
    late = polled(source)
    assert isinstance(late, ImuBatch) and late.gyro[:, 0] == pytest.approx([0.3])
    source.close()


def inertial(graph: Graph, topic: str, t_ns: int, rate: float, force: float) -> None:
    graph.publish(Imu, topic, header=header(t_ns), angular_velocity=SimpleNamespace(x=rate, y=0.0, z=0.0),
                  linear_acceleration=SimpleNamespace(x=0.0, y=0.0, z=force))  # fmt: skip


def test_rates_and_accelerations_of_two_topics_are_joined(graph: Graph, calibrated: str) -> None:
    source = open_source("ros2:/image?imu=/gyro/sample,/accel/sample", calibration=calibrated)
    assert isinstance(source, RosSource)
    begun(source, graph, 3)
    t_ns = time.time_ns() - 100_000_000
    # Before the first rate by more than the two clocks' difference is uncertain by.
    inertial(graph, "/accel/sample", t_ns - 5_000_000, 0.0, 7.0)
    for k in range(4):
        inertial(graph, "/gyro/sample", t_ns + 5_000_000 * k, 0.1 * k, 0.0)
    inertial(graph, "/accel/sample", t_ns + 20_000_000, 0.0, 12.0)
    image(graph, "/image", t_ns + 22_000_000, 40)
    samples = polled(source)
    assert isinstance(samples, ImuBatch)
    np.testing.assert_allclose(samples.gyro[:, 0], [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(samples.accel[:, 2], [8.0, 9.0, 10.0, 11.0], atol=0.1)
    source.close()


def test_samples_of_a_topic_of_rates_alone_are_left_out(graph: Graph, calibrated: str) -> None:
    source = open_source("ros2:/image?imu=/gyro/sample", calibration=calibrated)
    assert isinstance(source, RosSource)
    begun(source, graph, 2)
    t_ns = time.time_ns() - 100_000_000
    inertial(graph, "/gyro/sample", t_ns, 0.1, 0.0)
    image(graph, "/image", t_ns + 1_000_000, 40)
    assert isinstance(polled(source), Frame)
    assert source.report.skipped == {"imu sample without acceleration": 1}
    source.close()


@pytest.mark.parametrize("ahead_s", [-86400, -2, 100])
def test_topics_of_a_clock_that_is_off_still_fit_each_other(graph: Graph, calibrated: str, ahead_s: int) -> None:
    source = open_source("ros2:/image?imu=/imu/data", calibration=calibrated)
    assert isinstance(source, RosSource)
    begun(source, graph, 2)
    inertial(graph, "/imu/data", time.time_ns() + ahead_s * S, 0.0, 9.8)  # the quickest message
    for _ in range(3):
        time.sleep(0.04)
        arrival_ns = time.monotonic_ns()
        t_ns = time.time_ns() + ahead_s * S - 20_000_000
        inertial(graph, "/imu/data", t_ns - 1_000_000, 0.1, 9.8)
        image(graph, "/image", t_ns, 40)
        samples, frame = polled(source), polled(source)
        assert isinstance(samples, ImuBatch) and isinstance(frame, Frame)
        assert frame.t_ns - samples.t_ns[-1] == pytest.approx(1_000_000, abs=100_000)
        assert frame.t_ns == pytest.approx(arrival_ns - 20_000_000, abs=15_000_000)
    told = [line for line in source.take_messages() if "on this computer's clock" in line]
    assert len(told) == 2 and told[0].startswith("imu /imu/data") and told[1].startswith("camera /image"), told
    assert f"s {'ahead' if ahead_s > 0 else 'behind'}" in told[0] and "chrony" in told[0]
    assert source.report.skipped == {}
    source.close()


def test_samples_that_no_image_takes_are_counted(
    graph: Graph, calibrated: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "_MAX_SAMPLES", 3)
    source = open_source("ros2:/image?imu=/imu/data", calibration=calibrated)
    assert isinstance(source, RosSource)
    begun(source, graph, 2)
    t_ns = time.time_ns() - 100_000_000
    for k in range(5):
        inertial(graph, "/imu/data", t_ns + 5_000_000 * k, 0.1, 9.8)
    image(graph, "/image", t_ns + 30_000_000, 40)
    samples = polled(source)
    assert isinstance(samples, ImuBatch) and len(samples.t_ns) == 3
    assert source.report.skipped == {"imu sample beyond the buffer": 2}
    source.close()


def test_a_pause_between_readings_of_the_clocks_does_not_move_a_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    for paused in range(4):
        now_ns, readings = [5 * S], [0]

        def read(
            begin_ns: int, paused: int = paused, now_ns: list[int] = now_ns, readings: list[int] = readings
        ) -> int:
            now_ns[0] += 30_000_000 if readings[0] == paused else 100  # another thread runs for 30 ms
            readings[0] += 1
            return begin_ns + now_ns[0]

        clocks = SimpleNamespace(monotonic_ns=lambda: read(0), time_ns=lambda: read(1000 * S))
        monkeypatch.setattr(topic_clock, "time", clocks)
        assert topic_clock.wall_less_monotonic_ns() == pytest.approx(1000 * S, abs=1000)


def test_a_middleware_that_fails_on_and_on_takes_no_processor(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, calls = tmp_path / "camera.yaml", [0]
    path.write_text(CAMERA)

    def fail(timeout_sec: float) -> None:
        calls[0] += 1
        raise RuntimeError("the context was shut down")

    executor = SimpleNamespace(add_node=lambda node: None, spin_once=fail, shutdown=lambda: None)
    monkeypatch.setattr(sys.modules["rclpy.executors"], "SingleThreadedExecutor", lambda context: executor)
    source = open_source(f"ros2:/image?calibration={path}")
    time.sleep(0.3)
    source.close()
    assert 2 < calls[0] < 60


def test_an_imu_needs_its_calibration(graph: Graph, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(CAMERA)
    with pytest.raises(SourceError, match="noise and its place are not known"):
        open_source(f"ros2:/image?imu=/imu/data&calibration={path}")
    source = open_source(f"ros2:/image?imu=/imu/data&calibration={path}", imu=False)  # --no-imu
    assert source.imu is None
    source.close()


def test_without_ros_it_says_how_to_get_it(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(CAMERA)
    with pytest.raises(SourceError, match=r"rclpy.*source /opt/ros/DISTRO/setup.bash"):
        open_source(f"ros2:/image?calibration={path}")
