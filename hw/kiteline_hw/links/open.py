"""Opens the links that users name: SCHEME:ADDRESS of the table in kinds.py."""

from importlib import import_module
from typing import Literal, overload

from kiteline_hw.links import kinds
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.ports import ByteLink, LinkError, LinkHub

_PLAIN = LinkOptions()


@overload
def open_link(spec: str, role: Literal["agent"], options: LinkOptions = ...) -> ByteLink: ...
@overload
def open_link(spec: str, role: Literal["base"], options: LinkOptions = ...) -> LinkHub: ...
def open_link(spec: str, role: Literal["agent", "base"], options: LinkOptions = _PLAIN) -> ByteLink | LinkHub:
    """Open one end of a link: a ByteLink for an agent, a LinkHub for a base. Raises LinkError."""
    module = import_module(kind_of(spec).module)
    address = spec.partition(":")[2]
    end: ByteLink | LinkHub = (module.open_agent_end if role == "agent" else module.open_base_end)(address, options)
    return end


def check_link(spec: str) -> None:
    """Raise LinkError for a LINK of no kind, or whose address is not of its form."""
    check = getattr(import_module(kind_of(spec).module), "check_address", None)
    if check is not None:
        check(spec.partition(":")[2])


def kind_of(spec: str) -> kinds.LinkKind:
    """The kind of a LINK. Raises LinkError if it is of none, or its address is missing or not wanted."""
    scheme, _, address = spec.partition(":")
    kind = next((kind for kind in kinds.LINKS if kind.scheme == scheme), None)
    if kind is None or bool(address) != bool(kind.address):
        raise LinkError(f"unknown link {spec!r}: expected {kinds.link_forms()}")
    return kind
