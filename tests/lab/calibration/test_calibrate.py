"""`kiteline calibrate` on rendered boards and on exact corners of known cameras."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_lab.calibration import lenses
from kiteline_lab.calibration.best_lens import best_lens
from kiteline_lab.calibration.boards import BoardError, Corners, parse_board, same_order
from kiteline_lab.calibration.calibrate import NoBoard, main
from kiteline_lab.calibration.solve import Calibrated, CalibrationFailed, calibrate
from kiteline_lab.calibration.verdict import judge
from kiteline_lab.calibration.views import Coverage, View, ViewCollector
from tests.lab.rendered_boards import directions_of, intrinsics, picture, poses

RADTAN = CameraModel(640, 480, 436.2, 437.1, 325.5, 236.25, Lens.RADTAN, (-0.28, 0.07, 0.0003, -0.0008))
FISHEYE = CameraModel(512, 512, 190.97, 190.97, 254.9, 256.9, Lens.EQUIDISTANT, (0.0034, 0.0007, -0.002, 0.0002))
T_C_R = se3.exp(np.array([0.11, 0.002, -0.003, 0.01, -0.02, 0.015]))
BOARD = parse_board("charuco:9x7:0.03")


def corners(camera: CameraModel, T: np.ndarray, rng: np.random.Generator, noise_px: float) -> Corners | None:
    """Where a camera sees the board's corners, those outside of the image left out."""
    points = se3.transform(T, BOARD.points_m)
    px = lenses.project(camera.lens, intrinsics(camera), points)
    inside = (px > 0).all(1) & (px < (camera.width - 1, camera.height - 1)).all(1)
    inside &= points[:, 2] > (0.02 if camera.lens is not Lens.EQUIDISTANT else -1.0)
    if inside.sum() < 12:
        return None
    ids = np.flatnonzero(inside)
    return Corners(ids, px[ids] + rng.normal(0, noise_px, (len(ids), 2)))


def exact_views(left: CameraModel, right: CameraModel | None, count: int, seed: int, noise_px: float) -> list[View]:
    rng = np.random.default_rng(seed)
    half = 1.3 if left.lens is Lens.EQUIDISTANT else 0.5
    out = []
    for i, T in enumerate(poses(BOARD, left, count, rng, half)):
        eyes = [corners(left, T, rng, noise_px)]
        if right is not None:
            eyes.append(corners(right, se3.inverse(T_C_R) @ T, rng, noise_px))
        if any(eye is not None for eye in eyes):
            out.append(View(i, tuple(eyes)))
    return out


def pixels_apart(a: CameraModel, b: CameraModel) -> float:
    """How far apart two cameras see the same directions, free of the turn that neither can know: rms px."""
    rays = lenses.rays(a.lens, intrinsics(a), _grid(a))
    turn = np.zeros(3)
    for _ in range(5):
        moved = rays @ se3.so3_exp(turn).T
        error = (lenses.project(b.lens, intrinsics(b), moved) - _grid(a)).ravel()
        J = np.stack([
            (lenses.project(b.lens, intrinsics(b), rays @ se3.so3_exp(turn + 1e-5 * e).T)
             - lenses.project(b.lens, intrinsics(b), moved)).ravel() / 1e-5
            for e in np.eye(3)
        ], 1)  # fmt: skip
        turn = turn - np.linalg.lstsq(J, error, rcond=None)[0]
    return float(np.sqrt((error.reshape(-1, 2) ** 2).sum(1).mean()))


def _grid(camera: CameraModel) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 9) * camera.width, np.linspace(0.1, 0.9, 7) * camera.height)
    return np.stack([x.ravel(), y.ravel()], 1)


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "equidistant"])
def test_derivatives_and_rays_of_a_lens(camera: CameraModel) -> None:
    v = intrinsics(camera)
    rng = np.random.default_rng(0)
    limit = 1.7 if camera.lens is Lens.EQUIDISTANT else 0.5
    angle, around = rng.uniform(0, limit, 50), rng.uniform(0, 6.28, 50)
    points = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], 1)
    by_v, by_x = lenses.derivatives(camera.lens, v, points)
    step = 1e-5 * rng.normal(size=len(v))
    change = lenses.project(camera.lens, v + step, points) - lenses.project(camera.lens, v, points)
    np.testing.assert_allclose(by_v @ step, change, atol=1e-6)
    move = 1e-6 * rng.normal(size=points.shape)
    change = lenses.project(camera.lens, v, points + move) - lenses.project(camera.lens, v, points)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", by_x, move), change, atol=1e-6)
    px = lenses.project(camera.lens, v, points)
    np.testing.assert_allclose(lenses.rays(camera.lens, v, px), points, atol=1e-4)
    project = cv2.fisheye.projectPoints if camera.lens is Lens.EQUIDISTANT else cv2.projectPoints
    front = angle < 1.2
    theirs, _ = project(points[front][:, None], np.zeros(3), np.zeros(3), camera.matrix(), np.array(camera.distortion))
    np.testing.assert_allclose(px[front], theirs.reshape(-1, 2), atol=1e-6)


