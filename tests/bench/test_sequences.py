"""A user's folder of data sets: sequences are found by their layout, and the papers' cuts are made of them."""

from pathlib import Path

import pytest

from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.papers.sequences import _ORB_SLAM2, DataSequence, SequenceResult, find_sequences, sequence_bars
from kiteline_bench.papers.several_maps.several_maps import SEQUENCE_07, own
from kiteline_hw.ports import SourceError
from kiteline_lab.flights.outcome import FlightOutcome


def folder(tmp_path: Path) -> Path:
    """Data sets as they lie when their archives are unpacked side by side."""
    kitti = tmp_path / "kitti" / "dataset" / "sequences" / "07"
    for place in (
        kitti / "image_0", tmp_path / "euroc" / "MH_01_easy" / "mav0" / "cam0",
        tmp_path / "dataset-room1_512_16" / "mav0" / "mocap0",
        tmp_path / "rgbd_dataset_freiburg2_pioneer_slam2" / "rgb", tmp_path / "notes",
    ):  # fmt: skip
        place.mkdir(parents=True)
    (kitti / "calib.txt").write_text("")
    return tmp_path


def test_sequences_are_found_by_their_layout_at_any_depth(tmp_path: Path) -> None:
    found = find_sequences(folder(tmp_path))
    assert [(s.kind, s.name) for s in found] == [
        ("TUM-VI", "dataset-room1_512_16"), ("EuRoC", "MH_01_easy"), ("KITTI", "07"),
        ("TUM", "rgbd_dataset_freiburg2_pioneer_slam2"),
    ]  # fmt: skip
    assert found[2].source == f"kitti:{tmp_path}/kitti/dataset/sequences/07"
    assert [s.printed_m(_ORB_SLAM2) for s in found] == [None, 0.035, 0.5, None]


def test_the_recordings_of_the_benchmarks_are_such_a_folder(data_dir: Path) -> None:
    kinds = {s.name: s.kind for s in find_sequences(data_dir)}
    assert kinds["kitti_straight"] == "KITTI"
    assert kinds["euroc_mh01_air"] == "EuRoC"
    assert kinds["tum_rgbd_xyz"] == "TUM"


def test_a_folder_without_sequences_says_what_was_expected(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    with pytest.raises(SourceError, match=r"no sequence found.*calib\.txt.*mav0.*rgb\.txt"):
        find_sequences(tmp_path)
    with pytest.raises(SourceError, match="no such folder"):
        find_sequences(tmp_path / "absent")


def test_the_thesis_cuts_its_own_sequences(tmp_path: Path) -> None:
    pioneer, seven = sorted(own(folder(tmp_path)), key=lambda e: len(e.scenarios))
    assert len(pioneer.scenarios) == 1
    assert seven.theirs is SEQUENCE_07 and seven.merges == 2
    assert [(p.from_s, p.to_s) for s in seven.scenarios for p in s.parts] == [
        (-0.05, 39.95), (37.95, 69.95), (67.95, 110.05),
    ]  # fmt: skip


def test_other_sequences_are_not_the_thesis_s(data_dir: Path) -> None:
    with pytest.raises(SourceError, match="none of the thesis's sequences"):
        own(data_dir)


def test_a_short_name_is_no_other_sequence() -> None:
    assert DataSequence("KITTI", "straight", "").printed_m(_ORB_SLAM2) is None


def test_an_error_beside_a_printed_one_counts_with_nearly_all_frames_tracked(tmp_path: Path) -> None:
    def met(name: str, tracked: int) -> bool:
        flown = FlownProcesses(tmp_path, {"agents": [{"tracked": tracked, "frames": 100}]}, FlightOutcome([None]))
        [bar] = sequence_bars(SequenceResult(DataSequence("KITTI", name, ""), flown, None, None))
        return bar.met

    assert [met("07", tracked) for tracked in (100, 95, 94, 0)] == [True, True, False, False]
    assert [met("mine", tracked) for tracked in (94, 0)] == [True, False]
