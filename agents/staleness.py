"""Discount stale peer messages.

A difficulty describes a job and fades: at an age its weight is exp(−age / fading), both in the fleet's average and in
the peer's distance from that average. So old scores have little influence on an assignment. A state describes a moment
and expires: a peer whose last message is older than `EXPIRY_S` counts as busy, so no job is left to it. A bid
describes a job at a moment: it counts as long as the state does.
"""

import numpy as np

from fleet.observation import FIELDS, LazyObservation, Observation

Array = np.ndarray


FADING_S = 60.0
"""Age at which a difficulty has the weight 1/e."""
EXPIRY_S = 60.0
"""Age from which a peer's state is ignored."""


def fading_weights(observation: Observation) -> Array:
    """Weight of each peer's difficulties, from 0 to 1, [..., peer]."""
    return np.exp(-observation.peer_age_s.astype(float) / FADING_S)


def current_peers(observation: Observation) -> Array:
    """Peers with a message that is not too old, bool, [..., peer]."""
    return (observation.peer_heard > 0) & (observation.peer_age_s < EXPIRY_S)


def free_peers(observation: Observation) -> Array:
    """Peers that are free by their last messages, bool, [..., peer]."""
    return current_peers(observation) & (observation.peer_working == 0) & (observation.peer_faulted == 0)


def known_difficulty(observation: Observation) -> Array:
    """An arm's difficulty of each option, [..., option]; NaN where unknown."""
    return np.where(observation.known > 0, observation.difficulty, np.nan)


def in_fleet(peers: Array, arm_index: Array | int, own: Array | float) -> Array:
    """Values of the peers of an arm, [..., peer], with its own, [...], in the fleet's order, [..., arm].

    Args:
        arm_index: Index of the arm in the fleet, int [...].
    """
    arm = np.arange(peers.shape[-1] + 1)
    arm_index = np.minimum(np.asarray(arm_index), peers.shape[-1])[..., None]
    everyone = np.concatenate([peers, np.broadcast_to(own, peers.shape[:-1])[..., None]], axis=-1)
    order = np.where(arm == arm_index, len(arm) - 1, arm - (arm > arm_index))
    return np.take_along_axis(everyone, np.broadcast_to(order, everyone.shape), axis=-1)


def fleet_as_shared(own: Observation, arm_index: Array) -> Observation:
    """What an arm knows of itself and of its peers, as if all these were observations of a fleet, [n, arm].

    A peer that should be home by now counts as free, and one that is free may claim what it has a plan for, if the
    stations are free. All motors of a peer have the temperature of its hottest one. Its space and its current job are
    unknown. A peer whose last message is missing or too old has no plan. `fleet_age_s` is the age of the messages.

    Args:
        own: Observations of arms, [n].
        arm_index: Indices of the arms in the fleet, int [n].
    """
    arms, plans = own.peers.shape[-1] + 1, own.duration_s.shape[-1] // own.group.shape[-1]
    mine = (np.arange(arms) == np.minimum(arm_index, arms - 1)[:, None])[..., None]  # [n, arm, 1]

    def each_arm(peers: Array, value: Array | float) -> Array:
        return in_fleet(peers, arm_index, value)

    def bids(peers: Array, value: Array) -> Array:
        return np.swapaxes(in_fleet(np.swapaxes(peers, -1, -2), arm_index[:, None], value), -1, -2)  # [n, arm, option]

    left_s = np.where(own.peer_working > 0, np.maximum(own.peer_busy_s - own.peer_age_s, 0.0), 0.0)
    working, faulted = each_arm(left_s > 0, own.working > 0), each_arm(own.peer_faulted > 0, own.faulted > 0)
    headroom_k = each_arm(own.peer_headroom_k, own.headroom_k)
    limit_c = own.temp_c.max(axis=-1) + own.headroom_k
    duration_s = bids(np.where(current_peers(own)[..., None], own.peer_duration_s, 0.0), own.duration_s)
    can = (duration_s > 0) & ~(working | faulted)[..., None] & np.repeat(own.station_free > 0, plans, axis=-1)[:, None]
    legal = np.where(mine, own.action_mask[:, None, 1:-1], can)
    fields = {
        "working": working,
        "faulted": faulted,
        "busy_s": each_arm(left_s, own.busy_s),
        "headroom_k": headroom_k,
        "error_headroom_k": headroom_k + (own.error_headroom_k - own.headroom_k)[:, None],
        "temp_c": np.where(mine, own.temp_c[:, None], (limit_c[:, None] - headroom_k)[..., None]),
        "duration_s": duration_s,
        "peak_c": bids(own.peer_peak_c, own.peak_c),
        "p_saturation": bids(own.peer_p_saturation, own.p_saturation),
        "difficulty": bids(np.repeat(own.peer_difficulty, plans, axis=-1), own.difficulty),
        "fleet_age_s": np.repeat(each_arm(own.peer_age_s, 0.0)[:, None], arms, axis=1),
        "action_mask": np.pad(legal, ((0, 0), (0, 0), (1, 1)), constant_values=((0, 0), (0, 0), (1, 0))),
    }
    jobs = {field.name for field in FIELDS if field.part == "jobs"}

    def read(name: str) -> Array:
        if name not in jobs:
            raise AttributeError(f"'{name}' of a peer is unknown: it is not shared.")
        value = getattr(own, name)[:, None]
        return np.broadcast_to(value, (len(value), arms, *value.shape[2:]))

    return LazyObservation(read, **fields)


def advantage(observation: Observation, arm_index: Array | int, open_slots: Array) -> Array:
    """Least difficulty of each job for each arm relative to the fleet's average, as one arm knows it, [..., arm, slot].

    Args:
        arm_index: Index of this arm in the fleet, int [...].
        open_slots: Slots to compare, bool, [..., slot]; others are NaN, as are unknown difficulties.
    """
    slots, arm_index = observation.offered.shape[-1], np.asarray(arm_index)
    difficulty = known_difficulty(observation)
    own = np.fmin.reduce(difficulty.reshape(*difficulty.shape[:-1], slots, -1), axis=-1)
    peers = np.where(observation.peer_known > 0, observation.peer_difficulty.astype(float), np.nan)
    shared = in_fleet(np.swapaxes(peers, -1, -2), arm_index[..., None], own)  # [..., slot, arm]
    shared = np.where(open_slots[..., None], shared, np.nan)
    weight = in_fleet(fading_weights(observation), arm_index, 1.0)[..., None, :]
    unknown = np.isnan(shared)
    counts = np.where(unknown, 0.0, weight)
    total = counts.sum(axis=-1, keepdims=True)
    average = np.where(unknown, 0.0, counts * shared).sum(axis=-1, keepdims=True) / np.where(total > 0, total, 1.0)
    return np.swapaxes(weight * (shared - average), -1, -2)
