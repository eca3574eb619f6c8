"""Images are flown in the order of the numbers in their names, and paired by them."""

import re
from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.sources.folder_files import put, read

CALIB = "fx: 60\nfy: 60\ncx: 32\ncy: 24\nwidth: 64\nheight: 48\nbaseline_m: 0.1\n"


def shade(path: Path, number: int) -> None:
    """An image that holds its number."""
    put(path, np.full((48, 64), number, np.uint8))


def numbers(source: str) -> tuple[list[tuple[int, int | None]], dict[str, int]]:
    """The numbers of the images of each frame, left and right, and what was skipped."""
    frames, _ = read(opened := open_source(source))
    shades = [(int(f.left[0, 0]), None if f.right is None else int(f.right[0, 0])) for f in frames]
    return shades, opened.report.skipped


def test_images_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CALIB)
    for i in range(12):
        shade(tmp_path / "a" / f"{i}.png", i)
        shade(tmp_path / "kitti" / "image_0" / f"{i}.png", i)
    for stamp in ("1.5", "1.25"):
        shade(tmp_path / "b" / f"{stamp}.png", 0)
    assert numbers(f"images:{tmp_path}/a/*.png")[0] == [(i, None) for i in range(12)]
    assert [f.t_ns for f in read(open_source(f"images:{tmp_path}/b/*.png"))[0]] == [1_250_000_000, 1_500_000_000]
    (tmp_path / "kitti" / "calib.txt").write_text("60 0 32 0 0 60 24 0 0 0 1 0")
    assert numbers(f"kitti:{tmp_path}/kitti") == ([(i, None) for i in range(12)], {})


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("l_{:03}.png", "r_{:03}.png"), ("{}_left1.png", "{}_right2.png"), ("l/{:04}.png", "r2/cam1_{}.png"),
        ("{:03}_{t:06}l.png", "{:03}_{t:04}r.png"), ("{:019}l.png", "{}r.png"),
    ],
)  # fmt: skip
def test_images_are_paired_by_their_numbers(tmp_path: Path, left: str, right: str) -> None:
    (tmp_path / "camera.yaml").write_text(CALIB)
    for i in range(12):
        if i != 3:
            shade(tmp_path / left.format(i, t=7 * i), i)
        if i != 7:
            shade(tmp_path / right.format(i, t=7 * i + 1), i)
    patterns = [re.sub(r"\{.*?\}", "*", name) for name in (left, right)]
    shades, skipped = numbers(f"images:{tmp_path}/{patterns[0]},{tmp_path}/{patterns[1]}")
    assert shades == [(i, None if i == 7 else i) for i in range(12) if i != 3]
    assert skipped == {"missing right image": 1, "missing left image": 1}


def test_images_named_by_stamps_are_paired_by_time(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CALIB)
    for i in range(6):
        if i != 2:
            shade(tmp_path / "l" / f"{10**18 + i * 10**8}.png", i)
        if i != 4:
            shade(tmp_path / "r" / f"{10**18 + i * 10**8 + 300_000}.png", i)
    shades, skipped = numbers(f"images:{tmp_path}/l/*.png,{tmp_path}/r/*.png")
    assert shades == [(0, 0), (1, 1), (3, 3), (4, None), (5, 5)]
    assert skipped == {"missing right image": 1, "missing left image": 1}


def test_images_whose_numbers_do_not_fit_each_other_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CALIB)
    for i in range(6):
        shade(tmp_path / "l" / f"DSC{i}.png", i)
        shade(tmp_path / "r" / f"DSC{i + 5}.png", i)
    with pytest.raises(SourceError, match=r"do not fit each other, first DSC0\.png and DSC5\.png: expected"):
        open_source(f"images:{tmp_path}/l/*.png,{tmp_path}/r/*.png")
