"""A real arm that speaks ROS 2, as an arm of the fleet: it says how it is, and takes no work.

`Reality` is what is known of it (messages and time in, words out); `Follower` puts it on the bus.
"""

import logging
import math
import time
from collections.abc import Mapping

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Ack, Award, Clock, ClockRequest, JobEstimate, Quote, QuoteRequest
from fleet.bus.protocol.messages import Info, MalformedMessage, State
from fleet.errors import BusError, Refused
from fleet.live.clock import FleetClock
from fleet.robot import ThermalLimits
from fleet.ros2.cdr import DIAGNOSTICS, JOINT_STATE, read_diagnostics, read_joints, type_hash
from fleet.ros2.conversion import Joints, in_order, temperatures
from fleet.ros2.node import Node
from fleet.ros2.topics import NO_HASH, Topic
from fleet.telemetry import Mode

_LOG = logging.getLogger(__name__)

FRESH_S, WARM_S = 2.0, 10.0
"""Real seconds after which joints are too old to be said again, and temperatures too old to be said at all."""
MOVING_RAD_S = 0.01
"""A joint that is faster is at work."""
TOLD_S, CLOCK_S, ANSWER_S = 10.0, 30.0, 2.0
"""Real seconds: between two complaints; between two looks at the fleet's clock; for an answer."""


class Reality:
    """What is known of one real arm."""

    def __init__(self, names: tuple[str, ...], hardware: str = "") -> None:
        """Nothing is known yet.

        Args:
            names: Of its joints in ROS 2, from joint 1 on.
            hardware: What stands before them in the `hardware_id` of its diagnostics.
        """
        self.names, self.hardware = names, hardware
        self._joints: Joints | None = None
        self._joints_s = -math.inf
        self._moving = False
        self._temp: dict[str, tuple[float, float]] = {}
        """°C and the real second of its reading, by joint."""

    def joints(self, said: Joints, real_s: float) -> None:
        """A JointState came.

        Raises:
            MalformedMessage: it is no reading of this arm.
        """
        found = in_order(said, self.names)
        if found is None:
            return
        self._moving = _fastest(found, self._joints) > MOVING_RAD_S
        self._joints, self._joints_s = found, real_s

    def warmth(self, temp_c: Mapping[str, float], real_s: float) -> None:
        """Temperatures came, °C by joint."""
        self._temp.update({name: (value, real_s) for name, value in temp_c.items()})

    def missing(self, real_s: float) -> str:
        """What must be known before it can be said how the arm is; "" for nothing."""
        if real_s - self._joints_s > FRESH_S:
            return "no joint state of it"
        old = [name for name in self.names if real_s - self._temp.get(name, (0.0, -math.inf))[1] > WARM_S]
        return f"no temperature of {', '.join(old)}" if old else ""

    def state(self, arm: str, tick: int, time_s: float, real_s: float, warning_c: float) -> State | None:
        """How it is now; None while something is missing, for nothing is made up."""
        if self._joints is None or self.missing(real_s):
            return None
        temp_c = tuple(self._temp[name][0] for name in self.names)
        mode: Mode = "working" if self._moving else "idle"
        q, qd, tau = self._joints.q, self._joints.qd, self._joints.tau
        return State(arm, tick, time_s, mode, temp_c, warning_c - max(temp_c), q=q, qd=qd, tau=tau)


def _fastest(now: Joints, before: Joints | None) -> float:
    """Speed of the fastest joint, rad/s; from two positions where no velocity is measured."""
    if now.qd:
        return max(map(abs, now.qd))
    if before is None or not now.q or not before.q or now.time_s <= before.time_s:
        return 0.0
    return max(abs(a - b) for a, b in zip(now.q, before.q, strict=True)) / (now.time_s - before.time_s)


