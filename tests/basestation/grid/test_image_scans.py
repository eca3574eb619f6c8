"""Scans that the base makes of images: those that the agent would have made, in order, kept and taken back."""

from itertools import count

import cv2
import numpy as np
import pytest

from kiteline_basestation.grid.image_scans import ImageScans, MadeScan
from kiteline_basestation.grid.scan_job import ScanInputs, ScanResult
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone, set_aside
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import KeyframeScan, ScanImages, messages
from kiteline_core.arrays import U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera, DisparityStripes
from kiteline_core.ground.image_codes import encode_pair
from kiteline_core.ground.segmentation import GroundSegmenter, Segmented
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id

CAMERA = RectifiedCamera(752, 480, 430.0, 430.0, 375.0, 245.0, 0.11, True, np.eye(4))
SMALL = DisparityCamera.of(CAMERA)
HEIGHT_M, WALL_M = 1.5, 4.0
UP = np.asarray(se3.so3_exp(np.array([np.radians(20.0), 0.0, 0.0])) @ np.array([0.0, -1.0, 0.0]))
TEXTURE = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (2048, 2048)).astype(np.uint8), (0, 0), 1.5)
TEXTURE = np.asarray(cv2.normalize(TEXTURE, None, 0, 255, cv2.NORM_MINMAX), np.uint8)


