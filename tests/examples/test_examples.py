"""The scripts in examples/ run as they are, on a small simulated recording."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from kiteline_core.frame import Frame
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from tests.wall import STEP_M

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(script: str, *arguments: str) -> list[str]:
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.mark.parametrize("script", sorted(p.name for p in EXAMPLES.glob("*.py")))
def test_examples_are_short(script: str) -> None:
    code = [line for line in (EXAMPLES / script).read_text().splitlines() if line.strip()]
    assert len(code) <= 45


def test_images_become_poses(recording: Path, tmp_path: Path) -> None:
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    frames = [item for item in open_source(str(recording)) if isinstance(item, Frame)]
    for i, frame in enumerate(frames):
        assert frame.right is not None
        cv2.imwrite(str(tmp_path / f"left/{i:04d}.png"), frame.left)
        cv2.imwrite(str(tmp_path / f"right/{i:04d}.png"), frame.right)
    lines = run("track_images.py", str(tmp_path))
    assert len(lines) == len(frames)
    y_m = [float(re.findall(r"y ([+-]\d+\.\d+)", line)[0]) for line in lines]
    assert y_m[-1] == pytest.approx(-STEP_M * (len(frames) - 1), abs=0.005)  # the camera slides to the right


def test_a_flown_log_becomes_arrays(recording: Path, tmp_path: Path) -> None:
    fly(Options((str(recording),), tmp_path, "tracker"), quiet=True)
    lines = run("read_log.py", str(tmp_path / "agent0" / "log.mcap"))
    assert lines[0].startswith("left images    (30, 240, 320) uint8")
    assert lines[1] == "gyro, accel    (0, 3), (0, 3)"
    found = re.match(r"odometry       \(30, 4, 4\), path (\d\.\d+) m", lines[2])
    assert float(found[1]) == pytest.approx(29 * STEP_M, abs=0.01)


@pytest.mark.parametrize(("arguments", "words"), [([], "out/agent0/log.mcap"), (["none.mcap"], "no such file")])
def test_a_log_that_is_not_there_is_one_line_of_error(arguments: list[str], words: str) -> None:
    command = [sys.executable, str(EXAMPLES / "read_log.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and words in done.stderr and "Traceback" not in done.stderr
