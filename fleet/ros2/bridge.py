"""Tells ROS 2 how the arms of a fleet are: their joint states as they come, their diagnostics once a second.

It takes no part in the fleet. However many names somebody invents, what is remembered is bounded.
"""

import logging
import time
from dataclasses import dataclass

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.robot import ThermalLimits
from fleet.ros2.cdr import DIAGNOSTICS, JOINT_STATE, type_hash, write_diagnostics, write_joints
from fleet.ros2.conversion import diagnostics_of, joints_of
from fleet.ros2.node import Node, Publisher
from fleet.ros2.topics import NO_HASH, Topic, plain_name

_LOG = logging.getLogger(__name__)

EVERY_S, STALE_S, GONE_S = 1.0, 3.0, 10.0
"""Real seconds: between two diagnostics; of silence after which an arm is stale there; after which it is left out."""
MOST_ARMS = 1024


@dataclass(eq=False)
class _Arm:
    publisher: Publisher
    state: State
    heard_s: float


class Bridge:
    """`Bridge(link, node).serve(until_s)` in a loop, both open.

    Attributes:
        left_out: Why arms are not told of, by name.
    """

    def __init__(
        self, link: BusClient, node: Node, *, limits: ThermalLimits | None = None, humble: bool = False
    ) -> None:
        """Listen to the fleet.

        Args:
            limits: At which motor temperature a diagnostic warns and is an error.
            humble: Say it to ROS 2 Humble, whose keys hold no type hashes; later versions do not hear that.
        """
        self.left_out: dict[str, str] = {}
        self._link, self._node = link, node
        self._limits, self._humble = limits or ThermalLimits(), humble
        self._arms: dict[str, _Arm] = {}
        self._topics: dict[str, str] = {}
        """Arm by topic: two names may become the same in ROS 2."""
        self._difficulty: dict[str, DifficultyScores] = {}
        self._diagnostics = node.publisher(self._topic("/diagnostics", DIAGNOSTICS))
        self._due_s = time.monotonic()
        link.subscribe(keys.of_every_arm(link.fleet, "difficulty"), DifficultyScores, self._scored, history=True)
        link.subscribe(keys.of_every_arm(link.fleet, "state"), State, self._moved)

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of those it tells of."""
        return tuple(self._arms)

    def serve(self, until_s: float) -> None:
        """Hear and tell until the real second `until_s`."""
        while (now_s := time.monotonic()) < until_s:
            if now_s >= self._due_s:
                self._due_s = now_s + EVERY_S
                self._diagnose(now_s)
            self._link.serve(min(until_s, self._due_s))

    def _moved(self, name: str, state: State) -> None:
        try:
            payload = write_joints(joints_of(state))
        except ValueError as error:
            self._leave_out(name, str(error))
            return
        arm = self._arms.get(name)
        if arm is None:
            publisher = self._new(name)
            if publisher is None:
                return
            arm = self._arms[name] = _Arm(publisher, state, 0.0)
        arm.state, arm.heard_s = state, time.monotonic()
        arm.publisher.put(payload)

    def _scored(self, name: str, word: DifficultyScores) -> None:
        if name not in self._difficulty and len(self._difficulty) >= MOST_ARMS:
            del self._difficulty[next(iter(self._difficulty))]
        self._difficulty[name] = word

    def _diagnose(self, now_s: float) -> None:
        for name, arm in list(self._arms.items()):
            age_s = now_s - arm.heard_s
            if age_s > GONE_S:
                self._forget(name)
                continue
            told = diagnostics_of(self._link.fleet, arm.state, self._difficulty.get(name), self._limits, age_s, STALE_S)
            self._diagnostics.put(write_diagnostics(arm.state.time_s, told))

    def _new(self, name: str) -> Publisher | None:
        topic = self._topic(f"/{plain_name(self._link.fleet)}/{plain_name(name)}/joint_states", JOINT_STATE)
        owner = self._topics.setdefault(topic.name, name)
        if owner != name:
            self._leave_out(name, f"its topic {topic.name} is that of '{owner}'; ROS 2 allows fewer characters.")
            return None
        if len(self._arms) >= MOST_ARMS:
            del self._topics[topic.name]
            self._leave_out(name, f"{MOST_ARMS} arms are told of already.")
            return None
        self.left_out.pop(name, None)
        return self._node.publisher(topic)

    def _forget(self, name: str) -> None:
        self._arms.pop(name).publisher.close()
        self._difficulty.pop(name, None)
        self._topics = {topic: owner for topic, owner in self._topics.items() if owner != name}

    def _leave_out(self, name: str, reason: str) -> None:
        if name not in self.left_out and len(self.left_out) < MOST_ARMS:
            self.left_out[name] = reason
            _LOG.warning("'%s' is left out: %s", name, reason)

    def _topic(self, name: str, kind: str) -> Topic:
        return Topic(name, kind, NO_HASH if self._humble else type_hash(kind), self._node.domain)
