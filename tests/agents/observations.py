"""Observations made by hand."""

from dataclasses import replace
from typing import Any

import numpy as np

from fleet.observation import FIELDS, LONG_S, Layout, Observation

NAMES = (*(field.name for field in FIELDS), "peers", "action_mask")
"""Names of the fields of an observation."""


def observation(
    slots: int,
    *,
    plans: int = 1,
    peers: int = 0,
    arm_index: int = 0,
    legal: Any = 1,
    gives_back: bool = False,
    slack_s: Any = None,
    **fields: Any,
) -> Observation:
    """An observation of one arm with these fields, also `peer_…` [peer, …].

    Without them all slots hold jobs, the arm has a plan of 1 s for each option, difficulties are unknown, the shift has
    no end, and all else is 0.

    Args:
        arm_index: Index of the arm in the fleet.
        legal: Whether each option may be claimed, [option] or one for all.
        slack_s: Of each slot, for `due_in_s`.
    """
    layout = Layout(peers + 1, slots, plans=plans, bids=True)
    mask = np.concatenate([[1], np.broadcast_to(legal, slots * plans), [gives_back]]).astype(np.int8)
    blank = layout.read(np.zeros((peers + 1, layout.size), np.float32), np.tile(mask, (peers + 1, 1)))
    first = Observation(**{name: getattr(blank, name)[arm_index] for name in NAMES})
    base = {
        "left_s": np.array(LONG_S),
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


DRAWN = Layout(5, 6, plans=2, bids=True)
"""Layout of `drawn`."""


def drawn(rng: np.random.Generator) -> Observation:
    """What five arms might know: three free, one at work, one stopped; the jobs of all slots are offered."""
    blank = DRAWN.read(np.zeros((5, DRAWN.size), np.float32), np.zeros((5, DRAWN.actions), np.int8))
    jobs = {
        "group": np.tile(np.arange(1.0, 7.0), (5, 1)),
        "due_in_s": np.tile(rng.uniform(-240.0, 1500.0, 6), (5, 1)),
        "value": np.tile(rng.uniform(0.5, 4.0, 6), (5, 1)),
        "age_s": np.tile(rng.uniform(0.0, 900.0, 6), (5, 1)),
        "payload_kg": np.tile(rng.uniform(0.0, 4.0, 6), (5, 1)),
        "expires": np.tile(rng.integers(2, size=6), (5, 1)),
    }
    options = {
        "duration_s": rng.uniform(60.0, 900.0, (5, 12)),
        "peak_c": rng.uniform(40.0, 80.0, (5, 12)) * (rng.random((5, 12)) < 0.8),
        "difficulty": rng.uniform(0.0, 1.0, (5, 12)),
        "p_saturation": rng.random((5, 12)),
    }
    temp_c = rng.uniform(30.0, 50.0, (5, 7))
    free, working = np.array([1, 1, 1, 0, 0]), np.array([0, 0, 0, 1, 0])
    mask = (rng.random((5, DRAWN.actions)) < 0.8) & (free[:, None] > 0)
    mask[:, 0], mask[:, -1] = True, False
    arms = {
        "temp_c": temp_c,
        "headroom_k": 60.0 - temp_c.max(axis=1),
        "error_headroom_k": 67.0 - temp_c.max(axis=1),
        "working": working,
        "faulted": 1 - free - working,
        "busy_s": 60.0 * working,
        "left_s": np.full(5, rng.uniform(100.0, 5000.0)),
    }
    return replace(blank, **jobs, **options, **arms, action_mask=mask.astype(np.int8))


def of_arms(seen: Observation) -> dict[str, Observation]:
    names = [*(field.name for field in FIELDS), "peers", "action_mask"]
    return {f"arm{a}": Observation(**{name: getattr(seen, name)[a] for name in names}) for a in range(5)}
