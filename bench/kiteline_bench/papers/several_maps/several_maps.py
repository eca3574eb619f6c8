"""`kiteline bench papers/multi-map`: flights broken in several maps, and several robots on one path, beside the thesis.

"Multi-map distributed ORB-SLAM2", chapter 4. The thesis draws its results and prints no error. As its figure stands
what ORB-SLAM2 reached on the same sequence (R. Mur-Artal and J. D. Tardos, "ORB-SLAM2", T-RO 2017, table II), in
proportion to the path: the thesis calls its own results similar to that (03, 09) or worse (05, 07).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from kiteline_agent.config import AgentConfig, KeyframeConfig
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, table
from kiteline_bench.harness.placed import KeyframesInWorld
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import Part, Scenario, fly_with_base
from kiteline_bench.papers.sequences import find_sequences
from kiteline_bench.papers.several_maps.plot import Drawn, plot_experiments
from kiteline_bench.papers.several_maps.street import street_recording
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError
from kiteline_lab.evaluation import metrics

TITLE = "Several maps of one path, and the thesis"

_OVERLAP = 20  # frames that two robots share, as in the thesis
_THIRD = 1.0 / 3.0
_BLIND_S = 2.0  # more than the 20 lost frames after which the thesis begins a new map
_AIR_OVERLAP = 100  # frames of euroc_mh01_air, 5 s: as long as one robot flies before its map begins
_AIR_S = 2.0  # from the first true pose of euroc_mh01_air to its first frame
_AGENT = AgentConfig(keyframe=KeyframeConfig(earlier=True))  # as of all flights of several agents
_WRONG_M, _WRONG_SHARE = 0.25, 0.01  # of a map's place in the world beside the truth; the share is of the whole path


@dataclass(frozen=True, slots=True)
class Theirs:
    """An experiment of the thesis. ate_m, path_m: of ORB-SLAM2 on that sequence; ate_m None: nobody printed one."""

    name: str
    robots: str
    ate_m: float | None
    path_m: float

    @property
    def share(self) -> float:
        """The error in proportion to the path; of sequence 03 where none is printed."""
        return SEQUENCE_03.share if self.ate_m is None else self.ate_m / self.path_m


SEQUENCE_03 = Theirs("KITTI 03", "two: 0 to 400, 380 to 801", 0.6, 560.0)
SEQUENCE_07 = Theirs("KITTI 07", "three: 0 to 400, 380 to 700, 680 to 1101", 0.5, 694.0)
SEQUENCE_09 = Theirs("KITTI 09", "three: 0 to 500, 480 to 1000, 980 to 1591", 3.2, 1705.0)
SEQUENCE_05 = Theirs("KITTI 05", "three: 0 to 400, 380 to 800, 1000 to 1400", 0.8, 2205.0)
PIONEER = Theirs("TUM fr2/pioneer_slam2", "one, lost in a curve", None, 21.7)
_CUTS = (
    ("03", SEQUENCE_03, ((0, 400), (380, 801))),
    ("05", SEQUENCE_05, ((0, 400), (380, 800), (1000, 1400))),
    ("07", SEQUENCE_07, ((0, 400), (380, 700), (680, 1101))),
    ("09", SEQUENCE_09, ((0, 500), (480, 1000), (980, 1591))),
)  # name, experiment and frames of each robot


@dataclass(frozen=True, slots=True)
class Experiment:
    """One of ours beside one of theirs. merges: of maps, that must happen; None: as many as submaps less one.

    theirs: None of one that the thesis does not have; its error is listed without a bar. maps: fewest that it must
    consist of: a flight that was never broken proves nothing.
    """

    name: str
    theirs: Theirs | None
    scenarios: Sequence[Scenario]
    merges: int | None = None
    maps: int = 1


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an experiment. found, true: keyframe positions (n,3) of each robot in the truth's world, in m.

    placed: how many of the maps lie in one world. ate_m: of these. apart_m: how far the worst of them lies from where
    it should. last_frame_m: the joint error when the last frame came, before the base had done what that began.
    """

    experiment: Experiment
    maps: int
    placed: int
    merges: int
    path_m: float
    ate_m: float
    apart_m: float
    found: list[F64] = field(default_factory=list)
    true: list[F64] = field(default_factory=list)
    last_frame_m: float = float("inf")

    @property
    def limit_m(self) -> float:
        """A third of the thesis's figure, scaled to the path; infinite without one."""
        theirs = self.experiment.theirs
        return float("inf") if theirs is None else _THIRD * theirs.share * self.path_m

    @property
    def joint_m(self) -> float:
        """The error of all maps together; infinite where one of them lies in no common world."""
        return self.ate_m if self.placed == self.maps else float("inf")

    @property
    def wrong(self) -> bool:
        """Whether a map lies at a wrong place."""
        return self.apart_m > _WRONG_M + _WRONG_SHARE * self.path_m


