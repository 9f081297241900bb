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
    """Weight of each peer's difficulties, from 0 to 1, [..., peer]."""
    return np.exp(-observation.peer_age_s.astype(float) / FADING_S)


def free_peers(observation: Observation) -> Array:
    """Peers that are free by their last messages, bool, [..., peer]."""
    current = (observation.peer_heard > 0) & (observation.peer_age_s < EXPIRY_S)
    return current & (observation.peer_working == 0) & (observation.peer_faulted == 0)


def known_difficulty(observation: Observation) -> Array:
    """An arm's difficulty of each option, [..., option]; NaN where unknown."""
    return np.where(observation.known > 0, observation.difficulty, np.nan)


def in_fleet(peers: Array, place: Array | int, own: Array | float) -> Array:
    """Values of the peers of an arm, [..., peer], with its own, [...], in the fleet's order, [..., arm].

    Args:
        place: Index of the arm in the fleet, int [...].
    """
    arm = np.arange(peers.shape[-1] + 1)
    place = np.minimum(np.asarray(place), peers.shape[-1])[..., None]
    everyone = np.concatenate([peers, np.broadcast_to(own, peers.shape[:-1])[..., None]], axis=-1)
    order = np.where(arm == place, len(arm) - 1, arm - (arm > place))
    return np.take_along_axis(everyone, np.broadcast_to(order, everyone.shape), axis=-1)


def advantage(observation: Observation, place: Array | int, open_slots: Array) -> Array:
    """Least difficulty of each job for each arm relative to the fleet's average, as one arm knows it, [..., arm, slot].

    Args:
        place: Index of this arm in the fleet, int [...].
        open_slots: Slots to compare, bool, [..., slot]; others are NaN, as are unknown difficulties.
    """
    slots, place = observation.offered.shape[-1], np.asarray(place)
    difficulty = known_difficulty(observation)
    own = np.fmin.reduce(difficulty.reshape(*difficulty.shape[:-1], slots, -1), axis=-1)
    peers = np.where(observation.peer_known > 0, observation.peer_difficulty.astype(float), np.nan)
    shared = in_fleet(np.swapaxes(peers, -1, -2), place[..., None], own)  # [..., slot, arm]
    shared = np.where(open_slots[..., None], shared, np.nan)
    weight = in_fleet(fading_weights(observation), place, 1.0)[..., None, :]
    unknown = np.isnan(shared)
    counts = np.where(unknown, 0.0, weight)
    total = counts.sum(axis=-1, keepdims=True)
    average = np.where(unknown, 0.0, counts * shared).sum(axis=-1, keepdims=True) / np.where(total > 0, total, 1.0)
    return np.swapaxes(weight * (shared - average), -1, -2)
