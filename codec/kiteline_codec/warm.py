"""Compile all kernels of the codec before the first packet, by coding one section there and back."""

from __future__ import annotations

import numpy as np

from kiteline_codec import messages
from kiteline_codec.schema import Births
from kiteline_core.ids import keyframe_id, submap_id


def warm() -> None:
    """Run every kernel once, on the types that flights use."""
    n = 20
    births = Births(
        keyframe_id(submap_id(0, 0, 0), 0),
        0,
        np.arange(n, dtype=np.uint16),
        np.linspace(10.0, 400.0, 2 * n, dtype=np.float32).reshape(n, 2),
        np.linspace(0.1, 1.0, n, dtype=np.float32),
        np.zeros(n, np.uint8),
        np.zeros(n, np.uint8),
        np.zeros((n, 32), np.uint8),
    )
    messages.decode(messages.key(births), messages.encode(births))
