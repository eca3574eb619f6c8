"""The bars of maps of one eye without IMU: loops take back what their unit of length drifts, merges find the metre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.mapper import Mapper
from kiteline_basestation.outputs import keyframe_poses
from kiteline_core import se3, sim3
from kiteline_core.cameras import Rectifier
from kiteline_core.ids import AgentId, agent_of_keyframe
from kiteline_hw.sources import open_source
from kiteline_lab import metrics
from kiteline_lab.sorties import Flight, Sortie

F64 = NDArray[np.float64]


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

    def ate_m(self, sorties: Sequence[int], with_scale: bool) -> float:
        """Of the keyframes of these sorties, laid on the truth as one body; infinite where one has no place."""
        found = [self.places(i) for i in sorties]
        if any(len(ours) < 3 for ours, _ in found):
            return float("inf")
        a, b = (np.concatenate(sides) for sides in zip(*found))
        T, scale = metrics.umeyama(a, b, with_scale)
        return float(np.sqrt(np.mean(np.sum((se3.transform(sim3.of(scale, T), a) - b) ** 2, axis=1))))
