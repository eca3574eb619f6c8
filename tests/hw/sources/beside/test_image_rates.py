"""Times of images: stamps in their names, else the rate at which they are flown, of which the user is told."""

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


@pytest.mark.parametrize(
    ("names", "t_ns"),
    [
        (["1687709760547307", "1687709760580640"], [1687709760547307000, 1687709760580640000]),  # us since 1970
        (["1575968123456", "1575968123656"], [1575968123456000000, 1575968123656000000]),  # ms since 1970
        (["1403636579763555584", "1403636579813555456"], [1403636579763555584, 1403636579813555456]),  # ns
        (["1403636579.763555", "1403636579.813555"], [1403636579763555000, 1403636579813555000]),  # s
        (["1500000000000000", "1500000050000000"], [1500000000000000, 1500000050000000]),  # ns, 17 days after a start
        (["00000000000050000000", "00000000000100000000"], [50_000_000, 100_000_000]),  # ns since a start
        (["1400000000000", "1400050000000"], [0, 100_000_000]),  # 13 digits, in ms too far apart: numbers
        (["20230625", "20230626"], [0, 100_000_000]),
    ],
)
def test_stamps_in_names_tell_their_unit(names: list[str], t_ns: list[int], tmp_path: Path) -> None:
    for i, name in enumerate(names):
        put(tmp_path / f"{name}.png", picture(i))
    (tmp_path / "camera.yaml").write_text(CAMERA)
    assert stamps(open_source(f"images:{tmp_path}/*.png")) == t_ns
