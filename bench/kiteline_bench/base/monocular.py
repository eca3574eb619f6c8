"""The bars of maps of one eye without IMU: loops take back what their unit of length drifts, merges find the metre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.mapper import Mapper
from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_bench.harness.sorties import Flight, Part, Sortie, fly
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import AgentId, agent_of_keyframe
from kiteline_hw.sources.open import open_source
from kiteline_lab.evaluation import metrics

F64 = NDArray[np.float64]

_SECONDS = 60.0  # of the flights in the hall: in which both see the same walls
_BEGIN = (Part(0.0, _SECONDS),)


@dataclass(frozen=True, slots=True)
class Judged:
    """A flight's keyframes beside the truth."""

    flight: Flight
    sorties: Sequence[Sortie]

    @property
    def mapper(self) -> Mapper:
        """The base's."""
        return self.flight.station.mapper

    def places(self, sortie: int) -> tuple[F64, F64]:
        """Positions (n,3) of a sortie's keyframes, as the base has them in w, and in truth. In m, as long as w is."""
        source = open_source(self.sorties[sortie].source)
        T_b_c = Rectifier(source.rig).camera.T_b_c
        source.close()
        flown = self.flight.sorties[sortie]
        truth = {e.t_ns: T for e, T in zip(flown.estimates, flown.truth, strict=True)}
        ours, theirs = [], []
        for keyframe, S_w_c in keyframe_poses(self.mapper).items():
            t_ns = int(self.mapper.map.keyframes.t_ns[self.mapper.map.rows[keyframe]])
            if agent_of_keyframe(keyframe) == AgentId(self.sorties[sortie].agent) and t_ns in truth:
                ours.append(S_w_c[:3, 3])
                theirs.append((truth[t_ns] @ T_b_c)[:3, 3])
        return np.array(ours).reshape(-1, 3), np.array(theirs).reshape(-1, 3)

    @property
    def merges(self) -> int:
        """How many maps were joined."""
        merger = self.mapper.merger
        return 0 if merger is None else len(merger.merges)

    def length_error(self, sortie: int) -> float:
        """By what share lengths of a sortie's way are off, in the world."""
        ours, theirs = self.places(sortie)
        return abs(metrics.umeyama(ours, theirs, with_scale=True)[1] - 1.0) if len(ours) > 2 else float("inf")

    def ate_m(self, sorties: Sequence[int], with_scale: bool) -> float:
        """Of the keyframes of these sorties, laid on the truth as one body; infinite where one has no place."""
        found = [self.places(i) for i in sorties]
        if any(len(ours) < 3 for ours, _ in found):
            return float("inf")
        a, b = (np.concatenate(sides) for sides in zip(*found))
        T, scale = metrics.umeyama(a, b, with_scale)
        return float(np.sqrt(np.mean(np.sum((se3.transform(sim3.of(scale, T), a) - b) ** 2, axis=1))))


def bars(bench: Bench, street: Mapping[str, Any], hall: Sequence[Path]) -> list[Bar]:
    """street: the report of KITTI 06 flown with one eye. hall: MH_01 and MH_03 in one hall."""
    accuracy = street["agents"][0]["accuracy"]
    base_m, odometry_m = (float(accuracy[what]["ate_m"]) for what in ("base", "odometry"))
    pair, eye = Sortie(f"mcap:{hall[0]}", 0, parts=_BEGIN), Sortie(f"mcap:{hall[1]}", 1, parts=_BEGIN, mono=True)
    bench.say("flying MH_01 with two eyes and MH_03 with one")
    mixed = Judged(fly([pair, eye]), (pair, eye))
    bench.say("flying both with one eye")
    other = replace(pair, mono=True)
    single = Judged(fly([other, eye]), (other, eye))
    return [
        is_true("KITTI 06 in the street with one eye: loop", "closed", street["base"]["loops"] >= 1,
                f"{street['base']['loops']} loops"),
        at_most("KITTI 06 in the street with one eye: ATE base, scale aligned", base_m, 1.0, "m"),
        at_most("the same over that of the agent's odometry", base_m / odometry_m, 0.5, "", 2),
        is_true(f"MH_03 with one eye beside MH_01 with two, {_SECONDS:g} s", "one map", mixed.merges == 1,
                f"{mixed.merges} merges"),
        at_most("its ATE, scale as it is", mixed.ate_m([1], with_scale=False), 0.02, "m", 4),
        at_most("how far its metre is off", 100.0 * mixed.length_error(1), 1.0, "%", 2),
        at_most("joint ATE of both, scale as it is", mixed.ate_m([0, 1], with_scale=False), 0.025, "m", 4),
        is_true("MH_01 and MH_03 with one eye each", "one map", single.merges == 1, f"{single.merges} merges"),
        at_most("their joint ATE, one scale for both aligned", single.ate_m([0, 1], with_scale=True), 0.025, "m", 4),
    ]  # fmt: skip
