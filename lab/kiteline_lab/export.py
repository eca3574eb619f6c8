"""`kiteline export STORE --format tum|ply|pgm|g2o --out F`: a base's map in the formats of other tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.covisibility import covisible_keyframes
from kiteline_basestation.export import g2o, tum
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.outputs import keyframe_poses, map_files
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, agent_of_keyframe

I64 = NDArray[np.int64]

FORMATS = ("tum", "ply", "pgm", "g2o")
ESSENTIAL_POINTS = 100  # points that two keyframes share for an edge of the essential graph (ORB-SLAM2)


class ExportError(Exception):
    """A map that cannot be exported so. The text says what was found and what was expected."""


def files(mapper: Mapper, kind: str, name: str, agent: int | None = None) -> dict[str, bytes]:
    """The files of one format by name. name: of the main file. agent: whose trajectory, or None where there is one.

    tum: camera poses of keyframes in w. g2o: keyframes with edges to parents, and to covisible ones. pgm brings a YAML
    file beside it. Raises ExportError.
    """
    if kind == "tum":
        return {name: _trajectory(mapper, agent)}
    if kind == "g2o":
        return {name: _graph(mapper)}
    made = map_files(mapper)
    if kind == "ply":
        return {name: made["map.ply"]}
    text = made["grid.yaml"].replace(b"image: grid.pgm\n", f"image: {name}\n".encode())
    return {name: made["grid.pgm"], str(Path(name).with_suffix(".yaml")): text}


def _trajectory(mapper: Mapper, agent: int | None) -> bytes:
    poses = keyframe_poses(mapper)
    here = sorted({int(agent_of_keyframe(k)) for k in poses})
    if agent is None and len(here) > 1:
        raise ExportError(f"the map holds agents {here}: a trajectory is of one of them, choose with --agent")
    if agent is not None and agent not in here:
        raise ExportError(f"the map holds agents {here}, none with number {agent}")
    mine = [k for k in poses if agent is None or agent_of_keyframe(k) == AgentId(agent)]
    stamps = np.array([mapper.map.keyframes.t_ns[mapper.map.rows[k]] for k in mine], np.int64)
    order = np.argsort(stamps, kind="stable")
    return tum(stamps[order], np.array([poses[mine[i]] for i in order]).reshape(-1, 4, 4))


def _graph(mapper: Mapper) -> bytes:
    poses = keyframe_poses(mapper)
    number = {k: i for i, k in enumerate(poses)}
    pairs: set[tuple[int, int]] = set()
    for k, i in number.items():
        parent = KeyframeId(int(mapper.map.keyframes.parent[mapper.map.rows[k]]))
        near = [parent] if parent != NO_KEYFRAME else []
        near += covisible_keyframes(mapper.map, k, ESSENTIAL_POINTS)
        pairs |= {(min(i, number[n]), max(i, number[n])) for n in near if n in number}
    edges: I64 = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    return g2o(np.array(list(poses), np.int64), np.array(list(poses.values())).reshape(-1, 4, 4), edges)
