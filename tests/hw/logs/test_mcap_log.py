"""Logs: exact round trips, equal bytes for equal calls, and cut logs."""

import json
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from kiteline_core.frame import EncodedImage, Frame, ImuBatch, ImuCalibration, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, IMU, LEFT, LogReader, LogWriter, read_frame
from kiteline_hw.logs.mcap_schemas import CompressedImage, bytes_field
from kiteline_hw.logs.rig_json import rig_from_json, rig_to_json
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.images import decode_depth, decode_grey, encode_depth, encode_image
from kiteline_hw.sources.open import open_source
from tests.yardstick import slowness

T0 = 5_000_000_000
RNG = np.random.default_rng(3)
EYE = CameraModel(64, 48, 60.1, 61.2, 31.3, 24.4, Lens.RADTAN, (0.1, 0.01, 1 / 3, 0.0, 0.2))
RIG = CameraRig(
    EYE,
    replace(EYE, fx=60.7, lens=Lens.EQUIDISTANT, distortion=(0.1, 0.2, 0.3, 0.4)),
    se3.exp(RNG.normal(size=6)),
    se3.exp(np.array([0.11, 1e-3, 1e-4, 0.01, 0.02, 0.03])),
)


def picture() -> np.ndarray:
    return RNG.integers(0, 255, (48, 64), np.uint8)


def batch(t_ns: int, n: int = 10) -> ImuBatch:
    times = t_ns - np.arange(n)[::-1] * 5_000_000
    return ImuBatch(times.astype(np.int64), RNG.normal(size=(n, 3)), RNG.normal(size=(n, 3)))


def flight(n: int = 6, encoded: bool = True) -> list[tuple[ImuBatch, Frame]]:
    out = []
    for i in range(n):
        t_ns, left, right = T0 + i * 50_000_000, picture(), picture()
        images = (encode_image(left), encode_image(right)) if encoded else ()
        out.append((batch(t_ns), Frame(t_ns, left, right, encoded=images)))
    return out


def write(path: Path, items: list[tuple[ImuBatch, Frame]], **options: LogBudget) -> LogWriter:
    with LogWriter(path, {"role": "agent"}, **options) as log:
        log.rig(T0, RIG, ImuCalibration(1e-4, 2e-5, 3e-3, 4e-3, 200.0))
        for samples, frame in items:
            log.imu(IMU, frame.t_ns, samples)
            log.frame(frame)
            log.blob("/packets/in", frame.t_ns, bytes([frame.t_ns % 251]) * 300)
            log.json("/estimate", frame.t_ns, {"x": 1 / 3, "n": [1, 2]})
    return log


def same_frame(a: Frame, b: Frame) -> bool:
    pairs = ((a.left, b.left), (a.right, b.right), (a.depth_m, b.depth_m))
    same = all((x is None and y is None) or np.array_equal(x, y) for x, y in pairs)  # type: ignore[arg-type]
    return same and a.t_ns == b.t_ns


@pytest.mark.parametrize("encoded", [True, False])
def test_a_log_is_a_source_of_identical_items(tmp_path: Path, encoded: bool) -> None:
    items = flight(encoded=encoded)
    write(tmp_path / "log.mcap", items)
    source = open_source(str(tmp_path / "log.mcap"))
    np.testing.assert_array_equal(source.rig.T_b_c, RIG.T_b_c)
    assert source.rig.T_c_r is not None and RIG.T_c_r is not None
    np.testing.assert_array_equal(source.rig.T_c_r, RIG.T_c_r)
    assert (source.rig.left, source.rig.right) == (RIG.left, RIG.right)
    assert source.imu == ImuCalibration(1e-4, 2e-5, 3e-3, 4e-3, 200.0)
    read = list(source)
    batches, frames = [i for i in read if isinstance(i, ImuBatch)], [i for i in read if isinstance(i, Frame)]
    assert len(frames) == len(batches) == 6 and source.ground_truth is None
    for (samples, frame), got, got_frame in zip(items, batches, frames, strict=True):
        np.testing.assert_array_equal(got.t_ns, samples.t_ns)
        np.testing.assert_array_equal(got.gyro, samples.gyro)
        np.testing.assert_array_equal(got.accel, samples.accel)
        assert same_frame(frame, got_frame)
        if encoded:
            assert got_frame.encoded == frame.encoded


