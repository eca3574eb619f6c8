"""`kiteline sim`: what it records opens again as the same flight, and its truth lies beside it."""

import json
from pathlib import Path

import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.simulate import main
from kiteline_lab.grids.files import read_grid

SCENE = "room?scale=0.2&texture_bits=7&seconds=0.4"


def test_the_recording_is_the_flight(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    assert main([SCENE, "--seed", "3", "--png", "--out", str(out)]) == 0
    recorded, rendered = open_source(f"mcap:{out}"), open_sim(SCENE, seed=3)
    assert recorded.rig.left == rendered.rig.left and recorded.rig.right == rendered.rig.right
    assert np.allclose(recorded.rig.T_b_c, rendered.rig.T_b_c, atol=1e-12)
    pairs = list(zip(recorded, rendered, strict=True))
    assert sum(isinstance(a, Frame) for a, _ in pairs) == 8
    for a, b in pairs:
        if isinstance(a, ImuBatch) and isinstance(b, ImuBatch):
            assert np.array_equal(a.t_ns, b.t_ns) and np.array_equal(a.gyro, b.gyro)
            assert np.array_equal(a.accel, b.accel)
        else:
            assert isinstance(a, Frame) and isinstance(b, Frame) and a.t_ns == b.t_ns
            assert np.array_equal(a.left, b.left)
            assert a.right is not None and b.right is not None and np.array_equal(a.right, b.right)
    true, stated = recorded.ground_truth, rendered.ground_truth
    assert np.allclose(true.T_w_b, stated.T_w_b, atol=1e-9)
    assert "image: flight.pgm" in (tmp_path / "flight.yaml").read_text() and (tmp_path / "flight.pgm").is_file()


def test_what_could_be_seen_lies_beside_what_is_true(tmp_path: Path) -> None:
    assert main([SCENE, "--out", str(tmp_path / "f.mcap")]) == 0
    everything, seen, low = (read_grid(tmp_path / f"f{part}.yaml") for part in ("", "_seen", "_seen_0.1-0.5"))
    known = seen.state >= 0
    assert np.array_equal(seen.state[known], everything.state[known])
    assert 0 < (seen.state == 0).sum() < (everything.state == 0).sum()
    assert (low.state != seen.state).any() and (tmp_path / "f_seen_1.2-2.pgm").is_file()


def test_the_same_command_gives_the_same_file(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert main([SCENE, "--out", str(tmp_path / name / "f.mcap"), "--workers", str(1 + (name == "b"))]) == 0
    for file in ("f.mcap", "f.pgm", "f.yaml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_a_worn_rig_is_recorded_with_its_truth_beside_it(tmp_path: Path) -> None:
    out = tmp_path / "worn.mcap"
    options = ["--rig", "worn", "--rig-seed", "6", "--png"]
    assert main([SCENE.replace("0.4", "2.0"), *options, "--out", str(out)]) == 0
    recorded, rendered = open_source(f"mcap:{out}"), open_sim(SCENE.replace("0.4", "2.0"), rig="worn", rig_seed=6)
    frames, others = ([x for x in source if isinstance(x, Frame)] for source in (recorded, rendered))
    assert [(f.t_ns, f.right is None) for f in frames] == [(f.t_ns, f.right is None) for f in others]
    assert any(f.right is None for f in frames)
    truth = json.loads((tmp_path / "worn.rig_truth.json").read_text())
    assert truth["true"]["left"]["fx"] == rendered.worn.true.left.fx != recorded.rig.left.fx
    assert truth["frame_stamps_late_s"] == rendered.worn.late_s


def test_every_agent_gets_its_log(tmp_path: Path) -> None:
    out = tmp_path / "two.mcap"
    assert main([SCENE, "--out", str(out), "--also", "course"]) == 0
    first, second = open_source(f"mcap:{out}"), open_source(f"mcap:{tmp_path / 'two-1.mcap'}")
    assert not np.allclose(first.ground_truth.T_w_b[0], second.ground_truth.T_w_b[0])


def test_depth_is_recorded_in_place_of_the_right_image(tmp_path: Path) -> None:
    out = tmp_path / "d.mcap"
    assert main([SCENE, "--depth", "--no-imu", "--out", str(out)]) == 0
    source = open_source(f"mcap:{out}")
    frame = next(iter(source))
    assert source.imu is None and isinstance(frame, Frame) and frame.right is None and frame.depth_m is not None
    true = next(iter(open_sim(SCENE, depth=True, imu=False)))
    assert isinstance(true, Frame) and true.depth_m is not None
    assert np.abs(frame.depth_m - true.depth_m).max() <= 0.00051


def test_errors_leave_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="expected one of room"):
        main(["moon", "--out", str(tmp_path / "f.mcap")])
    with pytest.raises(SourceError, match="folder that exists"):
        main([SCENE, "--out", str(tmp_path / "no" / "f.mcap")])
    assert list(tmp_path.iterdir()) == []


def test_an_existing_recording_is_overwritten_only_with_force(tmp_path: Path) -> None:
    command = [SCENE, "--also", "course", "--out", str(tmp_path / "f.mcap")]
    (tmp_path / "f-1.mcap").write_text("of yesterday")
    with pytest.raises(SourceError, match=r"f-1\.mcap exists already: .*--force"):
        main(command)
    assert not (tmp_path / "f.mcap").exists()  # said before anything is rendered
    assert main([*command, "--force"]) == 0
    assert (tmp_path / "f-1.mcap").stat().st_size > 1000


def test_a_file_of_another_kind_beside_the_recording_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text("fx: 400")
    with pytest.raises(SourceError, match=r"f\.yaml exists already"):
        main([SCENE, "--out", str(tmp_path / "f.mcap")])
