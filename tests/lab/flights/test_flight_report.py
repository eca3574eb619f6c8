"""Composing the refined trajectory, the report's numbers, and the check of a flight's folder."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from kiteline_bench.harness.contract import check_contract
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, SubmapId
from kiteline_lab.flights import flight_report
from kiteline_lab.flights.flight_report import statistic, table, without_timing, write_tum
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from kiteline_lab.flights.refined_path import refined_path
from kiteline_lab.flights.results import in_unit_of_end, left_out_notes, live_line


@dataclass(frozen=True)
class FlownFrame:
    t_ns: int
    tracked: bool
    T_m_b: F64 | None
    T_o_b: F64
    keyframe: KeyframeId
    T_k_c: F64
    submap: SubmapId


def at(*xi: float) -> F64:
    return se3.exp(np.array(xi, np.float64))


T_b_c = at(0.1, 0.0, 0.05, 0.2, -0.1, 1.5)
T_c_b = se3.inverse(T_b_c)


def flown(t_ns: int, T_m_k: F64, T_k_c: F64, keyframe: int, submap: int = 0, tracked: bool = True) -> FlownFrame:
    """A frame seen near a keyframe that the agent believed at T_m_k."""
    T_m_b = T_m_k @ T_k_c @ T_c_b
    return FlownFrame(t_ns, tracked, T_m_b if tracked else None, T_m_b, KeyframeId(keyframe), T_k_c, SubmapId(submap))


def test_frames_follow_their_refined_keyframe() -> None:
    refined = at(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    near = at(0.05, 0.0, 0.02, 0.0, 0.01, 0.0)
    ((t_ns, T_w_b),) = refined_path([flown(5, at(0, 0, 0, 0, 0, 0), near, 7)], {7: refined}, T_b_c)
    assert t_ns == 5
    np.testing.assert_allclose(T_w_b, refined @ near @ T_c_b, atol=1e-12)


def test_monocular_frames_are_as_long_as_the_world_says_and_the_arm_stays_in_metres() -> None:
    refined, near = at(1.0, 2.0, 3.0, 0.1, 0.2, 0.3), at(0.05, 0.0, 0.02, 0.0, 0.01, 0.0)
    begin, late = at(0, 0, 0, 0, 0, 0), at(0.3, 0, 0, 0, 0, 0.1)
    frames = [flown(5, begin, near, 7), flown(6, late, near, 8), flown(7, late, near, 9)]
    poses = dict(refined_path(frames, {7: sim3.of(2.5, refined), 8: sim3.of(2.5, refined @ late)}, T_b_c))
    np.testing.assert_allclose(poses[5], sim3.place(sim3.of(2.5, refined), near) @ T_c_b, atol=1e-12)
    for T in poses.values():
        assert sim3.scale_of(T) == 1.0
    # The frame whose keyframe the base lacks hangs on the submap, as long as it was at the last one known.
    np.testing.assert_allclose(poses[7], poses[6], atol=1e-9)


def test_frames_bend_towards_the_next_keyframe_and_the_path_has_no_step() -> None:
    step = np.array([0.1, 0.02, 0.0, 0.0, 0.0, 0.03])
    eye, moved = np.eye(4), at(0.03, -0.01, 0.02, 0.01, 0.0, -0.02)  # what the base makes of the second keyframe
    frames = [flown(10 * i, eye, se3.exp(step * i), 7) for i in range(10)]
    frames += [flown(100 + 10 * i, se3.exp(step * 10), se3.exp(step * i), 8) for i in range(3)]
    plain = dict(refined_path(frames, {7: eye, 8: se3.exp(step * 10)}, T_b_c))
    for i in range(13):
        np.testing.assert_allclose(plain[10 * i], se3.exp(step * i) @ T_c_b, atol=1e-9)
    bent = dict(refined_path(frames, {7: eye, 8: se3.exp(step * 10) @ moved}, T_b_c))
    np.testing.assert_allclose(bent[0], T_c_b, atol=1e-12)
    np.testing.assert_allclose(bent[100], se3.exp(step * 10) @ moved @ T_c_b, atol=1e-9)
    ways = [np.linalg.norm((se3.inverse(bent[10 * i]) @ bent[10 * i + 10])[:3, 3]) for i in range(12)]
    assert max(ways) < 1.2 * min(ways)
    # A gap, or a keyframe of old, is no next keyframe: nothing bends.
    lost = [*frames[:10], flown(95, eye, eye, 7, tracked=False), *frames[10:]]
    apart = dict(refined_path(lost, {7: eye, 8: moved}, T_b_c))
    np.testing.assert_allclose(apart[90], plain[90], atol=1e-9)


def test_a_keyframe_that_is_under_way_hangs_on_the_last_one_that_arrived() -> None:
    believed, later = at(0.2, 0, 0, 0, 0, 0), at(0.6, 0.1, 0, 0, 0, 0.1)
    refined = at(0.3, 0.05, 0, 0, 0, 0.02)
    frames = [flown(1, believed, np.eye(4), 7), flown(2, later, np.eye(4), 8)]
    poses = dict(refined_path(frames, {7: refined}, T_b_c))
    moved = refined @ se3.inverse(believed)  # what the base did to the neighbour, it does to this one too
    np.testing.assert_allclose(poses[2], moved @ later @ T_c_b, atol=1e-12)


def test_frames_before_the_first_known_keyframe_hang_on_that_one() -> None:
    first, second, refined = np.eye(4), at(1.0, 0, 0, 0, 0, 0), at(0.0, 5.0, 0, 0, 0, 0)
    poses = refined_path([flown(1, first, np.eye(4), 7), flown(2, second, np.eye(4), 8)], {8: refined}, T_b_c)
    assert [t for t, _ in poses] == [1, 2]
    np.testing.assert_allclose(poses[0][1], refined @ se3.inverse(second) @ first @ T_c_b, atol=1e-12)


def test_lost_frames_and_unknown_submaps_have_no_place() -> None:
    eye = np.eye(4)
    frames = [flown(1, eye, eye, 7, tracked=False), flown(2, eye, eye, 9, submap=3), flown(3, eye, eye, 7)]
    assert [t for t, _ in refined_path(frames, {7: eye}, T_b_c)] == [3]


def test_statistics_and_their_absence() -> None:
    assert statistic([1.0, 2.0, 3.0, 10.0]) == {"mean": 4.0, "p50": 2.5, "p95": 8.95}
    assert statistic([]) == {"mean": 0.0, "p50": 0.0, "p95": 0.0}


def test_timing_is_what_runs_may_differ_in() -> None:
    report = {"agents": [{"frames": 3, "timing": {"x": 1}}], "base": {"timing": {}, "loops": 0}}
    assert without_timing(report) == {"agents": [{"frames": 3}], "base": {"loops": 0}}


def test_a_report_of_what_is_no_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        flight_report.write_report(tmp_path / "report.json", {"ate": float("nan")})


def test_stamps_keep_all_nanoseconds(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", [(1_403_715_273_262_142_976, np.eye(4))])
    text = (tmp_path / "a.tum").read_text()
    assert text.startswith("1403715273.262142976 0.000000000 ")
    assert text.endswith(" 1.000000000\n")


@pytest.fixture(scope="module")
def folder(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("contract")
    fly(Options((str(recording),), out, "local", seconds=0.6), quiet=True)
    assert check_contract(out) == []
    return out


def changed_report(out: Path, change: dict[str, object]) -> None:
    report = json.loads((out / "report.json").read_text())
    report["agents"][0].update(change)
    (out / "report.json").write_text(json.dumps(report))


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("base/map.ply", b"plx", "map.ply"),
        ("base/grid.yaml", b"image: grid.pgm\n", "resolution"),
        ("trajectory.png", b"GIF", "trajectory.png"),
        ("agent0/log.mcap", b"", "log.mcap"),
        ("agent0/live.tum", b"1.000000 0 0 0 0 0 0 1\n", "live.tum has 1 rows"),
        ("agent0/odometry.tum", b"1.5 0 0 0 0 0 0 1\n", "microseconds"),
        ("base/agent0.tum", b"1.000000 0 0 0 0 0 0 1\n0.500000 0 0 0 0 0 0 1\n", "not later"),
        ("base/agent0.tum", b"1.000000 0 0 0 0 0 0 2\n", "unit"),
        ("report.json", b"{", "report.json"),
    ],
)
def test_each_breach_of_the_contract_is_named(
    folder: Path, tmp_path: Path, name: str, content: bytes, complaint: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    (out / name).write_bytes(content)
    assert any(complaint in breach for breach in check_contract(out))
    if name != "report.json":
        (out / name).unlink()
        assert any(Path(name).name in breach for breach in check_contract(out))


def test_counts_that_do_not_add_up_are_a_breach(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    changed_report(out, {"lost": 5})
    assert check_contract(out) == ["agents[0]: tracked + lost + dropped must be frames"]


def test_the_table_shows_what_counts(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    lines = table(report).splitlines()
    assert lines[0].split()[:4] == ["agent", "frames", "tracked", "lost"]
    assert lines[1].split()[:4] == ["0", "13", "13", "0"]
    assert "digests equal" in lines[2]


def test_the_table_tells_why_digests_differ_at_the_end(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    assert "link" not in table(report)
    report["base"]["digest_equal"], report["drain"]["base"]["flight_ms"] = False, 30050
    assert "note: 30 s after the last frame the link had not carried the whole map yet; " in table(report)
    report["base"]["agents_lost"] = [0]
    assert "note: 30 s" not in table(report)


def test_the_table_tells_what_was_skipped_and_what_to_check() -> None:
    timing = {"cpu_ms_per_frame": statistic([]), "rss_mib": 1.0}
    agent = {
        "frames": 3, "tracked": 0, "lost": 3, "dropped": 0, "keyframes": 0, "bytes_per_keyframe": 0.0, "timing": timing,
        "skipped": {"imu stamp not increasing": 12, "file cut": 1, "damaged chunk": 1},
        "notes": ["imu stamp not increasing: at 5 ns", "imu: no gravity", "file cut: its part 2 is missing"],
    }  # fmt: skip
    lines = table({"agents": [agent], "base": None, "notes": ["ended"]}).splitlines()
    assert lines[-5:] == [
        "note: ended", "note: 12 skipped: imu stamp not increasing",
        "note: 1 skipped: file cut: its part 2 is missing",  # which part is told
        "note: 1 skipped: damaged chunk", "note: imu: no gravity",
    ]  # fmt: skip
    assert table({"agents": [agent, agent], "base": None}).splitlines()[-1] == "note: agent 1: imu: no gravity"


def test_poses_in_another_unit_than_at_the_end_are_not_judged() -> None:
    flown = [
        FlownFrame(n, n > 1, np.eye(4), np.eye(4), KeyframeId(0), np.eye(4), SubmapId(n // 3)) for n in range(8)
    ]  # fmt: skip
    metric, own = ({"scale": scale, "own_unit_submaps": [0, 2]} for scale in ("metric", "own"))
    assert [e.t_ns for e in in_unit_of_end(flown, metric)] == [3, 4, 5]
    assert [e.t_ns for e in in_unit_of_end(flown, own)] == [0, 1, 2, 6, 7]
    assert in_unit_of_end(flown, {"scale": "metric", "own_unit_submaps": []}) is flown
    assert in_unit_of_end(flown, {}) is flown
    (note,) = left_out_notes(3, flown, in_unit_of_end(flown, metric))
    assert note.startswith("agent 3: 3 poses in another unit of length")
    assert left_out_notes(0, flown, flown[2:]) == [], "frames before the first map, which have no pose"


@dataclass(frozen=True)
class LivePose:
    t_ns: int
    T_m_b: F64
    T_w_b: F64 | None
    tracked: bool = True


def test_live_poses_in_a_frame_of_their_own_are_not_drawn_among_those_in_the_world() -> None:
    """A second agent's path led from where it began, in its own map, straight to where it was recognised."""
    own, world = at(0, 0, 0, 0, 0, 0), at(5, 0, 0, 0, 0, 0)
    late = [LivePose(t, own, world if t >= 60 else None) for t in range(100)]
    line = live_line("agent 1 live", late, own_unit=False)  # type: ignore[arg-type]
    assert line.name == "agent 1 live, the 40% in w" and line.trajectory.t_ns.tolist() == list(range(60, 100))
    lone = [LivePose(t, own, None) for t in range(9)]
    never = live_line("live", lone, own_unit=False)  # type: ignore[arg-type]
    assert never.name == "live" and len(never.trajectory.t_ns) == 9
    soon = live_line("live", late[59:], own_unit=True)  # type: ignore[arg-type]
    assert soon.name == "live" and len(soon.trajectory.t_ns) == 41 and soon.own_unit


def test_the_table_tells_what_one_camera_alone_does_not_know() -> None:
    agent = {
        "frames": 9, "tracked": 7, "lost": 2, "initialising": 2, "dropped": 0, "keyframes": 1, "scale": "own",
        "bytes_per_keyframe": 0.0, "timing": {"cpu_ms_per_frame": statistic([]), "rss_mib": 1.0},
    }  # fmt: skip
    assert table({"agents": [agent], "base": None}).splitlines()[-2:] == [
        "note: 2 of the lost frames came before there was a map",
        "note: lengths are in a unit of their own, as nothing told the metre; ATE with the scale fitted",
    ]
    assert "note" not in table({"agents": [{**agent, "scale": "metric", "initialising": 0}], "base": None})
