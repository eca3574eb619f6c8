"""Restores a station from a saved map."""

from dataclasses import dataclass

from kiteline_basestation.exchange.map_cache_planner import is_cached_key
from kiteline_basestation.station import Station
from kiteline_basestation.store.integrity import Checked, check, contradictions, relinked
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_basestation.store.state_texts import state_of
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import WireError, messages
from kiteline_core.errors import INPUT_FAULTS


@dataclass(frozen=True, slots=True)
class Restored:
    """What was restored. saved: the values taken. keyframes: in the map. faults: values left out. awaited: values that
    agents have to send again.
    """

    saved: SavedMap
    keyframes: int
    faults: tuple[str, ...]
    awaited: int


def restore(station: Station, saved: SavedMap, now_ns: int) -> Restored:
    """Put a saved map into a new station, and share the base's values with the agents again.

    Values that an agent sends again replace the saved ones. Raises WireError if what is left is inconsistent.
    """
    try:
        return _restore(station, check(saved), now_ns)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, *INPUT_FAULTS) as error:
        raise WireError(f"the saved map's state cannot be read ({error!r}); begin an empty store") from error


def _restore(station: Station, checked: Checked, now_ns: int) -> Restored:
    mapper, saved = station.mapper, checked.saved
    for agent, values in sorted(saved.agents.items()):
        channel = station.join(agent)
        if isinstance(channel, CodedChannel):
            channel.endpoint.resume(values.received)  # so that its agent need not send them again
        received = tuple(messages.decode(key, values.received[key]) for key in sorted(values.received))
        mapper.restore(agent, received, (), now_ns)
    for agent, values in sorted(saved.agents.items()):  # after all received: fused landmarks may be of several agents
        own = [key for key in sorted(values.own) if not is_cached_key(key)]  # the map cache is planned anew
        station.restore(agent, [messages.decode(key, values.own[key]) for key in own], now_ns)
    mapper.restore_state(state_of(saved.texts))
    faults = (*checked.faults, *relinked(mapper))
    wrong = contradictions(mapper)
    if wrong:
        raise WireError(f"the saved map contradicts itself: {'; '.join(wrong[:5])}; begin an empty store")
    return Restored(saved, len(mapper.map), faults, checked.awaited)