def fly(experiment: Experiment) -> Outcome:
    """Fly an experiment with a base, in lock-step in this process, until the base has nothing left to do.

    So are the thesis's: its maps are merged and adjusted after the robots have finished.
    """
    at_end = list[Outcome]()
    flown = fly_with_base(
        experiment.scenarios, _AGENT,
        at_end=lambda run: at_end.append(judge(experiment, KeyframesInWorld(run))),
    )  # fmt: skip
    return replace(judge(experiment, KeyframesInWorld(flown)), last_frame_m=at_end[0].joint_m)


def judge(experiment: Experiment, flown: KeyframesInWorld) -> Outcome:
    """Compare all maps of a flight with the truth, under one alignment."""
    station = flown.flight.station
    maps = [m for m, keyframes in station.mapper.map.submaps.items() if len(keyframes)]
    placed = sum(m in station.mapper.placements for m in maps)
    pairs = [flown.positions(i) for i in range(len(experiment.scenarios))]
    path_m = sum(map(_path_m, flown.flight.agents))
    if any(len(ours) < 3 for ours, _ in pairs):
        return Outcome(experiment, len(maps), placed, flown.merges, path_m, float("inf"), float("inf"))
    T_true_w, _ = metrics.umeyama(*(np.concatenate(side) for side in zip(*pairs)))
    found = [se3.transform(T_true_w, ours) for ours, _ in pairs]
    true = [theirs for _, theirs in pairs]
    error = np.concatenate(found) - np.concatenate(true)
    ate_m = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    each = [pair for i in range(len(pairs)) for pair in flown.positions_by_submap(i).values()]
    apart_m = max(float(np.linalg.norm(np.mean(se3.transform(T_true_w, a) - b, axis=0))) for a, b in each)
    return Outcome(experiment, len(maps), placed, flown.merges, path_m, ate_m, apart_m, found, true)


def _path_m(run: AgentRun) -> float:
    """Length of a robot's true path, without what it flew unseeing."""
    seen = [
        T[:3, 3] if T is not None and e is not None and e.tracked else np.full(3, np.nan)
        for T, e in zip(run.truth, run.estimates, strict=True)
    ]
    return float(np.nansum(np.linalg.norm(np.diff(np.reshape(seen, (-1, 3)), axis=0), axis=1)))


def robots(
    source: str, hz: float, pieces: Sequence[tuple[int, int]], *, imu: bool = False, first_s: float = 0.0
) -> list[Scenario]:
    """Robots that fly pieces of a recording, from a frame up to another one, all at once.

    first_s: from the first true pose to the first frame.
    """
    shift = first_s - 0.5 / hz
    return [
        Scenario(source, i, parts=(Part(a / hz + shift, b / hz + shift),), imu=imu) for i, (a, b) in enumerate(pieces)
    ]  # fmt: skip


def broken(source: str, seen: Sequence[tuple[float, float]]) -> list[Scenario]:
    """One robot that sees these parts of a recording, in s, and between two of them nothing for _BLIND_S."""
    parts: list[Part] = []
    for a, b in seen:
        if parts:
            parts.append(Part(a, a + _BLIND_S, dark=True))
        parts.append(Part(a, b))
    return [Scenario(source, parts=tuple(parts), imu=False)]


