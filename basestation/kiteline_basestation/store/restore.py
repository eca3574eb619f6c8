"""A kept map becomes a station's map again."""

from __future__ import annotations

from dataclasses import dataclass

from kiteline_basestation.exchange.map_cache_planner import is_copy
from kiteline_basestation.station import Station
from kiteline_basestation.store.integrity import Checked, contradictions, sound
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import WireError, messages


@dataclass(frozen=True, slots=True)
class Restored:
    """How it went. kept: what was taken. keyframes: in the map. faults: what was taken out. awaited: values that agents
    are to send again.
    """

    kept: SavedMap
    keyframes: int
    faults: tuple[str, ...]
    awaited: int


def restore(station: Station, kept: SavedMap, now_ns: int) -> Restored:
    """Put a map into a station that begins, and share with the agents again what is ours. What an agent still holds
    comes again and replaces what it told the earlier base. Raises WireError where what is left contradicts itself.
    """
    try:
        return _restore(station, sound(kept), now_ns)
    except (KeyError, TypeError, ValueError) as error:
        raise WireError(f"the kept map's memory cannot be read ({error!r}); begin an empty store") from error


def _restore(station: Station, checked: Checked, now_ns: int) -> Restored:
    mapper = station.mapper
    for agent, codes in sorted(checked.kept.agents.items()):
        channel = station.join(agent)
        if isinstance(channel, CodedChannel):
            channel.endpoint.resume(codes.received)  # so that its agent need not send it again
        received = tuple(messages.decode(key, codes.received[key]) for key in sorted(codes.received))
        mapper.restore(agent, received, (), now_ns)
    for agent, codes in sorted(checked.kept.agents.items()):  # what is ours may tell of points of several agents
        channel = station.join(agent)
        ours = [key for key in sorted(codes.own) if not is_copy(key)]  # what was lent is lent anew
        mapper.restore(agent, (), tuple(channel.put(messages.decode(key, codes.own[key])) for key in ours), now_ns)
    mapper.recall(checked.kept.memory)
    wrong = contradictions(mapper)
    if wrong:
        raise WireError(f"the kept map contradicts itself: {'; '.join(wrong[:5])}; begin an empty store")
    return Restored(checked.kept, len(mapper.map), checked.faults, checked.awaited)
