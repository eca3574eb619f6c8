"""odometer.csv beside the images of a data set: velocities, or counts of encoders."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_core.frame import UNMEASURED, Frame, OdometryBatch
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.sources.folder_files import picture, put

FRAME_S, N = 0.1, 6
TICK_M, TRACK_M = 0.0005, 0.4


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One camera, right, down, forward, at 10 Hz from 1 s on."""
    stamps = [f"{1.0 + FRAME_S * k:.6f}" for k in range(N)]
    for k, stamp in enumerate(stamps):
        put(tmp_path / "rgb" / f"{stamp}.png", picture(k))
    (tmp_path / "rgb.txt").write_text("".join(f"{stamp} rgb/{stamp}.png\n" for stamp in stamps))
    height, width = picture(0).shape[:2]
    (tmp_path / "camera.yaml").write_text(f"fx: 60\nfy: 60\ncx: 32\ncy: 24\nwidth: {width}\nheight: {height}\n")
    return tmp_path


def samples(folder: Path) -> tuple[OdometryBatch, list[int]]:
    """All samples, and how many came before each frame."""
    batches, counts = [], []
    for item in open_source(str(folder)):
        if isinstance(item, OdometryBatch):
            batches.append(item)
        elif isinstance(item, Frame):
            counts.append(sum(len(batch.t_ns) for batch in batches))
            assert all(batch.t_ns[-1] <= item.t_ns for batch in batches)
    names = OdometryBatch.__dataclass_fields__
    return OdometryBatch(*(np.concatenate([getattr(batch, name) for batch in batches]) for name in names)), counts


def test_velocities_are_those_of_a_device_that_looks_where_the_camera_looks(folder: Path) -> None:
    (folder / "odometer.csv").write_text("t_s,vx,wz\n" + "".join(f"{1.0 + 0.02 * k},0.5,0.2\n" for k in range(30)))
    found, counts = samples(folder)
    assert counts == [1, 6, 11, 16, 21, 26]
    np.testing.assert_allclose(found.velocity[0], [0.0, 0.0, 0.5], atol=1e-12)  # the camera's axes are the body's
    np.testing.assert_allclose(found.rate[0], [0.0, -0.2, 0.0], atol=1e-12)
    assert found.velocity_cov[0, 2, 2] == pytest.approx(0.01) and found.velocity_cov[0, 0, 0] >= UNMEASURED
    assert found.rate_cov[0, 1, 1] == pytest.approx(0.0025) and found.rate_cov[0, 2, 2] >= UNMEASURED


def test_encoders_roll_and_turn(folder: Path) -> None:
    """0.5 m/s ahead and 0.25 rad/s to the left, counted at 100 Hz; the counts are differenced over 20 ms."""
    t_s = 1.0 + 0.01 * np.arange(60)
    left, right = ((0.5 + side * 0.25 * TRACK_M / 2) * (t_s - 1.0) / TICK_M for side in (-1.0, 1.0))
    rows = [f"{round(t * 1e9)},{a:.0f},{b:.0f}" for t, a, b in zip(t_s, left, right, strict=True)]
    (folder / "odometer.csv").write_text("t_ns,ticks_left,ticks_right\n" + "\n".join(rows))
    (folder / "odometer.yaml").write_text(
        f"metres_per_tick: {TICK_M}\ntrack_m: {TRACK_M}\nvelocity_sigma_m_s: 0.03\n"
        "T_b_d: [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 0, 0, 0, 1]\n"
    )
    found, _ = samples(folder)
    np.testing.assert_array_equal(np.diff(found.t_ns), 20_000_000)
    assert found.t_ns[0] == 1_010_000_000
    assert found.velocity[:, 2].mean() == pytest.approx(0.5, abs=2e-3)
    assert found.rate[:, 1].mean() == pytest.approx(-0.25, abs=5e-3)
    assert found.velocity_cov[0, 2, 2] == pytest.approx(9e-4)
    (folder / "odometer.yaml").write_text(f"metres_per_tick: {TICK_M}\n")  # without a track they measure no turn
    assert samples(folder)[0].rate_cov[0, 1, 1] >= UNMEASURED


def test_gaps_and_stamps_that_go_back_are_left_out(folder: Path) -> None:
    rows = ["1.0,0,0", "1.05,100,100", "1.04,0,0", "1.1,200,200", "1.9,900,900", "1.92,940,940"]
    (folder / "odometer.csv").write_text("t_s,ticks_left,ticks_right\n" + "\n".join(rows))
    (folder / "odometer.yaml").write_text("metres_per_tick: 0.0005\n")
    found, counts = samples(folder)
    assert found.t_ns.tolist() == [1_025_000_000, 1_075_000_000] and counts == [0, 2, 2, 2, 2, 2]
    np.testing.assert_allclose(found.velocity[:, 2], 1.0)


@pytest.mark.parametrize(
    ("text", "yaml", "says"),
    [
        ("", "", "t_ns or t_s"),
        ("1.0,0.5\n", "", "t_ns or t_s"),
        ("t_s,speed\n1.0,0.5\n", "", "ticks_left,ticks_right"),
        ("t_s,vx\n1.0,fast\n", "", "does not fit t_s,vx"),
        ("t_s,vx\n1.0\n", "", "does not fit t_s,vx"),
        ("t_ns,vx\n-5,0.1\n", "", "does not fit t_ns,vx"),
        ("t_s,ticks_left,ticks_right\n1.0,2,3\n", "", "metres_per_tick"),
        ("t_s,vx\n1.0,0.5\n", "T_b_d: [1, 2]\n", "T_b_d"),
        ("t_s,vx\n1.0,0.5\n", "T_b_d: [a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p]\n", "T_b_d"),
    ],
)
def test_a_file_that_is_none_is_an_error_with_its_name(folder: Path, text: str, yaml: str, says: str) -> None:
    (folder / "odometer.csv").write_text(text)
    if yaml:
        (folder / "odometer.yaml").write_text(yaml)
    with pytest.raises(SourceError, match=says) as caught:
        open_source(str(folder))
    assert "odometer." in str(caught.value)


def test_without_samples_there_is_no_odometry(folder: Path) -> None:
    (folder / "odometer.csv").write_text("t_s,vx\n")
    assert not any(isinstance(item, OdometryBatch) for item in open_source(str(folder)))
    (folder / "odometer.csv").write_text("t_s,ticks_left,ticks_right\n")
    (folder / "odometer.yaml").write_text("metres_per_tick: 0.0005\n")
    assert not any(isinstance(item, OdometryBatch) for item in open_source(f"images:{folder / 'rgb'}/*.png"))
