"""Exports of a map that was made by the real mapper."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gtsam
import numpy as np
import pytest

from kiteline_basestation.intake.placements import PlacementState
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.mapper_state import MapperState
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import texts_of
from kiteline_basestation.store.store import FILE, Store, batch_of
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, NewLandmarks, Record, SubmapPlacement, messages
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from kiteline_hw.ports import SourceError
from kiteline_lab.evaluation import trajectories
from kiteline_lab.grids.files import read_grid
from kiteline_lab.tools.export import FORMATS, ExportError, files, main
from tests.basestation.conftest import fly, room

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a camera that looks along x


def records(agent: int, boot: int = 1, begin_s: float = 0.0) -> tuple[Record, ...]:
    """Three keyframes, half a metre apart, each with its own forty points."""
    begin_ns = 1_700_000_000_123_456_789 + round(1e9 * begin_s)
    rng = np.random.default_rng(agent)
    camera = RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, True, np.eye(4))
    out: list[Record] = [CameraIntrinsics(AgentId(agent), camera)]
    submap = submap_id(agent, boot, 0)
    parent = NO_KEYFRAME
    for i in range(3):
        keyframe = keyframe_id(submap, i)
        step = se3.from_rt(LEVEL, np.zeros(3)) if i == 0 else se3.from_rt(np.eye(3), np.array([0.0, 0.0, 0.5]))
        out.append(KeyframeHeader(keyframe, begin_ns + i * 10**9, parent, step, 40))
        index = np.arange(40, dtype=np.uint16)
        uv = rng.uniform([10, 10], [630, 470], (40, 2)).astype(np.float32)
        depth = rng.uniform(2, 6, 40).astype(np.float32)
        zeros = np.zeros(40, np.uint8)
        descriptor = rng.integers(0, 256, (40, 32), dtype=np.uint8)
        out.append(NewLandmarks(keyframe, 0, index, uv, 1 / depth, zeros, zeros, descriptor))
        parent = keyframe
    return tuple(out)


@pytest.fixture
def mapper() -> Mapper:
    made = Mapper()
    made.step(MapperInput(((AgentId(0), records(0)),)), 0)
    return made


def test_tum_is_the_trajectory_of_keyframes(mapper: Mapper, tmp_path: Path) -> None:
    ((name, content),) = files(mapper, "tum", "a.tum").items()
    (tmp_path / name).write_bytes(content)
    found = trajectories.read(str(tmp_path / name)).trajectory
    assert found.t_ns.tolist() == [1_700_000_000_123_456_789 + i * 10**9 for i in range(3)]
    np.testing.assert_allclose(found.T_w_b[:, :3, 3], [[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]], atol=1e-8)


def test_one_trajectory_is_of_one_agent(mapper: Mapper) -> None:
    with pytest.raises(ExportError, match=r"agents \[0\], none with number 4"):
        files(mapper, "tum", "a.tum", agent=4)
    mapper.step(MapperInput(((AgentId(2), records(2)),)), 10**9)
    mapper.placements[submap_id(2, 1, 0)] = np.eye(4)
    with pytest.raises(ExportError, match=r"agents \[0, 2\].*--agent"):
        files(mapper, "tum", "a.tum")
    assert files(mapper, "tum", "a.tum", agent=2)["a.tum"].count(b"\n") == 3


def test_flights_of_the_same_times_are_not_mixed(mapper: Mapper) -> None:
    for boot, begin_s in ((2, 3.0), (3, 1.5)):  # after the first flight, and during both
        mapper.step(MapperInput(((AgentId(0), records(0, boot, begin_s)),)), 10**9)
        mapper.placements[submap_id(0, boot, 0)] = np.eye(4)
        if boot == 2:
            assert files(mapper, "tum", "a.tum")["a.tum"].count(b"\n") == 6
    with pytest.raises(ExportError, match=r"boots \[1, 2, 3\] .* at the same times.*--boot"):
        files(mapper, "tum", "a.tum")
    assert files(mapper, "tum", "a.tum", boot=3)["a.tum"].startswith(b"1700000001.623456789 ")
    with pytest.raises(ExportError, match=r"boots \[1, 2, 3\] .* none with number 4"):
        files(mapper, "tum", "a.tum", boot=4)


def test_graph_holds_every_keyframe_and_parent(mapper: Mapper, tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_bytes(files(mapper, "g2o", "a.g2o")["a.g2o"])
    graph, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    assert (graph.size(), values.size()) == (2, 3)
    assert graph.error(values) < 1e-12


def test_ply_and_grid_are_readable(mapper: Mapper, tmp_path: Path) -> None:
    made = files(mapper, "pgm", "plan.pgm") | files(mapper, "ply", "a.ply")
    assert sorted(made) == ["a.ply", "plan.pgm", "plan.yaml"]
    assert b"image: plan.pgm\n" in made["plan.yaml"]  # no quotes, which simple readers keep
    for name, content in made.items():
        (tmp_path / name).write_bytes(content)
    assert read_grid(tmp_path / "plan.yaml").cell_m == mapper.config.grid.cell_m
    assert b"element vertex 0\n" in made["a.ply"]  # each landmark has one observation


def keep(folder: Path, *agents: int) -> None:
    """Write a store with the keyframes of agents; the map of the first one is placed."""
    saved = {}
    for agent in agents:
        codes = {messages.key(r): messages.encode(r) for r in records(agent)}
        placed = [SubmapPlacement(submap_id(agent, 1, 0), np.eye(4))] if agent == agents[0] else []
        saved[AgentId(agent)] = SavedValues(codes, {messages.key(p): messages.encode(p) for p in placed})
    state = MapperState(placements=PlacementState({submap_id(agent, 1, 0): np.eye(4) for agent in agents[:1]}))
    store = Store(folder)
    store.write(batch_of(SavedMap(saved, texts_of(state)), SavedMap()))
    store.close()


def test_what_no_file_can_hold_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Maps without a place were left out, and an empty map was written, without a word."""
    keep(tmp_path / "two", 0, 3)
    assert main([str(tmp_path / "two"), "--format", "tum", "--out", str(tmp_path / "a.tum")]) == 0
    assert "left out: map 3.1.0 (3 keyframes) has no place in w" in capsys.readouterr().err
    with pytest.raises(ExportError, match="no map of agent 3 has a place in w"):
        main([str(tmp_path / "two"), "--format", "tum", "--agent", "3", "--out", str(tmp_path / "b.tum")])
    keep(tmp_path / "none")
    for kind in FORMATS:
        with pytest.raises(ExportError, match="the map is empty"):
            main([str(tmp_path / "none"), "--format", kind, "--out", str(tmp_path / "none.pgm")])
    assert not (tmp_path / "none.pgm").exists()