def overlapping(frames: int, count: int, overlap: int = _OVERLAP) -> list[tuple[int, int]]:
    """As many pieces of a recording, each two of which share so many frames."""
    cuts = [round(i * frames / count) for i in range(count + 1)]
    return [(max(a - overlap // 2, 0), min(b + overlap // 2, frames)) for a, b in pairwise(cuts)]


def indoors(bench: Bench) -> list[Experiment]:
    """Somebody else's room along a real trajectory, 440 stereo pairs.

    Its path comes back once: from 13.5 to 15 s it sees what it saw from 10.3 to 12 s, from within 0.6 m and 20 degrees.
    A robot that is carried to where it sees what it knows goes on in its map. So that a loss breaks a flight, it wakes
    where it has never looked, and comes to 20 frames of the map before.
    """
    room = f"mcap:{bench.source('room_flight.mcap')}"
    return [
        Experiment("room, one robot, a loss", PIONEER, broken(room, [(9.0, 17.0), (3.5, 10.0)]), maps=2),
        Experiment("room, one robot, two losses", PIONEER,
                   broken(room, [(9.0, 16.0), (4.0, 10.0), (0.0, 5.0)]), maps=3),
        Experiment("room, two robots", SEQUENCE_03, robots(room, 20.0, overlapping(440, 2)), 1),
        Experiment("room, three robots", SEQUENCE_07, robots(room, 20.0, overlapping(440, 3)), 2),
        Experiment("room, two robots, no shared frame", SEQUENCE_05, robots(room, 20.0, [(0, 240), (270, 440)]), 1),
    ]  # fmt: skip


def real(bench: Bench) -> list[Experiment]:
    """Recordings of real cameras: a street in stereo, and a flight with one camera and IMU."""
    street, flight = bench.source("kitti_straight"), bench.source("euroc_mh01_air")
    return [
        Experiment("kitti_straight, two robots", SEQUENCE_03, robots(f"kitti:{street}", 10.0, overlapping(51, 2)), 1),
        *(Experiment(f"euroc_mh01_air, two robots, one camera and IMU{more}", None,
                     robots(f"euroc:{flight}", 20.0, overlapping(700, 2, frames), imu=True, first_s=_AIR_S), 1)
          for more, frames in (("", _OVERLAP), (", 5 s in common", _AIR_OVERLAP))),
    ]  # fmt: skip


def outdoors(bench: Bench) -> list[Experiment]:
    """KITTI 06's path in a simulated street, as the thesis cuts its sequences."""
    source = f"mcap:{street_recording(bench)}"
    whole = [(0, 400), (380, 800), (780, 1101)]
    return [
        Experiment("street, one robot", None, robots(source, 10.0, [(0, 1101)]), 0),
        Experiment("street, two robots", SEQUENCE_03, robots(source, 10.0, [(0, 400), (380, 801)]), 1),
        Experiment("street, three robots, the last ends where the first began", SEQUENCE_07,
                   robots(source, 10.0, whole), 2),
        Experiment("street, the same, only the last two maps received", SEQUENCE_07,
                   robots(source, 10.0, whole[1:]), 1),
        Experiment("street, three robots, no loop", SEQUENCE_09,
                   robots(source, 10.0, [(0, 290), (270, 560), (540, 830)]), 2),
        Experiment("street, three robots, one shares a place alone", SEQUENCE_05,
                   robots(source, 10.0, [(0, 400), (380, 800), (840, 1101)]), 2),
        Experiment("street, two robots that share no place", None, robots(source, 10.0, [(0, 250), (420, 670)]), 0),
    ]  # fmt: skip


def own(folder: Path) -> list[Experiment]:
    """The thesis's experiments on its own sequences, as far as they are in a folder. Raises SourceError."""
    experiments = []
    for sequence in find_sequences(folder):
        if sequence.kind == "TUM" and sequence.name.endswith("freiburg2_pioneer_slam2"):
            experiments.append(Experiment(sequence.title, PIONEER, [Scenario(sequence.source)]))
        for name, theirs, pieces in _CUTS:
            if sequence.kind == "KITTI" and sequence.name == name:
                scenarios = robots(sequence.source, 10.0, pieces)
                experiments.append(Experiment(sequence.title, theirs, scenarios, len(pieces) - 1))
    if not experiments:
        raise SourceError(
            f"{folder}: none of the thesis's sequences is there; expected KITTI 03, 05, 07, 09 in folders of these "
            "names, or rgbd_dataset_freiburg2_pioneer_slam2"
        )
    return experiments


def _drawn(o: Outcome) -> Drawn:
    return Drawn(f"{o.experiment.name}\n{o.merges} merges, joint ATE {o.ate_m:.3f} m", o.found, o.true)


def run(bench: Bench) -> list[Bar]:
    """All experiments, their bars, table and plot."""
    outcomes, unflown = list[Outcome](), list[Bar]()
    wanted = own(bench.sequences) if bench.sequences else [*indoors(bench), *real(bench), *outdoors(bench)]
    chosen = bench.chosen(wanted)
    for k, experiment in enumerate(chosen):
        bench.say(f"flying {experiment.name} ({k + 1} of {len(chosen)})")
        try:
            outcomes.append(fly(experiment))
        except SourceError as error:
            unflown.append(is_true(f"{experiment.name}: flown", "yes", False, str(error)))
            continue
        o = outcomes[-1]
        bench.say(
            f"  {o.placed} of {o.maps} maps placed, {o.merges} merges, {o.path_m:.0f} m, joint ATE {_metres(o.joint_m)}"
        )
    name = Path("images/papers-multi-map.png")
    folder = Path("docs") if Path("docs").is_dir() else bench.folder
    (folder / name.parent).mkdir(exist_ok=True)
    plot_experiments(folder / name, [_drawn(o) for o in outcomes])
    _tell(bench, outcomes)
    bench.more.append(f"![Keyframes of all robots in the base's world, and the true paths]({name})")
    return [*unflown, *(bar for o in outcomes for bar in bars(o))]


def bars(o: Outcome) -> list[Bar]:
    """The bars of an experiment."""
    e = o.experiment
    if e.merges == 0:
        return [is_true(f"{e.name}: maps merged", f"0 of {len(e.scenarios)} or more",
                        o.merges == 0 and o.maps >= len(e.scenarios), f"{o.merges} of {o.maps}")]  # fmt: skip
    wanted = o.maps - 1 if e.merges is None else e.merges
    least = max(e.maps, len(e.scenarios))
    out = [
        is_true(f"{e.name}: merges", f"all maps in one world, {least} or more",
                o.merges >= wanted and o.placed == o.maps >= least,
                f"{o.merges} merges, {o.placed} of {o.maps} maps placed"),
        is_true(f"{e.name}: wrong merges", "0", not o.wrong, f"worst map {o.apart_m:.3f} m off"),
    ]  # fmt: skip
    if e.theirs is not None:
        out.append(at_most(f"{e.name}: joint ATE", o.joint_m, round(o.limit_m, 4), "m", 4))
    return out


def _tell(bench: Bench, outcomes: Sequence[Outcome]) -> None:
    rows = []
    for o in outcomes:
        theirs = o.experiment.theirs
        error = "-" if theirs is None or theirs.ate_m is None else f"{theirs.ate_m:g} m of {theirs.path_m:g} m"
        rows.append((
            o.experiment.name, "-" if theirs is None else f"{theirs.name}, {theirs.robots}", error,
            o.maps, o.merges, f"{o.path_m:.1f} m", _metres(o.joint_m), _metres(o.last_frame_m),
            f"{100 * o.joint_m / o.path_m:.4f} %" if np.isfinite(o.joint_m) else "-",
            "-" if theirs is None else f"{100 * theirs.share:.4f} %",
        ))  # fmt: skip
    columns = (
        "ours", "the thesis", "ORB-SLAM2 there", "maps", "merges", "paths of all robots", "joint ATE",
        "when the last frame came", "of the paths",
        "the thesis's",
    )  # fmt: skip
    table(bench, "Beside the thesis", columns, rows)


def _metres(value: float) -> str:
    return f"{value:.4f} m" if np.isfinite(value) else "-"
