"""Discount stale peer messages.

A difficulty describes a job and fades: at an age its weight is exp(−age / fading), both in the fleet's average and in
the peer's distance from that average. So old scores have little influence on an assignment. A state describes a moment
and expires: a peer whose last message is older than `EXPIRY_S` counts as busy, so no job is left to it.
"""

import numpy as np

from fleet.observation import Observation

Array = np.ndarray


FADING_S = 60.0
"""Age at which a difficulty has the weight 1/e."""
EXPIRY_S = 60.0
"""Age from which a peer's state is ignored."""


def fading_weights(observation: Observation) -> Array:
    """Weight of each peer's difficulties, from 0 to 1, [peer]."""
    return np.exp(-observation.peer_age_s.astype(float) / FADING_S)


def free_peers(observation: Observation) -> Array:
    """Peers that are free by their last messages, bool, [peer]."""
    current = (observation.peer_heard > 0) & (observation.peer_age_s < EXPIRY_S)
    return current & (observation.peer_working == 0) & (observation.peer_faulted == 0)


def known_difficulty(observation: Observation) -> Array:
    """This arm's difficulty of each option, [option]; NaN where unknown."""
    return np.where(observation.known > 0, observation.difficulty, np.nan)


def advantage(observation: Observation, place: int, open_slots: Array) -> Array:
    """Least difficulty of each job for each arm relative to the fleet's average, as this arm knows it, [arm, slot].

    Args:
        place: Index of this arm in the fleet.
        open_slots: Slots to compare, bool, [slot]; others are NaN, as are unknown difficulties.
    """
    own = np.fmin.reduce(known_difficulty(observation).reshape(len(observation.offered), -1), axis=1)
    peers = np.where(observation.peer_known > 0, observation.peer_difficulty, np.nan)
    shared = np.insert(peers.astype(float), place, own, axis=0)  # [arm, slot], in the fleet's order
    shared[:, ~open_slots] = np.nan
    weight = np.insert(fading_weights(observation), place, 1.0)[:, None]
    counts = np.where(np.isnan(shared), 0.0, weight)
    total = counts.sum(axis=0)
    average = np.where(np.isnan(shared), 0.0, counts * shared).sum(axis=0) / np.where(total > 0, total, 1.0)
    return weight * (shared - average)
