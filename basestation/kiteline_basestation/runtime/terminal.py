"""Status messages of a base for the terminal: events, and a summary every few seconds while something changes. Pure."""

from collections.abc import Collection, Sequence

import numpy as np

from kiteline_basestation.management import submap_name
from kiteline_basestation.merging.loop_edges import LoopEdge
from kiteline_basestation.merging.merges import MapMerge
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_submap, submap_of_keyframe
from kiteline_core.wording import counted

_EVERY_NS = 10_000_000_000  # between two summaries


class TerminalReporter:
    """Compares the station after each step with its last state."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._here: frozenset[AgentId] = frozenset()
        self._gone_ns: dict[AgentId, int] = {}  # since when those that were here are out of reach
        self._sessions: dict[AgentId, int] = {}
        self._submaps = set(station.mapper.map.submaps)
        self._deleted = set(station.mapper.deleted)
        merger = station.mapper.merger
        self._loops = 0 if merger is None else merger.loops
        self._undone = 0 if merger is None else merger.undone
        self._proofs = 0 if merger is None else len(merger.edges)
        self._merges = [] if merger is None else list(merger.merges)
        self._summary_ns = _EVERY_NS
        self._bytes_down = self._bytes_up = 0
        self._summarised: tuple[object, ...] = ()  # what the last summary said, but for rates and memory

    def lines(self, here: Collection[int], flight_ns: int, rss_mib: float, stored: bool | None) -> list[str]:
        """Lines to print after a step. here: reachable agents. rss_mib: peak memory of this process.

        stored: True if all is on disk, None without a store.
        """
        out = [*self._agents(frozenset(map(AgentId, here)), flight_ns), *self._maps()]
        if flight_ns >= self._summary_ns:
            status = self._status(flight_ns, rss_mib, stored)
            now = (len(self._here), self.summary(), stored)
            if now != self._summarised:
                out.append(status)
                self._summarised = now
            self._summary_ns = flight_ns + _EVERY_NS
        return [f"{flight_ns / 1e9:8.1f} s  {line}" for line in out]

    def _agents(self, here: frozenset[AgentId], flight_ns: int) -> list[str]:
        """Agents that connected, disconnected or restarted."""
        out = []
        for agent in sorted(here - self._here):
            gone_ns = self._gone_ns.pop(agent, None)
            after = "" if gone_ns is None else f" again after {(flight_ns - gone_ns) / 1e9:.1f} s"
            out.append(f"agent {agent} connected{after}")
        for agent in sorted(self._here - here):
            self._gone_ns[agent] = flight_ns
            out.append(f"agent {agent} disconnected; its map is kept")
        self._here = here
        for agent, channel in sorted(self._station.channels.items()):
            session = channel.endpoint.peer_session or 0 if isinstance(channel, CodedChannel) else 0
            before = self._sessions.get(agent, 0)
            if session != before:
                self._sessions[agent] = session
                if before:
                    out.append(f"agent {agent} restarted; its earlier map is kept")
        return out

    def _maps(self) -> list[str]:
        """Maps that were started, merged, split or deleted, and loop closures."""
        mapper, out = self._station.mapper, []
        for submap in [s for s in mapper.map.submaps if s not in self._submaps]:
            self._submaps.add(submap)
            out.append(f"agent {agent_of_submap(submap)} starts map {_name(submap, mapper.names)}")
        for submap in sorted(mapper.deleted - self._deleted):
            self._deleted.add(submap)
            out.append(f"map {_name(submap, mapper.names)} deleted")
        merger = mapper.merger
        if merger is None:
            return out
        proved, self._proofs = merger.edges[self._proofs :], len(merger.edges)
        if merger.loops > self._loops:
            self._loops = merger.loops
            out.append(f"loop {self._loops} closed: {self._loop(proved)}")
        for merge in [m for m in merger.merges if not any(m is known for known in self._merges)]:
            out.append(self._merged(merge))
        if merger.undone > self._undone:
            self._undone = merger.undone
            gone = [m for m in self._merges if not any(m is kept for kept in merger.merges)]
            names = ", ".join(_name(m.map_id, mapper.names) for m in gone)
            out.append(f"map {names} separated from the map that it was merged into")
        self._merges = list(merger.merges)
        return out

    def _loop(self, edges: Sequence[LoopEdge]) -> str:
        """The position error that a loop closure corrects, and the length of the loop."""
        sparse_map = self._station.mapper.map
        edge = max(edges, key=lambda e: e.inliers, default=None)
        old, new = (None, None) if edge is None else (sparse_map.world_pose(edge.old), sparse_map.world_pose(edge.new))
        if edge is None or old is None or new is None:
            return "landmarks matched where predicted"
        error_m = float(np.linalg.norm((se3.inverse(new) @ old @ edge.T_old_new)[:3, 3]))
        path_m = self._path_length_m(edge.old, edge.new)
        return f"error {error_m:.2f} m" + ("" if path_m is None else f" after {path_m:.0f} m")

    def _path_length_m(self, old: KeyframeId, new: KeyframeId) -> float | None:
        """Path length between two keyframes; None if they are in different submaps."""
        sparse_map = self._station.mapper.map
        if submap_of_keyframe(old) != submap_of_keyframe(new):
            return None
        between = [k for k in sparse_map.submaps[submap_of_keyframe(new)] if min(old, new) <= k <= max(old, new)]
        at = sparse_map.keyframes.T_w_k[[sparse_map.rows[k] for k in between], :3, 3]
        return float(np.linalg.norm(np.diff(at, axis=0), axis=1).sum())

    def _merged(self, merge: MapMerge) -> str:
        mapper = self._station.mapper
        keyframes = sum(len(mapper.map.submaps.get(submap, ())) for submap in merge.moved)
        newer, older = _name(merge.map_id, mapper.names), _name(merge.into, mapper.names)
        return f"map {newer} ({counted(keyframes, 'keyframe')}) merged into map {older}"

    def summary(self) -> str:
        """Sizes of the map in one line."""
        s = self._station.mapper.summary()
        return (
            f"{counted(_int(s['keyframes']), 'keyframe')} and {counted(_int(s['points']), 'landmark')} "
            f"in {counted(_int(s['maps']), 'map')}; "
            f"{counted(_int(s['loops']), 'loop')}, {counted(_int(s['merges']), 'merge')}"
        )

    def _status(self, flight_ns: int, rss_mib: float, stored: bool | None) -> str:
        """Agents, map, link, memory and store in one line."""
        ends = [c.endpoint.stats for c in self._station.channels.values() if isinstance(c, CodedChannel)]
        up, down = sum(e.bytes_received for e in ends), sum(e.bytes_sent for e in ends)
        seconds = (flight_ns - self._summary_ns + _EVERY_NS) / 1e9
        rates = (up - self._bytes_up) / 1000 / seconds, (down - self._bytes_down) / 1000 / seconds
        self._bytes_up, self._bytes_down = up, down
        waits = sum(e.dirty for e in ends)
        parts = [
            f"{counted(len(self._here), 'agent')} connected",
            self.summary(),
            f"{rates[0]:.1f} kB/s up, {rates[1]:.1f} down" + (f", {counted(waits, 'value')} to send" if waits else ""),
            f"peak memory {rss_mib:.0f} MiB",
        ]
        if stored is not None:
            parts.append("all stored" if stored else "store not up to date")
        return "; ".join(parts)


def _name(submap: SubmapId, names: dict[SubmapId, str]) -> str:
    return f'{submap_name(submap)} "{names[submap]}"' if submap in names else submap_name(submap)


def _int(value: object) -> int:
    assert isinstance(value, int)
    return value
