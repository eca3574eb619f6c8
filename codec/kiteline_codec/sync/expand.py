"""The items of a packet with codes in place of their shorter forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from kiteline_codec.residuals.predictors import Held
from kiteline_codec.residuals.residual_coding import Tightener
from kiteline_codec.schema import Key
from kiteline_codec.sync import remembered
from kiteline_codec.transport.packet import Item


def grown(items: Sequence[Item], tightener: Tightener, held: Held, legacy: Mapping[Key, bytes]) -> list[Item]:
    """held: version and code of values that both sides hold, beside those of the packet itself. legacy: codes of
    earlier sessions of the peer. Raises WireError where a form builds upon what is not held.
    """
    out: list[Item] = []
    along: dict[Key, tuple[int, bytes]] = {}

    def known(key: Key) -> tuple[int, bytes] | None:
        return along.get(key) or held(key)

    for item in items:
        if item.tight and len(item.data) == remembered.FORM_BYTES:
            before = legacy.get(item.key) or (known(item.key) or (0, None))[1]
            code = remembered.code_of(item.data, before)
            item = replace(item, data=code, total=len(code), tight=False)
        elif item.tight:
            code = tightener.grow(item.key, item.data, known)
            item = replace(item, data=code, total=len(code), tight=False)
        if item.whole:
            along[item.key] = item.version, item.data
        out.append(item)
    return out
