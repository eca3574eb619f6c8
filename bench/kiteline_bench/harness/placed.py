"""Errors of a flight with a base in its world: keyframes and live poses against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import JointRun
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import SEQUENCE_BITS, SUBMAP_BITS
from kiteline_hw.sources.open import open_source
from kiteline_lab.evaluation import metrics


@dataclass(frozen=True, slots=True)
class KeyframesInWorld:
    """A flight, compared with the truth by the base's keyframes; agents are numbered as their scenarios."""

    flight: JointRun

    def agent(self, number: int) -> AgentRun:
        """The flight of one scenario."""
        return self.flight.agents[number]

    @property
    def merges(self) -> int:
        """How many maps were merged."""
        merger = self.flight.station.mapper.merger
        return 0 if merger is None else len(merger.merges)

    def positions(self, agent: int) -> tuple[F64, F64]:
        """Camera positions (n,3) of an agent's keyframes: the base's in w, and true ones, in m."""
        found = [pair for pair in self.positions_by_submap(agent).values() if len(pair[0])]
        if not found:
            return np.zeros((0, 3)), np.zeros((0, 3))
        return np.concatenate([ours for ours, _ in found]), np.concatenate([theirs for _, theirs in found])

    def positions_by_submap(self, agent: int) -> dict[int, tuple[F64, F64]]:
        """The same for each of an agent's submaps that lie in the world."""
        source = open_source(self.flight.scenarios[agent].source)
        T_b_c = Rectifier(source.rig).camera.T_b_c
        source.close()
        run, mapper = self.agent(agent), self.flight.station.mapper
        if not run.found:
            return {}
        truth = {t: T for t, T in zip(run.t_ns, run.truth, strict=True) if T is not None}
        boot = run.found[0].submap >> SUBMAP_BITS
        pairs: dict[int, list[tuple[F64, F64]]] = {}
        for keyframe, S_w_c in keyframe_poses(mapper).items():
            t_ns = int(mapper.map.keyframes.t_ns[mapper.map.rows[keyframe]])
            if keyframe >> SEQUENCE_BITS + SUBMAP_BITS == boot and t_ns in truth:
                pairs.setdefault(keyframe >> SEQUENCE_BITS, []).append((S_w_c[:3, 3], (truth[t_ns] @ T_b_c)[:3, 3]))
        return {submap: (np.array([a for a, _ in p]), np.array([b for _, b in p])) for submap, p in pairs.items()}

    def length_error(self, agent: int) -> float:
        """Share by which lengths of an agent's path are off in the world."""
        ours, theirs = self.positions(agent)
        return abs(metrics.umeyama(ours, theirs, with_scale=True)[1] - 1.0) if len(ours) > 2 else float("inf")

    def ate_m(self, agents: Sequence[int], with_scale: bool) -> float:
        """ATE of these agents' keyframes under one alignment; infinite if one of them has no keyframes."""
        found = [self.positions(i) for i in agents]
        if any(len(ours) < 3 for ours, _ in found):
            return float("inf")
        a, b = (np.concatenate(sides) for sides in zip(*found))
        T, scale = metrics.umeyama(a, b, with_scale=with_scale)
        return float(np.sqrt(np.mean(np.sum((se3.transform(sim3.of(scale, T), a) - b) ** 2, axis=1))))

    def live_m(self, agent: int, first: int = 0) -> float:
        """RMSE of an agent's live positions in w from a frame on, aligned by the keyframes of the first scenario."""
        run = self.agent(agent)
        T_true_w, _ = metrics.umeyama(*self.positions(0))
        pairs = [
            ((T_true_w @ e.T_w_b)[:3, 3], true[:3, 3])
            for e, true, placed in zip(run.found[first:], run.truth[first:], run.placed[first:], strict=True)
            if e.tracked and placed and e.T_w_b is not None and true is not None
        ]
        return float(np.sqrt(np.mean([np.sum((a - b) ** 2) for a, b in pairs]))) if pairs else float("inf")

    def placed_s(self, agent: int) -> float:
        """Time from an agent's first frame until its live pose stands in w."""
        run = self.agent(agent)
        known = [t for t, placed in zip(run.t_ns, run.placed, strict=True) if placed]
        return (known[0] - run.t_ns[0]) * 1e-9 if known else float("inf")

    def largest_correction_m(self, agent: int) -> float:
        """Largest change of an agent's live position in w between two frames, beside its motion in o."""
        return max(
            float(np.linalg.norm((b.T_w_b @ se3.inverse(b.T_o_b) @ a.T_o_b)[:3, 3] - a.T_w_b[:3, 3]))
            for a, b in pairwise(self.agent(agent).found)
            if a.T_w_b is not None and b.T_w_b is not None
        )