def test_depth_and_ground_truth_round_trip(tmp_path: Path) -> None:
    rig = CameraRig(EYE, None, np.eye(4), None, has_depth=True, has_body=False)
    depth = (RNG.integers(0, 9000, (48, 64)) / 1000).astype(np.float32)
    own = EncodedImage(encode_depth(depth).data, "png/5000")
    frames = [
        Frame(T0, picture(), depth_m=depth),
        Frame(T0 + 1, left := picture(), depth_m=decode_depth(own)[0], encoded=(encode_image(left), own)),
    ]
    truth = Trajectory(np.array([T0, T0 + 1]), np.array([se3.exp(RNG.normal(size=6)) for _ in range(2)]))
    for i, frame in enumerate(frames):
        with LogWriter(tmp_path / f"{i}.mcap", {}) as log:
            log.rig(T0, rig, None)
            log.ground_truth(truth)
            log.frame(frame)
        source = open_source(str(tmp_path / f"{i}.mcap"))
        (got,) = source
        assert isinstance(got, Frame) and got.depth_m is not None and frame.depth_m is not None
        np.testing.assert_array_equal(got.left, frame.left)
        np.testing.assert_allclose(got.depth_m, frame.depth_m, rtol=1e-6)
        np.testing.assert_allclose(source.ground_truth.T_w_b, truth.T_w_b, atol=1e-14)
        assert not source.rig.has_body


def test_equal_calls_give_equal_bytes(tmp_path: Path) -> None:
    items = flight()
    for name in ("a.mcap", "b.mcap"):
        write(tmp_path / name, items)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_messages_are_read_in_the_order_of_writing(tmp_path: Path) -> None:
    items = flight()
    write(tmp_path / "log.mcap", items)
    with LogReader(tmp_path / "log.mcap") as log:
        assert log.metadata == {"role": "agent"} and log.cut is None
        assert log.topics[LEFT] == 6 and log.topics["/packets/in"] == 6
        topics = [m.topic for m in log.messages()]
        assert topics[-5:] == [IMU, LEFT, "/right/image", "/packets/in", "/estimate"]
        images, read = [], Counter[str]()
        for m in log.messages([LEFT, "/right/image", "/estimate", "/packets/in", "/tf_static"]):
            read[m.topic] += 1
            if m.topic == "/estimate":
                assert m.json() == {"x": 1 / 3, "n": [1, 2]}
            elif m.topic == "/packets/in":
                assert m.blob() == bytes([m.t_ns % 251]) * 300
            elif m.topic == "/tf_static":
                parent, child, t = m.transform()
                assert (parent, child) in (("body", "left"), ("left", "right"))
                np.testing.assert_allclose(t, RIG.T_b_c if child == "left" else RIG.T_c_r, atol=1e-12)  # type: ignore[arg-type]
            else:
                images.append(m.image())
        each_frame = dict.fromkeys((LEFT, "/right/image", "/estimate", "/packets/in"), 6)
        assert read == {**each_frame, "/tf_static": 2}
        assert same_frame(read_frame(images[:2], items[0][1].t_ns), items[0][1])
        with pytest.raises(SourceError, match=r"/left/image holds foxglove\.CompressedImage, not kiteline\.Blob"):
            next(m for m in log.messages([LEFT])).blob()