def test_command_reads_a_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep(tmp_path, 0)
    assert main([str(tmp_path), "--format", "tum", "--out", str(tmp_path / "new" / "a.tum")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "new" / "a.tum")
    found = trajectories.read(str(tmp_path / "new" / "a.tum")).trajectory.T_w_b[:, :3, 3]
    np.testing.assert_allclose(found, [[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]], atol=2e-3)  # as coarse as codes are
    assert main([str(tmp_path / FILE), "--format", "pgm", "--out", str(tmp_path / "plan.pgm")]) == 0
    assert read_grid(tmp_path / "plan.yaml").cell_m > 0


@pytest.mark.parametrize(
    "name", ["my plan.pgm", "a: b #c.pgm", "two\nlines.pgm", "-.pgm", "Höhe.pgm", "\udcff.pgm", "no suffix"]
)
def test_a_picture_of_any_name_is_found_again(name: str, mapper: Mapper, tmp_path: Path) -> None:
    for file, content in files(mapper, "pgm", name).items():
        (tmp_path / file).write_bytes(content)
    assert read_grid((tmp_path / name).with_suffix(".yaml")).cell_m > 0
    with pytest.raises(ExportError, match=r"ends in \.pgm"):
        files(mapper, "pgm", "plan.yaml")


def test_what_no_disk_takes_leaves_the_file_as_it_was(
    mapper: Mapper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep(tmp_path, 0)
    out = tmp_path / "out" / "map.ply"
    assert main([str(tmp_path), "--format", "ply", "--out", str(out)]) == 0
    before = out.read_bytes()
    with pytest.raises(SourceError, match=r"map\.ply exists already.*--force"):
        main([str(tmp_path), "--format", "ply", "--out", str(out)])
    out.write_bytes(b"older")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            main([str(tmp_path), "--format", "ply", "--out", str(out), "--force"])
    assert [(path.name, path.read_bytes()) for path in out.parent.iterdir()] == [("map.ply", b"older")]
    os.mkfifo(pipe := tmp_path / "pipe")
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_bytes)
        assert main([str(tmp_path), "--format", "ply", "--out", str(pipe)]) == 0
        assert read.result(10) == before


def test_files_that_are_no_store_are_named(tmp_path: Path) -> None:
    (tmp_path / "wrong").write_bytes(b"hello")
    for store in ("wrong", "missing"):
        with pytest.raises(StoreError, match=store):
            main([str(tmp_path / store), "--format", "ply", "--out", str(tmp_path / "a.ply")])
    assert not (tmp_path / "a.ply").exists()


def test_the_grid_of_landmarks_is_exported_from_a_store(tmp_path: Path) -> None:
    """A restored base makes it again over its next steps, of which an export has none: the picture was empty."""
    scene, rng = room(np.random.default_rng(1), 1800), np.random.default_rng(1)
    scene.world[:700, 2] = -1.5  # a floor
    scene.world[:700, :2] = rng.uniform(-1, 1, (700, 2)) * [3.9, 3.4]
    flight = fly(keyframes=12, turns=0.6, points=1500, scene=scene)
    made = Mapper()
    made.step(MapperInput(((flight.agent, (CameraIntrinsics(flight.agent, flight.camera),)),)), 0)
    for n, group in enumerate([*flight.records, *[[]] * 12]):
        made.step(MapperInput(((flight.agent, tuple(group)),)), (n + 1) * 500_000_000)
    assert len(made.grid) > 6
    said = [CameraIntrinsics(flight.agent, flight.camera), *flight.all_records()]
    codes = {messages.key(record): messages.encode(record) for record in said}
    store = Store(tmp_path / "store")
    store.write(batch_of(SavedMap({flight.agent: SavedValues(codes, {})}, texts_of(made.state())), SavedMap()))
    store.close()
    assert main([str(tmp_path / "store"), "--format", "pgm", "--out", str(tmp_path / "grid.pgm")]) == 0
    grid = read_grid(tmp_path / "grid.yaml")
    assert np.count_nonzero(grid.state == 0) > 200
