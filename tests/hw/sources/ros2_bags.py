"""Bags of ROS 2 as tests write them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer

from kiteline_core.geometry.cameras import Lens
from kiteline_hw.ports import FrameSource
from tests.hw.sources.camera_messages import START_NS, STEP_NS, T_B_L, T_L_R, D, picture, png, quaternion, read, xyz
from tests.hw.sources.ros2_schemas import LEAVES, ROS2


class Bag:
    """Collects ROS 2 messages (log time, topic, type, value) and writes them in the order given."""

    def __init__(self) -> None:
        self.messages: list[tuple[int, str, str, dict[str, Any]]] = []

    def add(self, t_ns: int, topic: str, kind: str, frame: str, lag_ns: int = 0, **value: Any) -> None:
        stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
        header = {"header": {"stamp": stamp, "frame_id": frame}} if kind != "tf2_msgs/msg/TFMessage" else {}
        self.messages.append((t_ns + lag_ns, topic, kind, {**header, **value}))

    def info(
        self, t_ns: int, side: str, *, d: tuple[float, ...] = D, model: str = "plumb_bob", tx: float = 0.0
    ) -> None:
        k = [60.0, 0, 32, 0, 61, 24, 0, 0, 1]
        p = [60.0, 0, 32, tx, 0, 61, 24, 0, 0, 0, 1, 0]
        self.add(
            t_ns, f"/{side}/info", "sensor_msgs/msg/CameraInfo", f"{side}_optical", height=48, width=64,
            distortion_model=model, d=list(d), k=k, r=np.eye(3).ravel().tolist(), p=p, binning_x=0, binning_y=0,
            roi={"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
        )  # fmt: skip

    def image(self, t_ns: int, side: str, i: int, lag_ns: int = 0) -> None:
        self.add(
            t_ns, f"/{side}/picture", "sensor_msgs/msg/CompressedImage", f"{side}_optical", lag_ns, format="mono8; png",
            data=png(picture(i)),
        )  # fmt: skip

    def raw(self, t_ns: int, side: str, encoding: str, image: np.ndarray, frame: str = "", pad: int = 0) -> None:
        rows = image.reshape(image.shape[0], -1).view(np.uint8)
        data = np.pad(rows, ((0, 0), (0, pad))).tobytes()
        self.add(
            t_ns, f"/{side}/pixels", "sensor_msgs/msg/Image", frame or f"{side}_optical", height=image.shape[0],
            width=image.shape[1], encoding=encoding, is_bigendian=0, step=rows.shape[1] + pad, data=data,
        )  # fmt: skip

    def imu(self, t_ns: int, lag_ns: int = 0, accel: float = 9.8) -> None:
        zero = {"orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
        for name in ("orientation_covariance", "angular_velocity_covariance", "linear_acceleration_covariance"):
            zero[name] = [0.0] * 9  # type: ignore[assignment]
        self.add(
            t_ns, "/sensors/imu", "sensor_msgs/msg/Imu", "imu", lag_ns, angular_velocity=xyz(np.array([0.1, 0.2, 0.3])),
            linear_acceleration=xyz(np.array([0.0, 0.0, accel])), **zero,
        )  # fmt: skip

    def odometry(self, t_ns: int, topic: str, child: str, velocity: list[float], rate: list[float]) -> None:
        covariance = [0.0] * 36
        covariance[0], covariance[7], covariance[35] = 0.04, 1e9, 0.0025  # ahead, sideways (not measured), yaw
        pose = {"position": xyz(np.zeros(3)), "orientation": quaternion(np.eye(4))}
        twist = {"linear": xyz(np.array(velocity)), "angular": xyz(np.array(rate))}
        self.add(
            t_ns, topic, "nav_msgs/msg/Odometry", "odom", child_frame_id=child,
            pose={"pose": pose, "covariance": [0.0] * 36}, twist={"twist": twist, "covariance": covariance},
        )  # fmt: skip

    def tf(self, t_ns: int, parent: str, child: str, t: np.ndarray) -> None:
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": parent}
        transform = {"translation": xyz(t[:3, 3]), "rotation": quaternion(t)}
        item = {"header": header, "child_frame_id": child, "transform": transform}
        self.add(t_ns, "/tf_static", "tf2_msgs/msg/TFMessage", "", transforms=[item])

    def write(self, path: Path, **options: Any) -> Path:
        with path.open("wb") as stream:
            writer = Ros2Writer(stream, chunk_size=4096)
            if options:
                writer._writer = Writer(stream, chunk_size=4096, **options)
                stream.seek(0)
                stream.truncate()
                writer._writer.start("ros2", "test")
            kinds = {
                kind: writer.register_msgdef(kind, ROS2[kind] + LEAVES) for kind in {m[2]: 0 for m in self.messages}
            }
            for t_ns, topic, kind, value in self.messages:
                writer.write_message(topic, kinds[kind], value, t_ns, t_ns)
            writer.finish()
        return path


def stereo_bag(n: int = 6, *, tf: bool = True, info: Callable[[Bag], None] | None = None) -> Bag:
    bag = Bag()
    if tf:
        bag.tf(START_NS, "imu", "left_optical", T_B_L)
        bag.tf(START_NS, "left_optical", "right_optical", T_L_R)
    if info is None:
        bag.info(START_NS, "left")
        bag.info(START_NS, "right")
    else:
        info(bag)
    for i in range(n):
        for j in range(10):
            bag.imu(START_NS + i * STEP_NS + j * 5_000_000)
        bag.image(START_NS + i * STEP_NS, "right", 100 + i)
        bag.image(START_NS + i * STEP_NS, "left", i)
    return bag


def check_stereo(source: FrameSource, n: int = 6) -> None:
    frames, batches = read(source)
    assert [f.t_ns for f in frames] == [START_NS + i * STEP_NS for i in range(n)]
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.left, picture(i))
        assert frame.right is not None and len(frame.encoded) == 2
        np.testing.assert_array_equal(frame.right, picture(100 + i))
    assert sum(len(b.t_ns) for b in batches) == (n - 1) * 10 + 1
    np.testing.assert_array_equal(batches[0].gyro[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(source.rig.T_b_c, T_B_L, atol=1e-12)
    assert source.rig.T_c_r is not None
    np.testing.assert_allclose(source.rig.T_c_r, T_L_R, atol=1e-12)
    assert source.rig.left.lens is Lens.RADTAN and source.rig.left.distortion == D
