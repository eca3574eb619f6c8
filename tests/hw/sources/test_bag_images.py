"""Encodings of pixels in ROS 2 bags."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_hw.sources.open import open_source
from tests.hw.sources.camera_messages import START_NS, STEP_NS, picture, read
from tests.hw.sources.ros2_bags import Bag


def test_raw_pixels_and_depth(tmp_path: Path) -> None:
    bag = Bag()
    bag.info(START_NS, "rgb", d=())
    colour = np.dstack([picture(i) for i in range(3)])
    for i in range(3):
        t_ns = START_NS + i * STEP_NS
        bag.raw(t_ns, "rgb", "rgb8", colour, pad=5)
        bag.raw(t_ns + 4_000_000, "depth", "16UC1", np.full((48, 64), 1500, np.uint16), frame="rgb_optical")
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    frames, _ = read(source)
    assert len(frames) == 3 and source.rig.has_depth and not source.rig.has_body and frames[0].encoded == ()
    np.testing.assert_array_equal(frames[0].left, cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY))
    np.testing.assert_allclose(frames[0].depth_m, 1.5)


def test_colour_images_come_without_the_depth_that_a_slower_camera_lacks(tmp_path: Path) -> None:
    bag = Bag()
    bag.info(START_NS, "rgb", d=())
    for i in range(6):
        t_ns = START_NS + i * STEP_NS
        bag.raw(t_ns, "rgb", "mono8", picture(i))
        if i % 2 == 0:
            bag.raw(t_ns, "depth", "16UC1", np.full((48, 64), 1500, np.uint16), frame="rgb_optical")
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    frames, _ = read(source)
    assert [frame.depth_m is not None for frame in frames] == [True, False] * 3
    assert source.report.skipped == {"missing depth image": 3}


@pytest.mark.parametrize(
    ("encoding", "pixels", "grey"),
    [
        ("mono8", np.full((48, 64), 77, np.uint8), 77),
        ("mono16", np.full((48, 64), 77 * 256 + 9, np.uint16), 77),
        ("bgr8", np.full((48, 64, 3), (255, 0, 0), np.uint8), 29),
        ("rgb8", np.full((48, 64, 3), (255, 0, 0), np.uint8), 76),
        ("rgba8", np.full((48, 64, 4), (255, 0, 0, 9), np.uint8), 76),
        ("yuv422", np.full((48, 64, 2), (1, 77), np.uint8), 77),
        ("yuv422_yuy2", np.full((48, 64, 2), (77, 1), np.uint8), 77),
        # A red scene: in RGGB the first pixel of each 2x2 block is bright.
        ("bayer_rggb8", np.tile(np.array([[255, 0], [0, 0]], np.uint8), (24, 32)), 76),
        ("bayer_bggr8", np.tile(np.array([[255, 0], [0, 0]], np.uint8), (24, 32)), 29),
        ("bayer_gbrg8", np.tile(np.array([[0, 0], [255, 0]], np.uint8), (24, 32)), 76),
        ("bayer_grbg8", np.tile(np.array([[0, 255], [0, 0]], np.uint8), (24, 32)), 76),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_pixel_encodings(tmp_path: Path, encoding: str, pixels: np.ndarray, grey: int) -> None:
    bag = Bag()
    bag.info(START_NS, "eye")
    bag.raw(START_NS, "eye", encoding, pixels)
    frames, _ = read(open_source(str(bag.write(tmp_path / "a.mcap"))))
    np.testing.assert_allclose(frames[0].left[2:-2, 2:-2], grey, atol=1)


@pytest.mark.parametrize(("brightest", "bits"), [(900, 10), (1023, 10), (3000, 12), (16383, 14), (16384, 16)])
def test_mono16_is_scaled_by_the_bits_that_the_camera_fills(tmp_path: Path, brightest: int, bits: int) -> None:
    """Fixed for the recording and for both eyes, by the brightest pixel of the first images; later ones are clipped."""
    bag = Bag()
    bag.info(START_NS, "left", tx=0.0)
    bag.info(START_NS, "right", tx=-6.6)
    for i in range(70):
        for side in ("left", "right"):
            image = np.full((48, 64), min(500 + 200 * (i > 65), brightest), np.uint16)
            image[0, 0] = brightest if (side, i) == ("right", 40) else 65535 if i == 69 else 0
            bag.raw(START_NS + i * STEP_NS, side, "mono16", image)
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    frames, _ = read(source)
    assert frames[0].left[9, 9] == 500 >> (bits - 8) and frames[68].left[9, 9] == 700 >> (bits - 8)
    assert frames[40].right[0, 0] == brightest >> (bits - 8)
    assert frames[69].left[0, 0] == 255
    assert any(f"hold {bits} bits" in note for note in source.report.notes) == (bits < 16)


@pytest.mark.parametrize("encoding", ["mono10", "mono12"])
def test_an_encoding_that_names_its_bits_is_scaled_by_them(tmp_path: Path, encoding: str) -> None:
    bag = Bag()
    bag.info(START_NS, "eye")
    bag.raw(START_NS, "eye", encoding, np.full((48, 64), 500, np.uint16))
    frames, _ = read(open_source(str(bag.write(tmp_path / "a.mcap"))))
    assert (frames[0].left == 500 >> (int(encoding[4:]) - 8)).all()
