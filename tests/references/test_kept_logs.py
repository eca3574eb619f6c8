"""Kept logs replay as their expected outputs say; what differs is named: half, stage, frame, and by how much."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from kiteline_lab.references import kept_log
from kiteline_lab.references.__main__ import changes, check, expected_file
from kiteline_lab.references.comparison import TOLERANCE, differences
from kiteline_lab.references.flights import FLIGHTS, IMAGES, KeptFlight
from kiteline_lab.references.observation import Observation, Row, from_text, to_text
from kiteline_lab.references.replays import replay, replay_agent

KEPT = Path(__file__).parent / "kept"
RGBD = next(flight for flight in FLIGHTS if flight.name == "rgbd")


@pytest.mark.parametrize("flight", FLIGHTS, ids=[flight.name for flight in FLIGHTS])
def test_a_kept_log_replays_as_expected(flight: KeptFlight) -> None:
    found = replay(KEPT, flight)
    lines = changes(KEPT, flight, found)
    kept = from_text(expected_file(KEPT, flight).read_text(encoding="utf-8"))
    if kept.machine != found.machine:  # there is nothing to compare every digit with but a second replay
        lines += differences(found, replay(KEPT, flight), None)
    assert not lines, "\n".join([f"{flight.name} is computed differently; if that is wanted: make refs", *lines])


def kept() -> Observation:
    """An expected output."""
    return from_text(expected_file(KEPT, RGBD).read_text(encoding="utf-8"))


def with_row(found: Observation, number: int, change: Callable[[Row], Row]) -> Observation:
    """The same with another row of agent 0."""
    rows = found.halves[0].rows
    rows[number] = change(rows[number])
    return found


def test_expected_outputs_are_read_as_they_were_written() -> None:
    text = expected_file(KEPT, RGBD).read_text(encoding="utf-8")
    assert to_text(from_text(text)) == text
    assert not differences(kept(), kept(), None)


def test_another_image_is_found_at_its_frame() -> None:
    images = kept_log.read_images(KEPT / IMAGES)
    stamps = sorted(images)
    images[stamps[6]] = images[stamps[7]]
    found = kept()
    found.halves[0] = replay_agent(KEPT, RGBD, 0, images)
    lines = differences(replay(KEPT, RGBD), found, None)  # both computed here: processors differ in the last digits
    assert any("frame 6 (0.300 s)" in line for line in lines), lines
    assert differences(kept(), found, TOLERANCE)  # and on any other machine


def test_what_differs_is_named() -> None:
    def moved(row: Row) -> Row:
        x, *rest = row.numbers
        return replace(row, numbers=(x + 0.0015, *rest), digests=(row.digests[0], "0", *row.digests[2:]))

    found = with_row(kept(), 9, moved)
    found.halves[0].facts["keyframes"] = "99"
    lines = differences(kept(), found, None)
    assert lines[0] == "agent 0: pose is the first stage that differs, at frame 9 (0.450 s)"
    assert lines[1] == "  pose: from frame 9 on, by up to 1.5 mm (at 9)"
    assert lines[2].startswith("  keyframes: 99, was ")
    hidden = with_row(kept(), 3, lambda row: replace(row, digests=("0", *row.digests[1:])))
    assert "in digits that are not printed" in "".join(differences(kept(), hidden, None))


def test_a_tolerance_allows_what_other_processors_compute_and_no_more() -> None:
    def by(m: float) -> Observation:
        return with_row(kept(), 9, lambda row: replace(row, numbers=(row.numbers[0] + m, *row.numbers[1:])))

    assert not differences(kept(), by(0.9 * TOLERANCE.position_m), TOLERANCE)
    assert "x_m is" in differences(kept(), by(1.1 * TOLERANCE.position_m), TOLERANCE)[0]
    lost = with_row(kept(), 9, lambda row: replace(row, numbers=(float("nan"), *row.numbers[1:])))
    assert "x_m is - at frame 9" in differences(kept(), lost, TOLERANCE)[0]
    other = kept()
    other.halves[1].facts["keyframes"] = "20"
    assert differences(kept(), other, TOLERANCE)[0].startswith("base: keyframes is 20, kept ")


def test_a_check_says_what_changed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in [*KEPT.glob("rgbd.*"), KEPT / IMAGES]:
        (tmp_path / file.name).symlink_to(file)
    text = expected_file(KEPT, RGBD).read_text(encoding="utf-8")
    wrong = expected_file(tmp_path, RGBD)
    wrong.unlink()
    wrong.write_text(text.replace("submaps: 1", "submaps: 9"), encoding="utf-8")
    assert not check(tmp_path, RGBD)
    assert "submaps" in capsys.readouterr().out
