"""Observations made by hand."""

from dataclasses import replace
from typing import Any

import numpy as np

from fleet.observation import Layout, Observation


def observation(
    slots: int, *, plans: int = 1, peers: int = 0, legal: Any = 1, gives_back: bool = False, **fields: Any
) -> Observation:
    """An observation of one arm with these fields; all others are 0.

    Args:
        legal: Whether each option may be claimed, [option] or one for all.
    """
    layout = Layout(peers + 1, slots, plans=plans)
    mask = np.concatenate([[1], np.broadcast_to(legal, slots * plans), [gives_back]]).astype(np.int8)
    blank = layout.read(np.zeros(layout.size, np.float32), mask)
    return replace(blank, **{name: np.asarray(value) for name, value in fields.items()})
