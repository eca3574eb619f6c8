"""What a base lets clients do over Zenoh, and the tokens by which two agents with one number are found."""

import time
from typing import Any

PREFIX = "kiteline/1/default"  # of all keys

# Messages and keys below PREFIX. Nothing else passes, so that a base routes nothing between its clients: none
# reads what another sends, nor writes in the base's name. Tokens of an agent alone reach others.
_FROM_CLIENTS = (
    (("put",), ("*/up",)),
    (("declare_subscriber",), ("*/down",)),
    (("liveliness_token",), ("*/alive", "*/alive/*")),
    (("declare_liveliness_subscriber", "liveliness_query"), ("base", "*/alive/*")),
    (("query",), ("maps/*",)),
)
_TO_CLIENTS = (
    (("put",), ("*/down",)),
    (("declare_subscriber",), ("*/up",)),
    (("liveliness_token",), ("base", "*/alive/*")),
    (("declare_liveliness_subscriber", "liveliness_query"), ("*/alive", "*/alive/*")),
    (("declare_queryable", "reply"), ("maps/*",)),
)
_MOST_INSTANCES = 16  # that are remembered: strangers may announce any number
_TOGETHER_S = 2.2  # s: longer than Zenoh remembers a process that died (the lease of a session)


def access_of_base() -> dict[str, Any]:
    """Zenoh's `access_control` of a base."""
    rules: list[dict[str, Any]] = [
        {"id": f"{flow}{i}", "permission": "allow", "flows": [flow], "messages": list(messages),
         "key_exprs": [f"{PREFIX}/{key}" for key in keys]}
        for flow, allowed in (("ingress", _FROM_CLIENTS), ("egress", _TO_CLIENTS))
        for i, (messages, keys) in enumerate(allowed)
    ]  # fmt: skip
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": "all"}],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": ["all"]}],
    }


class Instances:
    """Processes that are there with one number."""

    def __init__(self) -> None:
        self._since_s: dict[str, float] = {}

    def note(self, name: str, *, here: bool) -> None:
        """Note that a process came or went."""
        if here and (name in self._since_s or len(self._since_s) < _MOST_INSTANCES):
            self._since_s.setdefault(name, time.monotonic())
        elif not here:
            self._since_s.pop(name, None)

    @property
    def several(self) -> bool:
        """True if two or more have been there together for so long that none is just being forgotten."""
        since_s = sorted(self._since_s.copy().values())
        return len(since_s) > 1 and time.monotonic() - since_s[1] >= _TOGETHER_S
