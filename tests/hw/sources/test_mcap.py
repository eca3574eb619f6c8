"""ROS 2 bags in every storage form, and their faults."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType

from kiteline_core.frame import UNMEASURED, Frame, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Lens
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.odometry_buffer import VELOCITY_SIGMA_M_S
from kiteline_hw.sources.open import open_source
from tests.hw.sources.camera_messages import START_NS, STEP_NS, T_B_L, T_L_R, png, read, xyz
from tests.hw.sources.ros2_bags import Bag, check_stereo, stereo_bag


def test_room_recording(data_dir: Path) -> None:
    source = open_source(str(data_dir / "room_flight.mcap"))
    frames, batches = read(source)
    assert len(frames) == source.frame_count == 440
    assert (frames[0].t_ns, frames[-1].t_ns) == (1_700_000_018_000_000_000, 1_700_000_039_950_000_000)
    assert sum(len(b.t_ns) for b in batches) == 4391 and len(batches) == 440
    assert [e.format for e in frames[0].encoded] == ["jpeg", "jpeg"]
    assert source.rig.left.fx == 458.654 and source.rig.right is not None and source.rig.right.fx == 457.587
    assert source.rig.T_c_r[0, 3] == pytest.approx(0.110074, abs=1e-6)
    assert source.rig.has_body and source.imu is not None and source.imu.rate_hz == pytest.approx(200, abs=0.5)
    assert len(source.ground_truth.t_ns) == 1100
    assert source.ground_truth.T_w_b[0, :3, 3] == pytest.approx([-2.060154, -1.404402, 1.913249])
    assert not source.report.skipped
    source.close()


# A rover's axle (forward, left, up) as its camera's IMU (right, down, forward) sees it: below it and behind it.
AXLE = se3.from_rt(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, 0.2, -0.5]))


def driven_bag(*topics: str, child: str = "base_link", tf: bool = True) -> Bag:
    """1 m/s ahead and 0.5 rad/s to the left, told every 20 ms; a second topic says something else."""
    bag = stereo_bag()
    if tf:
        bag.tf(START_NS, "imu", "base_link", AXLE)
    for i in range(12):
        for k, topic in enumerate(topics):
            bag.odometry(START_NS + i * 20_000_000, topic, child, [1.0 + k, 0.0, 0.0], [0.0, 0.0, 0.5])
    bag.messages.sort(key=lambda m: m[0])
    return bag


def test_wheel_odometry_of_a_bag_in_the_body_frame(tmp_path: Path) -> None:
    source = open_source(str(driven_bag("/wheels/odom").write(tmp_path / "a.mcap")))
    items = list(source)
    told = [item for item in items if isinstance(item, OdometryBatch)]
    assert [len(b.t_ns) for b in told] == [1, 2, 3, 2, 3, 1]  # up to each frame
    assert isinstance(items[items.index(told[0]) + 1], Frame)
    # Half a metre ahead of the axle the camera moves to the left as well: right -0.25, down 0, forward 1 m/s.
    np.testing.assert_allclose(told[1].velocity, [[-0.25, 0.0, 1.0]] * 2, atol=1e-4)
    np.testing.assert_allclose(told[1].rate, [[0.0, -0.5, 0.0]] * 2, atol=1e-12)
    # forward was stated, sideways is not measured, the rest is not known
    assert told[1].velocity_cov[0, 2, 2] == pytest.approx(0.04, abs=3e-3)
    assert told[1].velocity_cov[0, 0, 0] == pytest.approx(UNMEASURED, rel=1e-3)
    assert told[1].velocity_cov[0, 1, 1] == pytest.approx(VELOCITY_SIGMA_M_S**2, rel=0.2)
    assert told[1].rate_cov[0, 1, 1] == pytest.approx(0.0025)
    assert "odometry is that of /wheels/odom" in source.report.notes
    check_stereo(source)


@pytest.mark.parametrize(
    ("topics", "speed"),
    [
        (("/wheels/odom", "/vins/odometry"), 1.0),
        (("/vio/odom", "/odom"), 2.0),
        (("/ground_truth/odom", "/odom"), 2.0),
        (("/odom", "/wheel/odometry"), 2.0),
    ],
)
def test_wheels_are_preferred_to_other_odometry_and_truth_is_never_used(
    tmp_path: Path, topics: tuple[str, ...], speed: float
) -> None:
    source = open_source(str(driven_bag(*topics).write(tmp_path / "a.mcap")))
    told = [item for item in source if isinstance(item, OdometryBatch)]
    assert told[0].velocity[0, 2] == pytest.approx(speed, abs=1e-3)


def test_ground_truth_is_no_odometry(tmp_path: Path) -> None:
    source = open_source(str(driven_bag("/gt/odom").write(tmp_path / "a.mcap")))
    assert not any(isinstance(item, OdometryBatch) for item in source)
    assert source.ground_truth is not None


def test_odometry_without_extrinsics_is_left_out_and_noted(tmp_path: Path) -> None:
    source = open_source(str(driven_bag("/odom", tf=False).write(tmp_path / "a.mcap")))
    assert not any(isinstance(item, OdometryBatch) for item in source)
    assert any("odometry of /odom left out: no static transform" in note for note in source.report.notes)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False},
        {"index_types": IndexType.CHUNK},
        {"repeat_channels": False, "repeat_schemas": False},
    ],
    ids=str,
)
def test_ros2_bag_in_every_storage_form(tmp_path: Path, options: dict[str, Any]) -> None:
    check_stereo(open_source(str(stereo_bag().write(tmp_path / "a.mcap", **options))))


def test_bag_in_a_folder(tmp_path: Path) -> None:
    stereo_bag().write(tmp_path / "flight_0.mcap")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    check_stereo(open_source(str(tmp_path)))
    stereo_bag().write(tmp_path / "flight_1.mcap")
    with pytest.raises(SourceError, match="kiteline log merge"):
        open_source(str(tmp_path))


def test_messages_written_out_of_order_come_in_order(tmp_path: Path) -> None:
    bag = stereo_bag(20)
    head, rest = bag.messages[:4], bag.messages[4:]
    order = np.argsort(np.arange(len(rest)) + np.random.default_rng(0).uniform(0, 60, len(rest)))
    bag.messages = head + [rest[i] for i in order]
    check_stereo(open_source(str(bag.write(tmp_path / "a.mcap"))), 20)


@pytest.mark.parametrize("simulated", [True, False])
def test_a_stamp_of_0_is_a_time_where_the_recorder_has_another_clock(tmp_path: Path, simulated: bool) -> None:
    """Simulated time begins at 0; in a bag of one clock a message without a stamp counts from its recording."""
    bag = stereo_bag()
    for k, (t_ns, topic, kind, value) in enumerate(bag.messages):
        if "header" in value and (simulated or t_ns == START_NS):
            since_ns = t_ns - START_NS
            stamp = {"sec": since_ns // 10**9, "nanosec": since_ns % 10**9}
            bag.messages[k] = (t_ns, topic, kind, {**value, "header": {**value["header"], "stamp": stamp}})
    frames, batches = read(open_source(str(bag.write(tmp_path / "bag.mcap"))))
    begin_ns = 0 if simulated else START_NS
    assert [f.t_ns for f in frames] == [begin_ns + i * STEP_NS for i in range(6)]
    assert batches[0].t_ns[0] == begin_ns and all(f.right is not None for f in frames)


def test_late_recorded_samples_come_in_order_of_their_stamps(tmp_path: Path) -> None:
    bag = Bag()
    bag.tf(START_NS, "imu", "left_optical", T_B_L)
    bag.info(START_NS, "left")
    for i in range(40):
        bag.image(START_NS + i * STEP_NS, "left", i)
        for j in range(10):
            bag.imu(START_NS + i * STEP_NS + j * 5_000_000, lag_ns=400_000_000)  # a slow serial line
    bag.messages.sort(key=lambda m: m[0])
    frames, batches = read(open_source(str(bag.write(tmp_path / "a.mcap"))))
    assert len(frames) == 40 and [len(b.t_ns) for b in batches] == [1] + [10] * 39


def test_a_cut_bag_yields_all_messages_before_the_cut(tmp_path: Path) -> None:
    whole = stereo_bag(12).write(tmp_path / "whole.mcap").read_bytes()
    counts = []
    for size in np.linspace(len(whole) // 3, len(whole) - 1, 25).astype(int):
        path = tmp_path / "cut.mcap"
        path.write_bytes(whole[:size])
        source = open_source(str(path))
        frames, _ = read(source)
        assert source.report.skipped["file cut"] == 1 and "cut after" in source.report.notes[0]
        counts.append(len(frames))
    assert counts == sorted(counts) and counts[0] >= 1 and counts[-1] == 12


def test_any_bytes_raise_only_source_errors(tmp_path: Path) -> None:
    whole = stereo_bag(3).write(tmp_path / "whole.mcap", compression=CompressionType.NONE).read_bytes()
    rng = np.random.default_rng(5)
    path, read_some = tmp_path / "bad.mcap", 0
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(8, len(data), rng.integers(1, 8)):
            data[at] = rng.integers(256)
        path.write_bytes(bytes(data[: rng.integers(9, len(data))] if rng.random() < 0.3 else data))
        try:
            source = open_source(str(path))
            read_some += len(list(source)) > 0
        except SourceError:
            pass  # the one exception that is allowed
    assert read_some > 20
    path.write_bytes(b"")
    with pytest.raises(SourceError, match="empty file"):
        open_source(str(path))
    path.write_bytes(b"\x89PNG rubbish")
    with pytest.raises(SourceError, match="no MCAP file"):
        open_source(f"mcap:{path}")


def test_baseline_of_a_rectified_pair_comes_from_p(tmp_path: Path) -> None:
    def info(bag: Bag) -> None:
        bag.info(START_NS, "left", d=(0.0,) * 5)
        bag.info(START_NS, "right", d=(0.0,) * 5, tx=-60 * 0.25)

    source = open_source(str(stereo_bag(tf=False, info=info).write(tmp_path / "a.mcap")))
    assert source.rig.left.lens is Lens.NONE and source.rig.T_c_r is not None
    np.testing.assert_allclose(source.rig.T_c_r[:3, 3], [0.25, 0, 0])
    assert not source.rig.has_body and source.imu is None
    assert "imu left out" in (read(source), source.report.notes)[1][0]


@pytest.mark.parametrize(
    ("model", "d", "lens"),
    [
        ("equidistant", (0.1, 0.01, 0.0, 0.0), Lens.EQUIDISTANT),
        ("rational_polynomial", (0.1,) * 8, Lens.RADTAN),
        ("plumb_bob", (0.1, 0.2, 0.0, 0.0, 0.3), Lens.RADTAN),
        ("", (), Lens.NONE),
    ],
)
def test_lens_models(tmp_path: Path, model: str, d: tuple[float, ...], lens: Lens) -> None:
    def info(bag: Bag) -> None:
        for side in ("left", "right"):
            bag.info(START_NS, side, d=d, model=model)

    rig = open_source(str(stereo_bag(info=info).write(tmp_path / "a.mcap"))).rig
    assert rig.left.lens is lens and rig.left.distortion == (d if lens is not Lens.NONE else ())


@pytest.mark.parametrize("colour_fx", [60.0, 90.0])
def test_a_colour_camera_beside_an_infrared_pair_is_no_part_of_it(tmp_path: Path, colour_fx: float) -> None:
    """As in the bags of RealSense cameras: its baseline to either of them is another, and shorter to the left one."""
    bag = stereo_bag()
    T = np.eye(4)
    T[0, 3] = -0.015
    bag.tf(START_NS, "left_optical", "colour_optical", T)
    bag.info(START_NS, "colour")
    bag.messages[-1][3]["k"] = [colour_fx, 0, 32, 0, colour_fx, 24, 0, 0, 1]
    for i in range(6):
        bag.image(START_NS + i * STEP_NS, "colour", 200 + i)
    bag.messages = sorted(bag.messages, key=lambda m: m[0])
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    assert source.rig.T_c_r is not None
    if colour_fx == 90.0:
        check_stereo(source)
    else:  # three cameras of one kind: the longest baseline
        assert source.rig.T_c_r[0, 3] == pytest.approx(T_L_R[0, 3] + 0.015, abs=1e-3)


def test_calibration_without_baseline_and_other_errors(tmp_path: Path) -> None:
    path = stereo_bag(tf=False).write(tmp_path / "a.mcap")
    with pytest.raises(
        SourceError, match=r"no baseline\): expected static transforms between the frames 'left_optical'"
    ):
        open_source(str(path))
    assert len(read(open_source(str(path), mono=True))[0]) == 6
    bag = stereo_bag(tf=False)
    bag.tf(START_NS, "left_optical", "right_optical", np.eye(4))
    with pytest.raises(SourceError, match="baseline between left and right camera is 0 m"):
        open_source(str(bag.write(tmp_path / "b.mcap")))
    with pytest.raises(SourceError, match="no calibration for /left/picture, /right/picture"):
        open_source(str(stereo_bag(info=lambda bag: None).write(tmp_path / "c.mcap")))
    bag = Bag()
    bag.imu(START_NS)
    with pytest.raises(SourceError, match="no images: expected sensor_msgs"):
        open_source(str(bag.write(tmp_path / "d.mcap")))


def test_faults_in_a_bag_are_skipped_and_counted(tmp_path: Path) -> None:
    bag = stereo_bag(8)
    stamp = {START_NS + i * STEP_NS: i for i in range(8)}
    kept = []
    for t_ns, topic, kind, value in bag.messages:
        i = stamp.get(t_ns, -1) if "picture" in topic else -1
        if i == 1 and topic == "/left/picture":
            value["data"] = b"not a picture"
        if i == 2 and topic == "/right/picture":
            value["data"] = png(np.zeros((40, 64), np.uint8))
        if i == 3 and topic == "/right/picture":
            continue
        if kind == "sensor_msgs/msg/Imu" and t_ns == START_NS + 5_000_000:
            value["linear_acceleration"]["x"] = float("nan")
        kept.append((t_ns, topic, kind, value))
        if kind == "sensor_msgs/msg/Imu" and t_ns == START_NS + 10_000_000:
            kept.append(kept[-1])
    bag.messages = kept
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    frames, batches = read(source)
    assert [stamp[f.t_ns] for f in frames] == [0, 2, 3, 4, 5, 6, 7]
    assert [f.right is None for f in frames] == [False, True, True, *4 * [False]]
    assert source.report.skipped == {
        "unreadable image": 1, "image of another size": 1, "missing right image": 1, "imu sample not finite": 1,
        "imu stamp not increasing": 1,
    }  # fmt: skip
    assert sum(len(b.t_ns) for b in batches) == 70  # what leads up to a skipped frame comes with the next


def test_accelerations_in_g_become_metres_a_second_squared(tmp_path: Path) -> None:
    bag = stereo_bag(2)
    for _, _, kind, value in bag.messages:
        if kind == "sensor_msgs/msg/Imu":
            value["linear_acceleration"] = xyz(np.array([0.0, 0.0, 1.0]))
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    _, batches = read(source)
    np.testing.assert_allclose(batches[-1].accel, [[0, 0, 9.80665]] * 10)
    assert "in g" in source.report.notes[0]