def test_foxglove_reads_it_with_its_own_schemas(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        log.rig(T0, RIG, None)
        log.frame(flight(1)[0][1])
        log.pose("/pose", T0, "world", RIG.T_b_c)
        log.poses("/path", T0, "world", np.array([RIG.T_b_c, np.eye(4)]))
        log.grid("/grid", T0, "world", np.full((3, 4), -1, np.int8), 0.05, (-1.0, 2.0))
        log.text("/log", T0, "warning", "the line is slack")
        log.imu(IMU, T0, batch(T0))
        log.blob("/blob", T0, b"\x00\xff")
    with (tmp_path / "log.mcap").open("rb") as stream:
        found = {}
        for schema, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages(topics=[t for t in LogReader(tmp_path / "log.mcap").topics if t != "/rig"]):
            found[channel.topic] = (schema.name, message)
    assert found["/left/image"][0] == "foxglove.CompressedImage"
    assert (found["/left/image"][1].timestamp.seconds, found["/left/image"][1].format) == (5, "png")
    assert found["/left/calibration"][0] == "foxglove.CameraCalibration"
    assert list(found["/left/calibration"][1].D) == list(EYE.distortion)
    assert found["/right/calibration"][1].distortion_model == "kannala_brandt"
    assert len(found["/path"][1].poses) == 2
    grid = found["/grid"][1]
    assert (grid.column_count, grid.cell_size.x, grid.pose.position.y, len(grid.data)) == (4, 0.05, 2.0, 12)
    assert found["/log"][1].level == 3 and found["/blob"][1].data == b"\x00\xff"
    assert len(found[IMU][1].t_ns) == 10


def test_a_process_that_dies_loses_at_most_a_second(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "log.mcap", {})
    log.rig(T0, RIG, None)
    for i in range(100):
        log.blob("/small", T0 + i * 50_000_000, b"x")  # far below a chunk, so only time can write it out
    reader = LogReader(tmp_path / "log.mcap")
    assert reader.cut is not None
    assert 80 <= reader.topics["/small"] < 100
    log.close()
    assert LogReader(tmp_path / "log.mcap").topics["/small"] == 100


@given(st.floats(0.2, 0.999))
def test_a_cut_log_still_opens(tmp_path_factory: pytest.TempPathFactory, share: float) -> None:
    path = tmp_path_factory.mktemp("cut") / "log.mcap"
    write(path, flight(20))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    source = open_source(str(path))
    assert 1 <= len([i for i in source if isinstance(i, Frame)]) <= 20


def test_each_part_of_a_log_is_a_source(tmp_path: Path) -> None:
    items = flight(40)
    rotated = write(tmp_path / "turn.mcap", items, budget=LogBudget(tmp_path, "turn", 480_000, 0))
    left = sorted(tmp_path.glob("turn*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    assert rotated.dropped == 0 and len(left) >= 2
    for path in left:
        frames = [i for i in open_source(str(path)) if isinstance(i, Frame)]
        assert frames and open_source(str(path)).rig.left == RIG.left
    assert frames[-1].t_ns == items[-1][1].t_ns


def test_a_log_names_a_source_of_any_name(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "\udcff.mcap", {"source": "mcap:\udcff\n.mcap"}):
        pass
    with LogReader(tmp_path / "\udcff.mcap") as log:
        assert log.metadata["source"] == "mcap:\\udcff\n.mcap"


def test_writer_errors(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot write the log"):
        LogWriter(tmp_path / "missing" / "log.mcap", {})
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        log.blob("/a", T0, b"1")
        with pytest.raises(ValueError, match=r"topic /a holds kiteline\.Blob, not kiteline\.Json"):
            log.json("/a", T0, 1)
        with pytest.raises(ValueError, match="not JSON compliant"):
            log.json("/b", T0, float("nan"))


@given(st.lists(st.floats(0.0, 0.19), min_size=6, max_size=6), st.booleans())
def test_the_rig_in_json_is_exact_to_the_last_bit(values: list[float], depth: bool) -> None:
    t = se3.exp(np.array(values))  # a rig that is no rigid motion is refused
    rig = CameraRig(replace(EYE, readout_s=values[1]), None, t, None, has_depth=depth)
    got, imu = rig_from_json(json.loads(json.dumps(rig_to_json(rig, ImuCalibration(values[0])))))
    assert got.left == rig.left and got.right is None and got.has_depth == depth
    np.testing.assert_array_equal(got.T_b_c, t)
    assert imu.gyro_noise == values[0]


@given(st.integers(0, 300) | st.integers(16_000, 17_000))
def test_a_bytes_field_equals_protobufs(size: int) -> None:
    data = bytes(size)
    joined = b"".join((CompressedImage(format="png").SerializeToString(), *bytes_field(CompressedImage, "data", data)))
    assert CompressedImage.FromString(joined) == CompressedImage(format="png", data=data)


def test_images_round_trip() -> None:
    image = picture()
    assert np.array_equal(decode_grey(encode_image(image))[0], image)
    depth = np.array([[0.0, 0.5, 65.0, 70.0, np.nan, np.inf, -1.0]], np.float32)
    np.testing.assert_allclose(decode_depth(encode_depth(depth))[0], [[0, 0.5, 65, 0, 0, 0, 0]], atol=6e-4)


def test_logging_a_frame_is_cheap(tmp_path: Path) -> None:
    data = RNG.integers(0, 255, 45_000, np.uint8).tobytes()
    frames = [
        Frame(T0 + i * 50_000_000, np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint8),
              encoded=(EncodedImage(data, "jpeg"), EncodedImage(data, "jpeg"))) for i in range(200)
    ]  # fmt: skip
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        begin = time.process_time()
        for frame in frames:
            log.imu(IMU, frame.t_ns, batch(frame.t_ns))
            log.frame(frame)
        each_ms = (time.process_time() - begin) / len(frames) * 1e3
    assert each_ms < 1.0 * slowness()  # about 0.15 on a quiet core; the bound allows for a busy one


def test_the_ground_truth_topic_is_found_by_a_source(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        log.rig(T0, RIG, None)
        log.frame(flight(1)[0][1])
        log.pose("/pose", T0, "world", np.eye(4))  # an estimate is no truth
    assert GROUND_TRUTH == "/ground_truth" and open_source(str(tmp_path / "log.mcap")).ground_truth is None


def test_named_fields_come_back_bit_for_bit(tmp_path: Path) -> None:
    pose = np.random.default_rng(3).normal(size=(4, 4))
    values = {"t_ns": 7, "tracked": True, "T": pose, "place": None, "velocity": np.array([1 / 3, -0.0, np.inf])}
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        log.fields("/estimate", T0, values)
        log.fields("/estimate", T0, {"t_ns": 8})
    with LogReader(path) as log:
        first, second = (message.json() for message in log.messages(["/estimate"]))
        assert first == {**values, "T": pose.ravel().tolist(), "velocity": [1 / 3, 0.0, np.inf]}
        assert np.signbit(first["velocity"][1]) and second == {"t_ns": 8}
        message = next(iter(log.messages(["/estimate"])))
        for data in (message.data[:-8], b"", b"\xff", b"\x0a\x02{}", message.data.replace(b'"arrays"', b'"errors"')):
            with pytest.raises(SourceError):
                replace(message, data=data).json()