class Follower:
    """`Follower(...).serve(until_s)` in a loop, link and node open."""

    def __init__(
        self,
        link: BusClient,
        node: Node,
        arm: str,
        reality: Reality,
        topics: tuple[str, str],
        clock: FleetClock,
        *,
        limits: ThermalLimits | None = None,
        rate_hz: float = 10.0,
    ) -> None:
        """Listen to the arm, and be there for the fleet.

        Args:
            arm: Its name in the fleet.
            topics: Of its joint states and of the diagnostics that tell its motor temperatures.
            clock: The fleet's time at its speed of 1.
        """
        self._link, self._arm, self._reality, self._clock = link, arm, reality, clock
        self._warning_c = (limits or ThermalLimits()).warning_c
        self._period_s, self._tick = 1.0 / rate_hz, 0
        self._due_s = self._told_s = time.monotonic()
        self._clock_s, self._clock_known = -math.inf, False
        self._joint_topic, self._warm_topic = (
            Topic(name, kind, type_hash(kind), node.domain)
            for name, kind in zip(topics, (JOINT_STATE, DIAGNOSTICS), strict=True)
        )
        self.malformed = 0
        self._declare()
        node.listen(self._warm_topic, lambda *said: link.post(lambda: self._hear(self._warm_topic, *said)))
        node.listen(self._joint_topic, lambda *said: link.post(lambda: self._hear(self._joint_topic, *said)))

    def serve(self, until_s: float) -> None:
        """Hear the arm and say how it is, until the real second `until_s`."""
        while (now_s := time.monotonic()) < until_s:
            if now_s >= self._due_s:
                self._due_s = max(self._due_s + self._period_s, now_s)
                self._say(now_s)
                self._look_at_clock(now_s)
            self._link.serve(min(until_s, self._due_s))

    def _declare(self) -> None:
        link, name = self._link, self._arm
        self._say_state = link.publisher(keys.of_arm(link.fleet, name, "state"), State)
        info = link.publisher(keys.of_arm(link.fleet, name, "info"), Info)
        info(Info(name, len(self._reality.names), self._twin))
        link.reply_to(keys.of_arm(link.fleet, name, "quote"), QuoteRequest, self._quote)
        link.reply_to(keys.of_arm(link.fleet, name, "award"), Award, self._refuse)
        link.declare_token(keys.of_arm(link.fleet, name, "alive"))

    @property
    def _twin(self) -> str:
        return f"ros2 {self._joint_topic.name}"

    @property
    def _reason(self) -> str:
        return f"this arm is a real one that speaks under {self._joint_topic.name}, and takes no work"

    def _hear(self, topic: Topic, said_hash: str, payload: bytes) -> None:
        now_s = time.monotonic()
        try:
            if said_hash not in (topic.hash, NO_HASH):
                raise MalformedMessage(f"It has another {topic.kind} than ours: {said_hash}.")
            if topic is self._joint_topic:
                self._reality.joints(read_joints(payload), now_s)
            else:
                found = temperatures(read_diagnostics(payload), self._reality.names, self._reality.hardware)
                self._reality.warmth(found, now_s)
        except MalformedMessage as error:
            self.malformed += 1
            if self.malformed & (self.malformed - 1) == 0:  # 1, 2, 4, 8, …
                _LOG.warning("Left out (%d so far): under %s: %s", self.malformed, topic.name, error)

    def _say(self, now_s: float) -> None:
        self._tick += 1
        state = self._state(now_s)
        if state is not None:
            self._say_state(state)
        elif now_s >= self._told_s + TOLD_S:
            self._told_s = now_s
            _LOG.warning("Arm '%s' says nothing: there is %s.", self._arm, self._reality.missing(now_s))

    def _state(self, now_s: float) -> State | None:
        return self._reality.state(self._arm, self._tick, self._clock.now_s(now_s), now_s, self._warning_c)

    def _quote(self, request: QuoteRequest) -> Quote:
        state = self._state(time.monotonic())
        if state is None:
            raise Refused(f"There is {self._reality.missing(time.monotonic())}.")
        offers = tuple(JobEstimate(job.name, feasible=False, reason=self._reason) for job in request.jobs)
        return Quote(
            arm=self._arm, auction=request.auction, quote="", valid_s=0.0, twin=self._twin, time_s=state.time_s,
            mode=state.mode, headroom_k=state.headroom_k, capacity=0, estimates=offers,
        )  # fmt: skip

    def _refuse(self, award: Award) -> Ack:
        return Ack(self._arm, award.award, False, self._reason)

    def _look_at_clock(self, now_s: float) -> None:
        if now_s < self._clock_s + (CLOCK_S if self._clock_known else ANSWER_S):
            return
        self._clock_s = now_s

        def done(answers: Replies[Clock]) -> None:
            for said in answers.messages.values():
                self._set_clock(said, now_s)
                return

        try:
            self._link.query(keys.of_clock(self._link.fleet), ClockRequest(), Clock, done, timeout_s=ANSWER_S)
        except BusError as error:
            _LOG.warning("%s", error)

    def _set_clock(self, said: Clock, asked_s: float) -> None:
        """The fleet's time, at once the first time, little by little after that."""
        if said.speed != 1.0:
            raise BusError(
                f"The fleet '{self._link.fleet}' runs {said.speed:g} times as fast as a real arm: it needs 1."
            )
        set_to = self._clock.slewed_to if self._clock_known else self._clock.set_to
        self._clock, self._clock_known = set_to(asked_s, time.monotonic(), said.time_s), True