@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from([RADTAN, FISHEYE]), st.integers(0, 1000), st.floats(0.0, 0.3))
@example(FISHEYE, 117, 0.1)  # a steep board beside the camera, whose origin lies behind what is seen
def test_a_camera_is_found_by_its_corners(camera: CameraModel, seed: int, noise_px: float) -> None:
    views = exact_views(camera, None, 30, seed, noise_px)
    result = calibrate(BOARD.points_m, views, [(camera.width, camera.height)], camera.lens, 4)
    assert result.left_out == 0
    assert result.residuals[0].rms_px == pytest.approx(noise_px * np.sqrt(2), rel=0.15, abs=1e-3)
    found = result.cameras[0]
    assert pixels_apart(camera, found) < 0.02 + 2.5 * noise_px
    assert abs(found.fx - camera.fx) < 1e-2 + 5.0 * result.sigma[0]


def test_a_wide_pair_is_found_with_corners_beside_the_cameras() -> None:
    right = CameraModel(512, 512, 190.4, 190.4, 252.6, 254.9, Lens.EQUIDISTANT, (0.0034, 0.0018, -0.0027, 0.0003))
    views = exact_views(FISHEYE, right, 30, 3, 0.1)
    assert any(view.eyes[0] is None for view in views) or len(views) == 30
    result = calibrate(BOARD.points_m, views, [(512, 512)] * 2, Lens.EQUIDISTANT, 4)
    np.testing.assert_allclose(result.T_c_r[:3, 3], T_C_R[:3, 3], atol=5e-4)
    assert np.linalg.norm(se3.so3_log(result.T_c_r[:3, :3].T @ T_C_R[:3, :3])) < 1e-3
    assert pixels_apart(right, result.cameras[1]) < 0.1


def test_wrong_corners_do_not_turn_the_result() -> None:
    views = exact_views(RADTAN, None, 25, 5, 0.1)
    rng = np.random.default_rng(1)
    for view in views:
        assert view.eyes[0] is not None
        view.eyes[0].px[rng.integers(len(view.eyes[0].px))] += rng.normal(0, 20, 2)  # a corner of something else
    eye = views[3].eyes[0]
    eye.px[:] += rng.normal(0, 15, eye.px.shape)  # a view that is no board
    result = calibrate(BOARD.points_m, views, [(640, 480)], Lens.RADTAN, 4)
    assert result.left_out == 1 and pixels_apart(RADTAN, result.cameras[0]) < 0.3


def test_too_few_and_useless_views_are_refused() -> None:
    views = exact_views(RADTAN, None, 3, 5, 0.1)
    with pytest.raises(CalibrationFailed, match="3 views of the board by the camera: expected 4"):
        calibrate(BOARD.points_m, views, [(640, 480)], Lens.RADTAN, 4)
    views = [View(v.t_ns, (v.eyes[0], None)) for v in exact_views(RADTAN, None, 9, 5, 0.1)]
    with pytest.raises(CalibrationFailed, match="0 views of the board by the right camera"):
        best_lens(BOARD.points_m, views, [(640, 480)] * 2, "auto", 4)
    both = exact_views(RADTAN, RADTAN, 12, 5, 0.1)
    apart = [View(v.t_ns, (v.eyes[0], None) if i % 2 else (None, v.eyes[1])) for i, v in enumerate(both)]
    with pytest.raises(CalibrationFailed, match="0 views of the board by both cameras"):
        calibrate(BOARD.points_m, apart, [(640, 480)] * 2, Lens.RADTAN, 4)


def judged(result: Calibrated, views: list[View], size: tuple[int, int]) -> dict[str, str]:
    coverage = Coverage(size)
    for view in views:
        if view.eyes[0] is not None:
            coverage.add(view.eyes[0])
    return {f.text: f.mend for f in judge(result, [coverage], len(views)) if f.level != "good"}


