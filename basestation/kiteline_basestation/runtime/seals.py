"""The base's side of seals: the hub through which packets pass, keys that change while it runs, and what is wrong."""

from pathlib import Path

from kiteline_basestation.runtime.options import BaseOptions
from kiteline_codec.transport.seal import Direction, Opener, Sealer, suite_for
from kiteline_codec.transport.seal_watch import SealWatch
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.links.sealed_link import SealedHub, SealedLineHub, WatchedHub
from kiteline_hw.links.zenoh_link import ZenohHub
from kiteline_hw.ports import LinkError, LinkHub, link_messages
from kiteline_hw.system.key_store import MAPS, WatchedKeys, login_of, read_file

_LOOK_NS = 1_000_000_000  # between two looks at the file of keys
_DOUBLES_NS = 200_000_000  # between two looks for agents with one number, which are named within 3 s


def logins_of(path: Path) -> dict[str, str]:
    """Users and passwords of all who have a key in a file. Raises LinkError, also if nobody has one: the base would
    take connections of anyone.
    """
    keys = read_file(path)
    if not keys.agents and keys.maps is None:
        raise LinkError(f"nobody has a key in {path}: run `kiteline keys --file {path} pair N`")
    owners: list[tuple[int | str, bytes]] = [*keys.agents.items()]
    if keys.maps is not None:
        owners.append((MAPS, keys.maps))
    return {user: password for owner, key in owners for user, password in login_of(owner, key).items()}


class BaseSeals:
    """Seals packets if there is a file of keys; reports in either case why packets of agents cannot be opened."""

    def __init__(self, options: BaseOptions, link: LinkHub) -> None:
        """Raises LinkError."""
        self._options, self._link = options, link
        self._file = WatchedKeys(Path(options.key)) if options.key else None
        self._keys = {} if self._file is None else dict(self._file.held.agents)
        self._looked_ns = self._looked_for_doubles_ns = 0
        self._doubles: frozenset[int] = frozenset()
        self._opener = None if self._file is None else Opener(self._keys, Direction.UP)
        self.sealers: dict[int, Sealer] = {}  # by agent
        self._watch = SealWatch(Direction.DOWN, self._opener)
        self._sealed: SealedHub | SealedLineHub | None = None
        if self._file is not None and link_traits(options.link).thin:
            self._sealed = SealedLineHub(link, self._sealer, self._watch)
        elif self._file is not None:
            self._sealed = SealedHub(link, self._sealer, self._watch)
        self.hub: LinkHub = WatchedHub(link, self._watch) if self._sealed is None else self._sealed

    def lines(self, now_ns: int) -> list[str]:
        """Messages to the user since the last call. Takes new keys, too."""
        lines = [*link_messages(self._link), *self._watch.lines()]
        if now_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = now_ns
            lines += self._new_keys()
        if now_ns - self._looked_for_doubles_ns >= _DOUBLES_NS:
            self._looked_for_doubles_ns = now_ns
            lines += self._new_doubles()
        return lines

    def _new_doubles(self) -> list[str]:
        doubles = self._link.doubles() if isinstance(self._link, ZenohHub) else frozenset()
        if self._sealed is not None:
            doubles &= self._sealed.alive()  # anyone can announce a number
        new, self._doubles = sorted(doubles - self._doubles), doubles
        return [f"two agents have number {agent}: give each its own --agent N" for agent in new]

    def _sealer(self, agent: int) -> Sealer | None:
        if agent in self._keys:
            suite = suite_for(link_traits(self._options.link))
            self.sealers[agent] = Sealer(self._keys[agent], agent, self._options.session, Direction.DOWN, suite)
        return self.sealers.get(agent)

    @property
    def maps_key(self) -> bytes | None:
        """The key of the right to change maps; None if nobody has it."""
        return None if self._file is None else self._file.held.maps

    def _new_keys(self) -> list[str]:
        """Take keys that changed in the file; a file that cannot be read changes none."""
        if self._file is None or self._opener is None or self._sealed is None:
            return []
        try:
            if not self._file.take_change():
                return []
        except LinkError as error:
            return [f"{error}; the keys before it stay valid"]
        keys, before = self._file.held.agents, self._keys
        self._keys = dict(keys)
        changed = sorted(agent for agent in keys.keys() | before.keys() if keys.get(agent) != before.get(agent))
        for agent in changed:
            self._opener.set_key(agent, keys.get(agent))
            self.sealers.pop(agent, None)
            self._sealed.renew(agent)
        return [f"{'new key for' if agent in keys else 'no key any more for'} agent {agent}" for agent in changed]
