"""A simulated flight as a source: reproducible to the byte, and its options."""

from typing import Any

import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.ids import MAX_AGENTS
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.source import START_NS, open_sim

SMALL: dict[str, Any] = {"scale": 0.2, "texture_bits": 8, "seconds": 0.5}


def frames(scene: str, workers: int = 1, **options: Any) -> list[Frame]:
    return [item for item in open_sim(scene, workers, **(SMALL | options)) if isinstance(item, Frame)]


def same(a: Frame, b: Frame) -> bool:
    assert a.right is not None and b.right is not None
    return a.t_ns == b.t_ns and bool((a.left == b.left).all() and (a.right == b.right).all())


@pytest.mark.parametrize("scene", ["room", "street"])
def test_the_same_seed_gives_the_same_bytes(scene: str) -> None:
    first, second = frames(scene, seed=5), frames(scene, workers=2, seed=5)
    assert len(first) == len(second) == 10
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    assert not same(first[3], frames(scene, seed=6)[3])


def test_a_frame_does_not_depend_on_earlier_frames() -> None:
    source = open_sim("room", **SMALL)
    eyes = source.cameras()
    late = source.render(7, eyes)
    early = source.render(2, eyes)
    everything = frames("room")
    assert same(late, everything[7]) and same(early, everything[2])


def test_samples_come_in_order_up_to_each_frame() -> None:
    source = open_sim("hall", **SMALL)
    items = list(source)
    assert source.frame_count == sum(isinstance(item, Frame) for item in items)
    last = START_NS - 1
    for batch, frame in zip(items[::2], items[1::2], strict=True):
        assert isinstance(batch, ImuBatch) and isinstance(frame, Frame)
        assert batch.t_ns[0] > last and batch.t_ns[-1] == frame.t_ns and (np.diff(batch.t_ns) == 5_000_000).all()
        last = frame.t_ns
    truth = source.ground_truth
    assert [f.t_ns for f in items if isinstance(f, Frame)] == truth.t_ns.tolist()


def test_images_have_the_statistics_of_photographs() -> None:
    source = open_sim("room", scale=0.5, seconds=12.0, texture_bits=9)
    eyes = source.cameras()
    for k in (40, 120, 200):
        image = source.render(k, eyes).left
        assert 60 < image.mean() < 190 and 12 < image.std() < 75
        assert (image == 255).mean() < 0.1 and (image == 0).mean() < 0.1


def test_mono_depth_and_without_imu() -> None:
    mono = open_sim("room?mono=1&imu=0", **SMALL)
    items = list(mono)
    assert mono.rig.right is None and mono.imu is None and all(isinstance(item, Frame) for item in items)
    depth = open_sim("street", depth=True, **SMALL)
    frame = next(item for item in depth if isinstance(item, Frame))
    assert depth.rig.has_depth and frame.right is None and frame.depth_m is not None
    assert frame.depth_m.dtype == np.float32 and frame.depth_m.min() == 0.0 and 1.0 < np.median(frame.depth_m) < 200.0


def test_options_in_the_scene_text() -> None:
    source = open_sim("hall?seed=3&seconds=0.6&lens=equidistant&scale=0.2&texture_bits=7")
    assert source.frame_count == 12 and source.rig.left.lens.value == "equidistant" and source.rig.left.width == 150


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("moon", "expected one of room"),
        ("room?speed=3", "unknown option 'speed'"),
        ("room?seed=x", "expected a int"),
        ("room?mono=maybe", "expected a bool"),
        ("room?lens=cheap", "unknown lens"),
        ("room?trajectory=/no/such/file", "cannot be read"),
        ("room?agent=2", "no trajectory"),
        ("room?seconds=-1", "cannot be negative"),
        ("room?seconds=0.01", "no frame"),
    ],
)
def test_errors_name_what_was_expected(text: str, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        open_sim(text, texture_bits=6)


def test_the_options_of_a_scene_make_another_rig() -> None:
    source = open_sim("room", texture_bits=5, seconds=1, width=160, height=120, fov_deg=90.0, lens="none", rate=30.0,
                      imu_rate=400.0)  # fmt: skip
    left = source.rig.left
    assert (left.width, left.height) == (160, 120)
    assert left.fx == pytest.approx(80.0) and left.fy == pytest.approx(80.0, rel=0.01), "tan 45 degrees is 1"
    assert (left.cx, left.cy) == (pytest.approx(80.0, abs=3), pytest.approx(60.0, abs=3))
    assert source.frame_count == 30 and source.imu is not None and source.imu.rate_hz == 400.0
    assert np.diff(source.imu_samples().t_ns).tolist() == [2_500_000] * (len(source.imu_samples().t_ns) - 1)


def test_a_fisheye_sees_to_both_sides_and_nothing_behind() -> None:
    options = {"scale": 1.0, "seconds": 0.1, "rest": 0.0, "imu": False, "mono": True}
    (frame,) = frames("room", lens="equidistant", width=96, height=96, fov_deg=190.0, rate=10.0, **options)
    assert frame.left[40:56, 10:86].mean() > 20, "what is before the camera is seen"
    assert frame.left[:6, :6].mean() < 10, "corners of the image, beyond 90 degrees, are dark"


def test_every_agent_of_every_seed_draws_its_own_noise() -> None:
    """Agent 64 of a seed drew what agent 0 of the next one did."""
    seeds = [SimConfig(seed=seed, agent=agent).flight_seed for seed in range(9) for agent in range(MAX_AGENTS)]
    assert len(set(seeds)) == len(seeds)
    assert max(seeds) < 1 << 27  # the key of a frame's noise keeps so many bits
    assert SimConfig(seed=3, agent=5).flight_seed == 197  # flights of up to 64 agents are as they were