def test_the_verdict_names_what_is_missing_and_how_to_mend_it() -> None:
    views = exact_views(RADTAN, None, 40, 2, 0.1)
    for view in views:
        eye = view.eyes[0]
        assert eye is not None
    kept = []
    for view in views:
        eye = view.eyes[0]
        right = eye.px[:, 0] > 160
        if right.sum() >= 8:
            kept.append(View(view.t_ns, (Corners(eye.ids[right], eye.px[right]),)))
    result = calibrate(BOARD.points_m, kept, [(640, 480)], Lens.RADTAN, 4)
    found = judged(result, kept, (640, 480))
    assert any("too few views at the left edge" in text and mend for text, mend in found.items())
    few = kept[:6]
    result = calibrate(BOARD.points_m, few, [(640, 480)], Lens.RADTAN, 4)
    assert any(
        text.startswith("6 views") and "15 times" in mend for text, mend in judged(result, few, (640, 480)).items()
    )


def test_frontal_views_do_not_tell_the_focal_length() -> None:
    rng = np.random.default_rng(0)
    views = []
    for i in range(20):
        T = se3.from_rt(np.eye(3), np.array([rng.uniform(-0.25, 0.0), rng.uniform(-0.2, 0.0), 0.4]))
        eye = corners(RADTAN, T, rng, 0.2)
        if eye is not None:
            views.append(View(i, (eye,)))
    with pytest.raises(CalibrationFailed, match=r"no focal length.*tilted"):
        calibrate(BOARD.points_m, views, [(640, 480)], Lens.RADTAN, 4)


@pytest.mark.parametrize(
    ("text", "message"),
    [("aprilgrid:6x6:0.08", "expected charuco"), ("charuco:9x7", "expected charuco"),
     ("charuco:9x2:0.03", "3x3 to 40x40"),
     ("charuco:nine:0.03", "3x3"),
     ("chessboard:9x6:30", "expected metres"),
     ("chessboard:9x6:nan", "expected metres"), ("charuco:9x7:0.03:0.04", "do not fit"),
     ("charuco:9x7:0.03:0.02:DICT_9X9", "not known"),
     ("charuco:30x30:0.03:0.02:DICT_4X4_50", "450 markers are needed"),
     ("chessboard:9x6:0.03:0.02", "expected charuco")],
)  # fmt: skip
def test_a_board_that_cannot_be_is_refused(text: str, message: str) -> None:
    with pytest.raises(BoardError, match=message):
        parse_board(text)


