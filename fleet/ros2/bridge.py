"""Publishes the arms of a fleet in ROS 2: joint states as they arrive, diagnostics once a second.

It only listens to the fleet, and its memory is bounded, however many names are published.
"""

import logging
import time
from dataclasses import dataclass

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.live.monitor.snapshot import Recent
from fleet.robot import ThermalLimits
from fleet.ros2.cdr import DIAGNOSTICS, JOINT_STATE, type_hash, write_diagnostics, write_joints
from fleet.ros2.conversion import diagnostics_of, joints_of
from fleet.ros2.node import Node, Publisher
from fleet.ros2.topics import NO_HASH, Topic, plain_name

_LOG = logging.getLogger(__name__)

EVERY_S, STALE_S, GONE_S = 1.0, 3.0, 10.0
"""Real seconds: between two diagnostics; without a state until an arm is stale; until it is dropped."""
MAX_ARMS = 1024


@dataclass(eq=False)
class _Arm:
    publisher: Publisher
    state: State
    heard_s: float


class Bridge:
    """`Bridge(link, node).serve(until_s)` in a loop; link and node are open.

    Args:
        limits: Motor temperatures of warnings and errors.
        humble: Publish for ROS 2 Humble, whose keys have no type hashes; later versions do not receive that.

    Attributes:
        skipped: Arms that are not published, and why.
    """

    def __init__(
        self, link: BusClient, node: Node, *, limits: ThermalLimits | None = None, humble: bool = False
    ) -> None:
        self.skipped: dict[str, str] = {}
        self._link, self._node = link, node
        self._limits, self._humble = limits or ThermalLimits(), humble
        self._arms: dict[str, _Arm] = {}
        self._topics: dict[str, str] = {}
        """Arm of each topic: two arms may get the same topic."""
        self._difficulty: Recent[str, DifficultyScores] = Recent(MAX_ARMS)
        self._diagnostics = node.publisher(self._topic("/diagnostics", DIAGNOSTICS))
        self._due_s = time.monotonic()
        link.subscribe(
            keys.of_every_arm(link.fleet, "difficulty"), DifficultyScores, self._receive_difficulty, history=True
        )
        link.subscribe(keys.of_every_arm(link.fleet, "state"), State, self._receive_state)

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the published arms."""
        return tuple(self._arms)

    def serve(self, until_s: float) -> None:
        """Receive and publish until the real second `until_s`."""
        while (now_s := time.monotonic()) < until_s:
            if now_s >= self._due_s:
                self._due_s = now_s + EVERY_S
                self._diagnose(now_s)
            self._link.serve(min(until_s, self._due_s))

    def _receive_state(self, name: str, state: State) -> None:
        try:
            payload = write_joints(joints_of(state))
        except ValueError as error:
            self._skip(name, str(error))
            return
        arm = self._arms.get(name)
        if arm is None:
            publisher = self._publisher(name)
            if publisher is None:
                return
            arm = self._arms[name] = _Arm(publisher, state, 0.0)
        arm.state, arm.heard_s = state, time.monotonic()
        arm.publisher.put(payload)

    def _receive_difficulty(self, name: str, scores: DifficultyScores) -> None:
        self._difficulty[name] = scores

    def _diagnose(self, now_s: float) -> None:
        for name, arm in list(self._arms.items()):
            age_s = now_s - arm.heard_s
            if age_s > GONE_S:
                self._forget(name)
                continue
            scores = self._difficulty.get(name)
            statuses = diagnostics_of(self._link.fleet, arm.state, scores, self._limits, age_s, STALE_S)
            self._diagnostics.put(write_diagnostics(arm.state.time_s, statuses))

    def _publisher(self, name: str) -> Publisher | None:
        topic = self._topic(f"/{plain_name(self._link.fleet)}/{plain_name(name)}/joint_states", JOINT_STATE)
        owner = self._topics.setdefault(topic.name, name)
        if owner != name:
            self._skip(name, f"its topic {topic.name} is that of '{owner}'; ROS 2 allows fewer characters.")
            return None
        if len(self._arms) >= MAX_ARMS:
            del self._topics[topic.name]
            self._skip(name, f"{MAX_ARMS} arms are published already.")
            return None
        self.skipped.pop(name, None)
        return self._node.publisher(topic)

    def _forget(self, name: str) -> None:
        self._arms.pop(name).publisher.close()
        self._difficulty.pop(name, None)
        self._topics = {topic: owner for topic, owner in self._topics.items() if owner != name}

    def _skip(self, name: str, reason: str) -> None:
        if name not in self.skipped and len(self.skipped) < MAX_ARMS:
            self.skipped[name] = reason
            _LOG.warning("Arm '%s' is not published: %s", name, reason)

    def _topic(self, name: str, kind: str) -> Topic:
        return Topic(name, kind, NO_HASH if self._humble else type_hash(kind), self._node.domain)
