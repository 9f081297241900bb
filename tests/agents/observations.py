"""Observations made by hand."""

from dataclasses import replace
from typing import Any

import numpy as np

from fleet.observation import FIELDS, Layout, Observation

NAMES = (*(field.name for field in FIELDS), "peers", "action_mask")
"""Names of the fields of an observation."""


def observation(
    slots: int,
    *,
    plans: int = 1,
    peers: int = 0,
    place: int = 0,
    legal: Any = 1,
    gives_back: bool = False,
    slack_s: Any = None,
    **fields: Any,
) -> Observation:
    """An observation of one arm with these fields, also `peer_…` [peer, …].

    Without them all slots hold jobs, the arm has a plan of 1 s for each option, difficulties are unknown, and all else
    is 0.

    Args:
        place: Index of the arm in the fleet.
        legal: Whether each option may be claimed, [option] or one for all.
        slack_s: Of each slot, for `due_in_s`.
    """
    layout = Layout(peers + 1, slots, plans=plans)
    mask = np.concatenate([[1], np.broadcast_to(legal, slots * plans), [gives_back]]).astype(np.int8)
    blank = layout.read(np.zeros((peers + 1, layout.size), np.float32), np.tile(mask, (peers + 1, 1)))
    first = Observation(**{name: getattr(blank, name)[place] for name in NAMES})
    base = {
        "group": np.arange(1.0, slots + 1.0),
        "duration_s": np.ones(slots * plans),
        "difficulty": np.full(slots * plans, -1.0),
        "fleet_difficulty": np.full((peers + 1, slots), -1.0),
    }
    received = {name: fields.pop(name) for name in list(fields) if name.startswith("peer_")}
    named = {name: np.asarray(value) for name, value in (base | fields).items()}
    if slack_s is not None:
        named["due_in_s"] = slack_s + named["duration_s"]
    return with_peers(replace(first, **named), **received)


def with_peers(seen: Observation, **fields: Any) -> Observation:
    """The observation with these fields `peer_…` of its peers, [peer, …]."""
    changed: dict[str, np.ndarray] = {}
    for name, values in fields.items():
        own = name.replace("peer_", "fleet_")
        changed[own] = getattr(seen, own).astype(float)
        changed[own][seen.peers] = values
    return replace(seen, **changed)
