"""`kiteline export STORE --format tum|ply|pgm|g2o --out F`: write a base's map in the formats of other tools."""

import argparse
import json
import re
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.management import submap_name
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_basestation.runtime.map_files import map_files
from kiteline_basestation.runtime.map_formats import g2o, tum
from kiteline_basestation.station import Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.store import read
from kiteline_codec.channel import CodedChannel
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.arrays import I64
from kiteline_core.errors import KitelineError
from kiteline_core.geometry import sim3
from kiteline_core.ids import (
    NO_KEYFRAME,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    agent_of_submap,
    boot_of_submap,
    submap_of_keyframe,
)
from kiteline_core.wording import counted
from kiteline_lab.outputs.out_file import write_files

FORMATS = ("tum", "ply", "pgm", "g2o")
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]*")  # of a picture, as it stands in YAML
ESSENTIAL_LANDMARKS = 100  # shared by two keyframes of an edge of the essential graph (ORB-SLAM2)


class ExportError(KitelineError):
    """A map that cannot be exported in this way."""


def load(store: Path) -> Mapper:
    """Restore a saved map. store: the folder given to `--store`, or the file in it. Raises StoreError, WireError."""
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))
    for fault in restore(station, read(store), 0).faults:
        print(f"{store}: {fault}", file=sys.stderr)
    station.mapper.grid_updates.make_all()
    return station.mapper


def files(mapper: Mapper, kind: str, name: str, agent: int | None = None, boot: int | None = None) -> dict[str, bytes]:
    """Contents of the files of one format, by file name. name: of the main file.

    agent, boot: tum: whose trajectory, and of which start; None: the only agent, all starts.

    tum: camera poses of keyframes in w. g2o: keyframes with edges to parents and covisible keyframes. pgm: with a
    YAML file beside it. Raises ExportError.
    """
    if kind == "tum":
        return {name: _trajectory(mapper, agent, boot)}
    if kind == "g2o":
        return {name: _graph(mapper)}
    made = map_files(mapper)
    if kind == "ply":
        return {name: made["map.ply"]}
    beside = str(Path(name).with_suffix(".yaml"))
    if beside == name:
        raise ExportError(f"{name}: this is the file beside the picture: expected a name that ends in .pgm")
    shown = name if _PLAIN_NAME.fullmatch(name) else json.dumps(name, ensure_ascii=False)  # else it would not be YAML
    text = made["grid.yaml"].replace(b"image: grid.pgm\n", f"image: {shown}\n".encode(errors="surrogateescape"))
    return {name: made["grid.pgm"], beside: text}


def _trajectory(mapper: Mapper, agent: int | None, boot: int | None) -> bytes:
    poses = keyframe_poses(mapper)
    here = sorted({int(agent_of_keyframe(k)) for k in poses})
    if agent is None and len(here) > 1:
        raise ExportError(f"the map holds agents {here}: choose one with --agent")
    if agent is not None and agent not in here and any(agent_of_submap(s) == agent for s in mapper.map.submaps):
        raise ExportError(f"no map of agent {agent} has a place in w: it has not matched the one that has")
    if agent is not None and agent not in here:
        raise ExportError(f"the map holds agents {here}, none with number {agent}")
    mine = [k for k in poses if agent is None or agent_of_keyframe(k) == AgentId(agent)]
    boots = np.array([boot_of_submap(submap_of_keyframe(k)) for k in mine], np.int64)
    if boot is not None and boot not in boots:
        raise ExportError(f"the map holds boots {np.unique(boots).tolist()} of this agent, none with number {boot}")
    chosen = np.ones(len(mine), np.bool_) if boot is None else boots == boot
    mine, boots = [k for k, taken in zip(mine, chosen, strict=True) if taken], boots[chosen]
    stamps = np.array([mapper.map.keyframes.t_ns[mapper.map.rows[k]] for k in mine], np.int64)
    if _overlap(stamps, boots):
        raise ExportError(
            f"boots {np.unique(boots).tolist()} of this agent flew at the same times, as where a recording is flown "
            "again: choose one with --boot"
        )
    order = np.argsort(stamps, kind="stable")
    return tum(stamps[order], np.array([sim3.rigid(poses[mine[i]]) for i in order]).reshape(-1, 4, 4))


def _overlap(stamps: I64, boots: I64) -> bool:
    """True if poses of one boot lie between those of another in time. Both (n,)."""
    spans = sorted((stamps[boots == boot].min(), stamps[boots == boot].max()) for boot in np.unique(boots))
    return any(begin <= end for (_, end), (begin, _) in pairwise(spans))


def _graph(mapper: Mapper) -> bytes:
    poses = keyframe_poses(mapper)
    number = {k: i for i, k in enumerate(poses)}
    pairs: set[tuple[int, int]] = set()
    for k, i in number.items():
        parent = KeyframeId(int(mapper.map.keyframes.parent[mapper.map.rows[k]]))
        near = [parent] if parent != NO_KEYFRAME else []
        near += mapper.map.covisible_keyframes(k, ESSENTIAL_LANDMARKS)
        pairs |= {(min(i, number[n]), max(i, number[n])) for n in near if n in number}
    edges: I64 = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    scale = np.array([sim3.scale_of(S) for S in poses.values()])
    rigid = np.array([sim3.rigid(S) for S in poses.values()]).reshape(-1, 4, 4)
    return g2o(np.array(list(poses), np.int64), rigid, edges, scale=scale)


def _left_out(mapper: Mapper) -> list[str]:
    """Maps that are in no file, as nothing tells where they lie; a line each."""
    sparse_map, lost = mapper.map, dict[SubmapId, int]()
    for submap in sorted(sparse_map.submaps.keys() - mapper.placements.keys()):
        map_id = sparse_map.map_id(submap)
        lost[map_id] = lost.get(map_id, 0) + len(sparse_map.submaps[submap])
    return [
        f"left out: map {submap_name(map_id)} ({counted(n, 'keyframe')}) has no place in w"
        for map_id, n in lost.items()
    ]


def main(argv: Sequence[str]) -> int:
    """Run `kiteline export`; the exit status. Raises KitelineError."""
    parser = argparse.ArgumentParser(prog="kiteline export", description="A base's map in the formats of other tools.")
    parser.add_argument("store", type=Path, metavar="STORE", help="the folder given to `kiteline base --store`")
    parser.add_argument("--format", choices=FORMATS, required=True)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="F", help="file to write; pgm: a YAML file beside it"
    )
    parser.add_argument("--agent", type=int, help="tum: whose trajectory; needed if there are several")
    parser.add_argument("--boot", type=int, help="tum: of which start; needed if a recording was flown several times")
    parser.add_argument("--force", action="store_true", help="overwrite F, and the file beside it")
    args = parser.parse_args(argv)
    mapper = load(args.store)
    if not len(mapper.map):
        raise ExportError(f"{args.store}: the map is empty: there is nothing to export")
    for line in _left_out(mapper):
        print(f"{args.store}: {line}", file=sys.stderr)
    made = files(mapper, args.format, args.out.name, args.agent, args.boot)
    for path in write_files(args.out.parent, made, force=args.force):
        print(path)
    return 0