def test_a_printed_board_is_found_whole_and_in_part_and_turned(tmp_path: Path) -> None:
    assert main(["board", "charuco:9x7:0.03", "--out", str(tmp_path / "board.png")]) == 0
    image = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    image = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    whole = BOARD.find(np.asarray(image))
    assert len(whole.ids) == len(BOARD.points_m) == 48
    part = BOARD.find(np.ascontiguousarray(image[:, : image.shape[1] // 2]))
    assert 12 <= len(part.ids) < 30
    np.testing.assert_allclose(part.px, whole.px[part.ids], atol=0.3)
    assert BOARD.find(np.full((480, 640), 120, np.uint8)) is None
    chess = parse_board("chessboard:9x6:0.03")
    plain = chess.draw(40)
    seen = chess.find(plain)
    assert len(seen.ids) == 40
    turned = Corners(seen.ids, seen.px[::-1].copy())
    np.testing.assert_array_equal(same_order(seen, turned).px, seen.px)


def test_guidance_names_the_bare_side_and_ends_when_nothing_is_missing() -> None:
    collector = ViewCollector(BOARD, 1)
    assert not collector.is_complete
    white = np.full((480, 640), 200, np.uint8)
    assert not collector.add(0, (white, None)) and collector.frames == 1 and collector.seen == 0
    assert "edge" in collector.wanted()
    for coverage in collector.coverage:
        coverage.counts[:, 1:] = 9
    assert collector.wanted() == "the board at the left edge"
    collector.coverage[0].counts[:] = 9
    assert "upright axis" in collector.wanted()
    collector.tilted[:] = 9
    assert collector.wanted().startswith("more views")


def shots(folder: Path, count: int, right: CameraModel | None, seed: int = 4) -> str:
    rng = np.random.default_rng(seed)
    left_rays = directions_of(RADTAN)
    right_rays = None if right is None else directions_of(right)
    for name in ("l", "r"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for i, T in enumerate(poses(BOARD, RADTAN, count, rng, 0.5)):
        cv2.imwrite(str(folder / "l" / f"{i:03}.png"), picture(BOARD, left_rays, T, rng))
        if right_rays is not None:
            image = picture(BOARD, right_rays, se3.inverse(T_C_R) @ T, rng)
            cv2.imwrite(str(folder / "r" / f"{i:03}.png"), image)
    return f"images:{folder}/l/*.png" + (f",{folder}/r/*.png" if right is not None else "")


def test_a_pair_whose_first_right_image_is_missing(tmp_path: Path) -> None:
    shots(tmp_path, 3, RADTAN)
    images = [[cv2.imread(str(tmp_path / side / f"{i:03}.png"), 0) for side in "lr"] for i in range(3)]
    collector = ViewCollector(BOARD, 2)
    kept = [collector.add(i, (left, right if i else None)) for i, (left, right) in enumerate(images)]
    assert not kept[0] and any(kept) and len(collector.coverage) == 2


def test_rendered_pictures_of_a_pair_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    right = CameraModel(640, 480, 433.0, 434.0, 318.0, 241.0, Lens.RADTAN, (-0.27, 0.065, -0.0002, 0.0005))
    source = shots(tmp_path, 10, right)
    out, drawn = tmp_path / "rig.yaml", tmp_path / "residuals.png"
    command = ["camera", source, "--board", "charuco:9x7:0.03", "--out", str(out), "--lens", "radtan"]
    status = main([*command, "--picture", str(drawn), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert status == 0 and said["verdict"] in ("good", "poor") and max(said["rms_px"]) < 0.3
    told = read_calibration(str(out))
    np.testing.assert_allclose(told.T_c_r[:3, 3], T_C_R[:3, 3], atol=6e-4)
    assert np.linalg.norm(se3.so3_log(told.T_c_r[:3, :3].T @ T_C_R[:3, :3])) < 2e-3
    assert pixels_apart(RADTAN, told.cameras[0]) < 0.4 and pixels_apart(right, told.cameras[1]) < 0.4
    image = cv2.imread(str(drawn))
    assert image.shape[1] == 1280
    # the file flies the very images that it was made of
    frames = [f for f in open_source(source, calibration=str(out)) if isinstance(f, Frame)]
    assert len(frames) == 10 and frames[0].right is not None
    with pytest.raises(SourceError, match="exists already"):
        main(command)
    for form in ("kalibr", "opencv", "ros", "euroc"):
        assert main(["export", str(out), "--format", form, "--out", str(tmp_path / form)]) == 0
    with pytest.raises(SourceError, match="exist already"):
        main(["export", str(out), "--format", "euroc", "--out", str(tmp_path / "euroc")])
    names = capsys.readouterr().out.split()
    back = read_calibration(next(n for n in names if n.endswith("camchain.yaml")))
    assert back.cameras == told.cameras and back.T_c_r is not None
    np.testing.assert_allclose(back.T_c_r, told.T_c_r, atol=1e-12)


def test_a_few_pictures_of_one_camera_are_poor_and_say_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = shots(tmp_path, 7, None)
    out = tmp_path / "calibration.yaml"
    assert main(["camera", source, "--board", "charuco:9x7:0.03", "--out", str(out), "--lens", "radtan"]) == 0
    text = capsys.readouterr().out
    assert "poor  7 views: show the board 15 times" in text and "next, show the board" in text
    assert read_calibration(str(out)).cameras[0].width == 640


def test_pictures_without_the_board_leave_no_file(tmp_path: Path) -> None:
    source = shots(tmp_path, 2, None)
    out = tmp_path / "calibration.yaml"
    with pytest.raises(NoBoard, match=r"none of 2 images: expected a ChArUco board \(DICT_4X4_50\).*--board"):
        main(["camera", source, "--board", "charuco:9x7:0.03:0.02:DICT_4X4_50", "--out", str(out)])
    assert not out.exists()


@pytest.mark.parametrize(
    "words",
    [
        *(["imu", "--rig", "rig.toml", "--seconds", text] for text in ("nan", "-1", "0", "inf", "a")),
        *(["camera", "--board", "charuco:9x7:0.03", "--every", text] for text in ("nan", "-1", "1e300")),
    ],
)
def test_numbers_that_are_no_time_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([words[0], "images:nowhere", *words[1:]])
    assert f"{words[-2]}: {words[-1]}: expected " in capsys.readouterr().err