def room_pair(x_m: float = 0.0) -> tuple[U8, U8]:
    """A textured floor and a wall across, from x_m to the left, as both eyes see them."""
    R_c_l = level_rotation(UP)
    u, v = np.meshgrid((np.arange(SMALL.width) - SMALL.cx) / SMALL.fx, (np.arange(SMALL.height) - SMALL.cy) / SMALL.fy)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ R_c_l
    floor = np.where(rays[..., 2] < -1e-6, -HEIGHT_M / np.minimum(rays[..., 2], -1e-6), np.inf)
    wall = np.where(rays[..., 0] > 1e-6, WALL_M / np.maximum(rays[..., 0], 1e-6), np.inf)
    images = []
    for eye in (0.0, -CAMERA.baseline_m):
        at = np.minimum(floor, wall)[..., None] * rays + [0.0, eye + x_m, 0.0]
        down = np.where(wall < floor, at[..., 2] + HEIGHT_M + WALL_M, at[..., 0])
        map_x = (300.0 * at[..., 1] + 900.0).astype(np.float32)
        images.append(
            cv2.remap(TEXTURE, map_x, (300.0 * down).astype(np.float32), cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
        )
    left, right = (np.asarray(image, np.uint8) for image in images)
    return left, right


def of(sequence: int, part: int = 0, x_m: float = 0.0, code: bytes | None = None, stretch: int = 0) -> ScanImages:
    T_o_c = se3.from_rt(level_rotation(UP).T, np.array([0.0, x_m, HEIGHT_M]))
    code = encode_pair(room_pair(x_m), 95) if code is None else code
    record = ScanImages(keyframe(sequence), T_o_c, stretch, UP, code, part, np.eye(4) if part else None)
    read = messages.decode(record.key(), messages.encode(record))
    assert isinstance(read, ScanImages)
    return read


def keyframe(sequence: int) -> KeyframeId:
    return keyframe_id(submap_id(0, 0, 0), sequence)


def scans(with_camera: bool = True, keyframes: int = 300) -> ImageScans:
    sparse_map = SparseMap()
    for k in range(keyframes):
        sparse_map.add_keyframe(keyframe(k), k, NO_KEYFRAME, np.eye(4), 6)
    if with_camera:
        sparse_map.set_camera(AgentId(0), CAMERA)
    return ImageScans(GroundConfig(), sparse_map, count(1))


def test_an_image_gives_the_scan_that_the_agent_would_make() -> None:
    made = scans()
    made.add(of(1))
    (job,) = made.jobs()
    result = run_job(job).result
    assert isinstance(result, ScanResult)
    segmenter, stripes = GroundSegmenter(CAMERA, GroundConfig()), DisparityStripes(SMALL, GroundConfig())
    stripes.begin_reduced(room_pair())
    seen = segmenter.segment(stripes.measure_begun(), stripes.pair, UP)
    ours, theirs = result.seen.scan, seen.scan
    assert ours.camera_height_m == pytest.approx(theirs.camera_height_m, abs=0.03)
    assert abs(len(ours) - len(theirs)) <= 2  # columns at the sides, of which little is seen
    _, a, b = np.intersect1d(ours.azimuths_rad.round(6), theirs.azimuths_rad.round(6), return_indices=True)
    both = np.isfinite(ours.obstacle_m[a]) & np.isfinite(theirs.obstacle_m[b])
    assert both.mean() > 0.5
    a, b = a[both], b[both]
    assert np.median(np.abs(ours.obstacle_m[a] - theirs.obstacle_m[b])) < 0.02
    assert np.median(np.abs(ours.obstacle_m[a] * np.cos(ours.azimuths_rad[a]) - WALL_M)) < 0.1


def result_of(job: Job, obstacle_m: float = 4.0, lowest_m: float = HEIGHT_M) -> JobDone:
    """A floor that all columns saw, without segmenting an image."""
    n = 20
    scan = ColumnScan(
        UP, -0.6, 0.06, np.full(n, 0.5), np.full(n, obstacle_m), np.full(n, obstacle_m), np.full(n, 3, np.uint8),
        np.full(n, obstacle_m), lowest_m,
    )  # fmt: skip
    inputs = job.inputs
    assert isinstance(inputs, ScanInputs)
    labels = np.ones(len(inputs.uv), np.uint8)
    return JobDone(job.id, job.kind, ScanResult(Segmented(scan, True, lowest_m), labels, inputs.brightness), 0)


def test_one_job_at_a_time_is_made_for_an_agent_and_scans_wait_for_the_ground() -> None:
    made = scans()
    for k in range(3):
        made.add(of(k, x_m=0.2 * k, code=b"x"))
    drawn: list[KeyframeScan] = []
    heights = []
    while not made.idle:
        (job,) = made.jobs()
        assert made.jobs() == [] and made.pending == 1
        heights.append(job.inputs.expected)
        drawn += made.finish(result_of(job))
        if len(heights) == 1:
            assert not drawn  # one view of a ground is not enough
    assert heights[:2] == [None, None] and heights[2] is not None
    assert heights[2].height_m == pytest.approx(HEIGHT_M, abs=0.01)
    assert [scan.keyframe for scan in drawn] == [keyframe(k) for k in range(3)]
    assert all(np.isfinite(scan.scan.camera_height_m) for scan in drawn)
    assert {key: bytes.fromhex(scan.code) for key, scan in made.made.items()} == {
        (int(scan.keyframe), 0): messages.encode(scan) for scan in drawn
    }


def test_images_wait_for_their_keyframe_and_hold_up_no_others() -> None:
    made = scans(keyframes=2)
    for k in (7, 1):
        made.add(of(k, x_m=0.2 * k, code=b"x"))
    (job,) = made.jobs()
    made.finish(result_of(job))
    assert made.jobs() == [] and made.idle
    made._map.add_keyframe(keyframe(7), 7, NO_KEYFRAME, np.eye(4), 0)
    assert not made.idle
    (job,) = made.jobs()
    assert [scan.keyframe for scan in made.finish(result_of(job))] == [keyframe(1), keyframe(7)]


def test_scans_above_a_table_are_taken_back() -> None:
    made = scans()
    steps = [(1.0, 0.0), (1.0, 0.2), (1.0, 0.4), (HEIGHT_M, 0.6), (HEIGHT_M, 0.8), (HEIGHT_M, 1.0), (HEIGHT_M, 1.2)]
    held: dict[KeyframeId, KeyframeScan] = {}
    for k, (height_m, x_m) in enumerate(steps):
        made.add(of(k, x_m=x_m, code=b"x"))
        (job,) = made.jobs()
        for scan in made.finish(result_of(job, lowest_m=height_m)):
            held[scan.keyframe] = scan
    known = {k: np.isfinite(held[keyframe(k)].scan.camera_height_m) for k in range(len(steps)) if keyframe(k) in held}
    assert not any(known.get(k, False) for k in range(3)) and known[0] is np.False_
    assert known[len(steps) - 1]


def test_a_new_stretch_of_flight_begins_without_a_height() -> None:
    made = scans()
    for k in range(3):
        made.add(of(k, x_m=0.2 * k, code=b"x"))
        (job,) = made.jobs()
        made.finish(result_of(job))
    made.add(of(3, x_m=0.6, code=b"x", stretch=1))
    assert made.jobs()[0].inputs.expected is None


def test_labels_are_those_of_new_landmarks() -> None:
    made = scans()
    sparse_map = made._map
    uv = np.array([[100.0, 50.0], [200.0, 60.0], [300.0, 70.0]], np.float32)
    zeros = np.zeros(3, np.uint8)
    sparse_map.put_new_landmarks(
        keyframe(0), 0, np.array([0, 2, 3], np.uint16), uv, np.ones(3, np.float32), zeros, zeros,
        np.zeros((3, 32), np.uint8),
    )  # fmt: skip
    for k, x_m in ((0, 0.0), (1, 0.3)):
        made.add(of(k, x_m=x_m, code=b"x"))
        (job,) = made.jobs()
        assert np.array_equal(job.inputs.uv, uv if k == 0 else np.zeros((0, 2)))
        drawn = made.finish(result_of(job))
    assert drawn[0].labels.tolist() == [1, 0, 1, 1] and not len(drawn[1].labels)


def test_what_is_no_image_or_failed_leaves_no_scan_and_the_next_one_is_made() -> None:
    made = scans()
    for k in range(3):
        made.add(of(k, code=b"no image"))
    (first,) = made.jobs()
    done = run_job(first)
    assert done.result is None and made.finish(done) == [] and made.unreadable == 1
    (second,) = made.jobs()
    made.forget(second.id)
    assert made.finish(set_aside(second, "died")) == []
    assert len(made.jobs()) == 1 and not made.made


def test_images_wait_for_the_camera_and_not_without_end() -> None:
    made = scans(with_camera=False)
    for k in range(200):
        made.add(of(k, code=b"x"))
    assert made.jobs() == [] and not made.idle
    made._map.set_camera(AgentId(0), CAMERA)
    assert made.jobs()[0].inputs.images == b"x"
    assert len(made._waiting[AgentId(0)]) == 63
    mono = scans(with_camera=False)
    mono._map.set_camera(AgentId(0), RectifiedCamera(752, 480, 430.0, 430.0, 375.0, 245.0, 0.1, False, np.eye(4)))
    mono.add(of(0, code=b"x"))
    assert mono.jobs() == [] and mono.idle


def test_made_scans_outlive_the_process_and_go_with_their_submap() -> None:
    made = scans()
    for k in range(2):
        made.add(of(k, x_m=0.3 * k, code=b"x"))
        (job,) = made.jobs()
        drawn = made.finish(result_of(job))
    again = scans()
    assert [messages.encode(s) for s in again.restore(made.made)] == [messages.encode(s) for s in drawn]
    assert again.made == made.made
    with pytest.raises(ValueError, match="cannot be read"):
        scans().restore({(int(keyframe(0)), 0): MadeScan("00")})
    again.add(of(7, code=b"x"))
    again.delete([submap_id(0, 0, 0)])
    assert again.idle and not again.made
