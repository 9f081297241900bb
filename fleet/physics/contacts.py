"""Contacts between arms, floor, fixtures and payloads, found in recorded postures with MuJoCo."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from copy import copy

import mujoco
import numpy as np

from fleet.events import Event
from fleet.physics.models import payload_bodies, set_payload_balls
from fleet.robot import Robot

Array = np.ndarray
Pair = tuple[int, int]
"""Ids of two geoms, the lower first."""

APART_S = 1.0
"""A contact of two links that were apart for longer than this is a new event."""


class ContactFinder:
    """Finds the contacts of a shift, from one stretch of recorded postures to the next.

    Args:
        model: Of the cell; see `fleet.physics.models.build_cell`. It stays as it is.
        robots: The arms in the order of the model.
    """

    def __init__(self, model: mujoco.MjModel, robots: Sequence[Robot]) -> None:
        self._model = copy(model)
        self._data = mujoco.MjData(self._model)
        self._payloads = payload_bodies(model, robots)
        self._names = [_described(model.geom(g).name) for g in range(model.ngeom)]
        self.reset()

    def reset(self) -> None:
        """Forget all contacts: a new shift begins."""
        self._latest_s: dict[Pair, float] = {}
        """When two geoms were last in contact."""

    def events(self, time_s: Array, q: Array, payload_kg: Array) -> list[Event]:
        """Contacts that begin in a stretch of a shift, each with its greatest depth in this stretch.

        Args:
            time_s: Rising, from the end of the stretch before, [sample].
            q: rad, [sample, arm, joint].
            payload_kg: Payload in the hand of each arm, [sample, arm].

        Returns:
            One event for each pair of links or obstacles and each episode of contact, in order of time. Its arm is the
            first of the two; its value is the depth in mm.
        """
        depth_m: dict[tuple[Pair, float], float] = {}
        """By pair and beginning."""
        began_s: dict[Pair, float] = {}
        regrasped = np.append(True, (np.diff(payload_kg, axis=0) != 0).any(axis=1))
        for i, now_s in enumerate(time_s.tolist()):
            if regrasped[i]:
                set_payload_balls(self._model, self._payloads, payload_kg[i])
            for pair, deep_m in self._in_contact(q[i]).items():
                if now_s - self._latest_s.get(pair, -np.inf) > APART_S:
                    began_s[pair] = now_s
                self._latest_s[pair] = now_s
                if pair in began_s:  # not one that began in an earlier stretch
                    episode = (pair, began_s[pair])
                    depth_m[episode] = max(depth_m.get(episode, 0.0), deep_m)
        return [self._event(pair, at_s, deep_m) for (pair, at_s), deep_m in depth_m.items()]

    def _in_contact(self, q: Array) -> dict[Pair, float]:
        """Depth of the geoms that are inside each other, m, in one posture."""
        model, data = self._model, self._data
        data.qpos[:] = q.ravel()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        depth_m: dict[Pair, float] = {}
        if not data.ncon:
            return depth_m
        for (a, b), distance_m in zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True):
            pair = (min(a, b), max(a, b))
            if distance_m < 0:
                depth_m[pair] = max(depth_m.get(pair, 0.0), -distance_m)
        return depth_m

    def _event(self, pair: Pair, time_s: float, depth_m: float) -> Event:
        (one, arm), (other, other_arm) = (self._names[g] for g in pair)
        if not arm:  # an obstacle; world bodies come first in the model
            one, other, arm = other, one, other_arm
        reason = f"{one} and {other}, {depth_m * 1e3:.1f} mm deep"
        return Event(time_s=time_s, kind="contact", arm=arm, value=depth_m * 1e3, reason=reason)


def _described(geom: str) -> tuple[str, str]:
    """What a geom is in the words of an event, and its arm, if any."""
    owner, _, name = geom.partition("/")
    if not name:
        return f"the {geom}", ""
    return (f"the fixture '{name}'", "") if owner == "fixture" else (f"{name} of {owner}", owner)
