"""Whether a link is sealed, and with which file of keys: what its end was told, else by who can reach it.

Sealed by default is every link that others can reach: IP networks, routers, radios, tunnels, cables. On one machine,
the base's and its agents' common file of keys is used where there is one.
"""

import ipaddress
from dataclasses import dataclass
from typing import Literal

from kiteline_hw.links.open import check_link
from kiteline_hw.ports import LinkError
from kiteline_hw.system import key_store

_IP = "zenoh:"
_ROUTER = "router/"  # before a locator: whom a router lets in, this end cannot know
_UNSEALED = "NOT SEALED: whoever reaches this link can read, write and delete"


@dataclass(frozen=True, slots=True)
class Sealing:
    """key: a file of keys; "" for none. lines: what the user is told about it."""

    key: str
    lines: tuple[str, ...] = ()


def sealing_of(link: str, role: Literal["agent", "base"], agent: int, key: str, *, insecure: bool) -> Sealing:
    """How an end of a link is sealed. key: the file that the user named. Raises LinkError.

    The base makes keys where strangers can reach it and there are none.
    """
    if key and insecure:
        raise LinkError("--key seals packets, --insecure does not: choose one")
    if key:
        return Sealing(key)
    if link == "none":
        return Sealing("")
    check_link(link)  # a link that cannot be opened is no question of keys
    if insecure:
        return Sealing("", (f"--insecure: {_UNSEALED}",))
    path = key_store.default_path()
    if is_loopback(link):
        if not path.exists() or (role == "agent" and agent not in key_store.read_keys(path)):
            return Sealing("", ("not sealed: on this machine alone",))
        return Sealing(str(path), (f"sealed with the keys in {path}",))
    if role == "base":
        made = key_store.first_keys(path)
        pairing = "`kiteline keys pair N` here shows the code to pair agent N with, which is then typed there"
        return Sealing(str(path), (f"{'new keys' if made else 'sealed with the keys'} in {path}; {pairing}",))
    if not path.exists() or agent not in key_store.read_keys(path):
        raise LinkError(
            f"agent {agent} is not paired with a base: run `kiteline keys pair {agent}` at the base, and the command "
            "that it shows here; --insecure flies without seals"
        )
    return Sealing(str(path), (f"sealed with the key in {path}",))


def is_loopback(link: str) -> bool:
    """True if only this machine can reach a link: an IP link whose base listens on a loopback address itself."""
    if not link.startswith(_IP) or link.startswith(_IP + _ROUTER):
        return False
    address = link.removeprefix(_IP).partition("/")[2].partition("?")[0].partition("#")[0]
    host = address.rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
