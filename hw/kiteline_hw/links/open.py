"""Opens the links that users name: SCHEME:ADDRESS of the table in kinds.py."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Literal, overload

from kiteline_hw.links import kinds
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.ports import ByteLink, Framer, LinkError, LinkHub


@overload
def open_link(
    spec: str, role: Literal["agent"], agent: int = ..., *,
    group: str = ..., framer: Callable[[], Framer] | None = ..., required: bool = ...,
    logins: Mapping[str, str] | None = ...,
) -> ByteLink: ...  # fmt: skip
@overload
def open_link(
    spec: str, role: Literal["base"], agent: int = ..., *,
    group: str = ..., framer: Callable[[], Framer] | None = ..., required: bool = ...,
    logins: Mapping[str, str] | None = ...,
) -> LinkHub: ...  # fmt: skip
def open_link(
    spec: str, role: Literal["agent", "base"], agent: int = 0, *,
    group: str = "default", framer: Callable[[], Framer] | None = None, required: bool = True,
    logins: Mapping[str, str] | None = None,
) -> ByteLink | LinkHub:  # fmt: skip
    """Open one end of a link: a ByteLink for an agent, a LinkHub for a base. See LinkOptions. Raises LinkError."""
    module = import_module(kind_of(spec).module)
    address = spec.partition(":")[2]
    options = LinkOptions(agent, group, framer, required, logins or {})
    end: ByteLink | LinkHub = (module.open_agent_end if role == "agent" else module.open_base_end)(address, options)
    return end


def kind_of(spec: str) -> kinds.LinkKind:
    """The kind of a LINK. Raises LinkError if it is of none, or its address is missing or not wanted."""
    scheme, _, address = spec.partition(":")
    kind = next((kind for kind in kinds.LINKS if kind.scheme == scheme), None)
    if kind is None or bool(address) != bool(kind.address):
        raise LinkError(f"unknown link {spec!r}: expected {kinds.link_forms()}")
    return kind
