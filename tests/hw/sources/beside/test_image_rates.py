"""Images whose names are no stamps: at which rate they are flown, and that the user is told."""

from pathlib import Path

import pytest

from kiteline_core.frame import Frame
from kiteline_hw.ports import FrameSource, SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.sources.folder_files import picture, put

CAMERA = "fx: 60\nfy: 60\ncx: 32\ncy: 24\nwidth: 64\nheight: 48\n"


def stamps(source: FrameSource) -> list[int]:
    return [item.t_ns for item in source if isinstance(item, Frame)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(3):
        put(tmp_path / "a1" / f"{i}.png", picture(i))
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return tmp_path


def test_a_rate_that_nobody_told_is_said(folder: Path) -> None:
    source = open_source(f"images:{folder}/a?/*.png")
    assert stamps(source) == [0, 100_000_000, 200_000_000]
    assert len(source.report.notes) == 1 and "10 images a second; 'images:" in source.report.notes[0]
    assert "?fps=20'" in source.report.notes[0]


@pytest.mark.parametrize("scheme", ["images:", ""])
def test_the_rate_follows_the_patterns(folder: Path, scheme: str) -> None:
    source = open_source(f"{scheme}{folder}/a?/*.png?fps=50")
    assert stamps(source) == [0, 20_000_000, 40_000_000] and source.report.notes == []


def test_the_rate_of_camera_yaml_counts_with_another_calibration_too(folder: Path, tmp_path: Path) -> None:
    (folder / "camera.yaml").write_text(CAMERA + "rate_hz: 25\n")
    other = tmp_path / "other.yaml"
    other.write_text("%YAML:1.0\nCamera.fx: 60\nCamera.fy: 60\nCamera.cx: 32\nCamera.cy: 24\nCamera.width: 64\n"
                     "Camera.height: 48\n")  # fmt: skip
    assert stamps(open_source(f"images:{folder}/a1/*.png", calibration=str(other))) == [0, 40_000_000, 80_000_000]
    asked = open_source(f"images:{folder}/a1/*.png?fps=50", calibration=str(other))
    assert stamps(asked) == [0, 20_000_000, 40_000_000]


@pytest.mark.parametrize("rate", ["0", "-1", "fast", "nan", "1e-30", ""])
def test_a_rate_that_is_none_is_refused(folder: Path, rate: str) -> None:
    with pytest.raises(SourceError, match="expected images a second"):
        open_source(f"images:{folder}/a1/*.png?fps={rate}")
    (folder / "camera.yaml").write_text(CAMERA + f"rate_hz: {rate or '[2]'}\n")
    with pytest.raises(SourceError, match=r"camera\.yaml: rate_hz is .*: expected images a second"):
        open_source(f"images:{folder}/a1/*.png")
