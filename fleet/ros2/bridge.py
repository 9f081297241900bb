"""The arms of a fleet in ROS 2, and a real arm with a ROS 2 driver in a fleet.

`Bridge` publishes joint states as they arrive, and diagnostics once a second; it only listens to the fleet, and its
memory is bounded, however many names are published. `Follower` publishes the state of a real arm, which takes no jobs;
`ArmReadings` holds the arm's last readings (messages and time in, states out).
"""

import logging
import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Ack, Award, JobEstimate, Quote, QuoteRequest
from fleet.bus.protocol.messages import DifficultyScores, Info, MalformedMessage, State
from fleet.errors import BusError, RefusedForNow
from fleet.live.arm.body import MotionMonitor
from fleet.live.arm.node import ClockSync
from fleet.live.clock import FleetClock
from fleet.live.monitor.snapshot import Recent
from fleet.live.rate_limit import WARNING_S, RateLimitedWarnings
from fleet.readings import BAD_SENSOR, TemperatureFilter
from fleet.robot import ThermalLimits, half_turn
from fleet.ros2.cdr import (
    DIAGNOSTICS,
    JOINT_STATE,
    read_diagnostics,
    read_joints,
    type_hash,
    write_diagnostics,
    write_joints,
)
from fleet.ros2.conversion import Joints, diagnostics_of, in_order, joints_of, plain_name, temperatures
from fleet.ros2.node import NO_HASH, Node, Publisher, Topic

_LOG = logging.getLogger(__name__)

EVERY_S, STALE_S, GONE_S = 1.0, 3.0, 10.0
"""Real seconds: between two diagnostics; without a state until an arm is stale; until it is dropped."""
MAX_ARMS = 1024
FRESH_S, WARM_S = 2.0, 10.0
"""Real seconds for which joint states and temperatures are valid."""
MOVING_RAD_S = 0.01
"""The arm is working when a joint is faster than this."""
WINDOW_S, MAX_RECENT = 1.0, 1000
"""Real seconds over which a speed is measured by positions, and most messages in them."""


@dataclass(eq=False)
class _PublishedArm:
    publisher: Publisher
    state: State
    received_s: float


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
        self._arms: dict[str, _PublishedArm] = {}
        self._topics: dict[str, str] = {}
        """Arm of each topic: two arms may get the same topic."""
        self._difficulty: Recent[str, DifficultyScores] = Recent(MAX_ARMS)
        self._diagnostics = node.publisher(self._topic("/diagnostics", DIAGNOSTICS))
        self._due_s = time.monotonic()
        link.subscribe(
            keys.of_every_arm(link.fleet, "difficulty"), DifficultyScores, self._difficulty.__setitem__, history=True
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
            arm = self._arms[name] = _PublishedArm(publisher, state, 0.0)
        arm.state, arm.received_s = state, time.monotonic()
        arm.publisher.put(payload)

    def _diagnose(self, now_s: float) -> None:
        for name, arm in list(self._arms.items()):
            age_s = now_s - arm.received_s
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


class ArmReadings:
    """Last readings of one real arm.

    Args:
        names: Names of its joints in ROS 2, from joint 1 on.
        hardware: Text before them in the `hardware_id` of its diagnostics.
    """

    def __init__(self, names: tuple[str, ...], hardware: str = "") -> None:
        self.names, self.hardware = names, hardware
        self.sensors = TemperatureFilter()
        self._joints: Joints | None = None
        self._joints_s = -math.inf
        self._recent: deque[tuple[Joints, float]] = deque(maxlen=MAX_RECENT)
        """Joint states of the last `WINDOW_S`, and the real second of each."""
        self._temp: dict[str, tuple[float, float]] = {}
        """°C and the real second of its reading, by joint."""

    def update_joints(self, joints: Joints, real_s: float) -> None:
        """Apply a JointState; one of other joints only is ignored.

        Raises:
            MalformedMessage: it is no reading of this arm.
        """
        now = in_order(joints, self.names)
        if now is not None:
            self._recent.append((now, real_s))
            while len(self._recent) > 2 and real_s - self._recent[1][1] >= WINDOW_S:
                self._recent.popleft()
            self._joints, self._joints_s = now, real_s

    def update_temperatures(self, temp_c: Mapping[str, float], real_s: float) -> None:
        """Apply temperatures, °C by joint."""
        self.sensors.update(real_s, {self.names.index(name): value for name, value in temp_c.items()})
        self._temp.update({name: (value, real_s) for name, value in temp_c.items()})

    def missing(self, real_s: float) -> str:
        """Readings that are missing or too old for a state; "" for none."""
        if real_s - self._joints_s > FRESH_S:
            return "no joint state"
        old = [name for name in self.names if real_s - self._temp.get(name, (0.0, -math.inf))[1] > WARM_S]
        return f"no temperature of {', '.join(old)}" if old else ""

    def state(self, arm: str, tick: int, time_s: float, real_s: float, warning_c: float) -> State | None:
        """State of the arm now; None while a reading is missing. Its headroom is by the possible temperatures only."""
        if self._joints is None or self.missing(real_s):
            return None
        temp_c = tuple(self._temp[name][0] for name in self.names)
        q, qd, tau = self._joints.q, self._joints.qd, self._joints.tau
        mode = "working" if _fastest(self._recent) > MOVING_RAD_S else "idle"
        hottest_c = max(self.sensors.temp_c.values(), default=warning_c)
        return State(arm, tick, time_s, mode, temp_c, warning_c - hottest_c, q=q, qd=qd, tau=tau)


def _fastest(recent: Sequence[tuple[Joints, float]]) -> float:
    """Speed of the fastest joint, rad/s; by position where no velocity is measured.

    By position it is the change between the means of both halves, which takes the noise out: 2 mrad at 10 Hz would be
    0.03 rad/s from one message to the next. Without stamps that increase, time is that of arrival.
    """
    now = recent[-1][0]
    if now.qd:
        return max(map(abs, now.qd))
    if len(recent) < 2:
        return 0.0
    stamps = np.array([joints.time_s for joints, _ in recent])
    at_s = stamps if (np.diff(stamps) > 0).all() else np.array([real_s for _, real_s in recent])
    q = np.array([joints.q for joints, _ in recent])
    q = half_turn(q - q[0])  # a joint without stops may be written in any turn
    half = len(q) // 2
    apart_s = max(at_s[-half:].mean() - at_s[:half].mean(), WINDOW_S / 2)
    return float(np.abs(q[-half:].mean(axis=0) - q[:half].mean(axis=0)).max() / apart_s)


class Follower:
    """`Follower(...).serve(until_s)` in a loop; link and node are open.

    Args:
        arm: Its name in the fleet.
        topics: Topics of its joint states, and of the diagnostics with its motor temperatures.
        clock: Fleet time, at a speed of 1.
        monitor: Gets the readings of every state with positions, velocities and torques.

    Raises:
        BusError: the speed of the fleet is not 1; before it publishes anything.
    """

    def __init__(
        self,
        link: BusClient,
        node: Node,
        arm: str,
        readings: ArmReadings,
        topics: tuple[str, str],
        clock: FleetClock,
        *,
        limits: ThermalLimits | None = None,
        rate_hz: float = 10.0,
        monitor: MotionMonitor | None = None,
    ) -> None:
        self._link, self._arm, self._readings = link, arm, readings
        self._set_clock(clock, jump=True)
        self._warning_c = (limits or ThermalLimits()).warning_c
        self._period_s, self._tick, self._due_s = 1.0 / rate_hz, 0, time.monotonic()
        self._monitor = monitor
        self._warn, self._warn_from_s = RateLimitedWarnings(arm), time.monotonic() + WARNING_S
        self._sync = ClockSync(link, lambda: self._clock, self._set_clock, self._warn)
        self._twin = f"ros2 {topics[0]}" if monitor is None else monitor.version
        self._refusal = f"this arm is a real one that publishes under {topics[0]}, and takes no work"
        self._publish_state = link.publisher(keys.of_arm(link.fleet, arm, "state"), State)
        self._publish_info = link.publisher(keys.of_arm(link.fleet, arm, "info"), Info)  # holds the last one
        self._publish_info(Info(arm, len(readings.names), self._twin))
        link.reply_to(keys.of_arm(link.fleet, arm, "quote"), QuoteRequest, self._quote)
        link.reply_to(keys.of_arm(link.fleet, arm, "award"), Award, self._refuse)
        link.declare_token(keys.of_arm(link.fleet, arm, "alive"))
        for name, kind in zip(topics, (JOINT_STATE, DIAGNOSTICS), strict=True):
            topic = Topic(name, kind, type_hash(kind), node.domain)
            node.listen(topic, lambda kind, message, topic=topic: link.post(self._receive, topic, kind, message))

    def serve(self, until_s: float) -> None:
        """Read the arm's messages and publish its state, until the real second `until_s`."""
        while (now_s := time.monotonic()) < until_s:
            if now_s >= self._due_s:
                self._due_s = max(self._due_s + self._period_s, now_s)
                self._send_state(now_s)
                self._sync.step(now_s)
            self._link.serve(min(until_s, self._due_s))

    def _receive(self, topic: Topic, sent_hash: str, payload: bytes) -> None:
        now_s = time.monotonic()
        try:
            if sent_hash not in (topic.hash, NO_HASH):
                raise MalformedMessage(f"The hash of its {topic.kind} is {sent_hash}, not {topic.hash}.")
            if topic.kind == JOINT_STATE:
                self._readings.update_joints(read_joints(payload), now_s)
            else:
                statuses = read_diagnostics(payload)
                temp_c, faults = temperatures(statuses, self._readings.names, self._readings.hardware)
                for fault in faults:
                    self._link.reject(f"of {topic.name}", fault)
                self._readings.update_temperatures(temp_c, now_s)
                for sentence in self._readings.sensors.bad.values():
                    self._warn(f"sensor of {sentence[:7]}", f"has an impossible temperature: {sentence}; {BAD_SENSOR}.")
        except MalformedMessage as error:
            self._link.reject(f"of {topic.name}", error)

    def _send_state(self, now_s: float) -> None:
        state = self._state(now_s)
        if state is None and now_s >= self._warn_from_s:
            self._warn("state", f"publishes no state: there is {self._readings.missing(now_s)}.")
        if state is not None:
            self._tick = state.tick
            self._publish_state(self._with_scores(state, now_s))

    def _state(self, now_s: float) -> State | None:
        """The next state: only published ones count, as receivers take a gap in the ticks for lost states."""
        return self._readings.state(self._arm, self._tick + 1, self._clock.now_s(now_s), now_s, self._warning_c)

    def _with_scores(self, state: State, now_s: float) -> State:
        """The state with what the monitor makes of the arm's motion, if the arm reports all that it needs."""
        if self._monitor is None or not (state.q and state.qd and state.tau):
            return state
        time_s, temp_c, q, qd, tau = (np.array([v]) for v in (now_s, state.temp_c, state.q, state.qd, state.tau))
        self._monitor.add(time_s, temp_c, q, qd, tau)
        difficulty, expected_c = self._monitor.scores
        return msgspec.structs.replace(state, motion_difficulty=difficulty, expected_c=expected_c)

    def _quote(self, request: QuoteRequest) -> Quote:
        now_s = time.monotonic()
        state = self._state(now_s)
        if state is None:
            raise RefusedForNow(f"There is {self._readings.missing(now_s)}.")
        estimates = tuple(JobEstimate(job.name, reason=self._refusal) for job in request.jobs)
        return Quote(
            arm=self._arm,
            auction=request.auction,
            quote="",
            valid_s=0.0,
            twin=self._twin,
            time_s=state.time_s,
            mode=state.mode,
            headroom_k=state.headroom_k,
            capacity=0,
            estimates=estimates,
        )

    def _refuse(self, award: Award) -> Ack:
        return Ack(self._arm, award.award, False, self._refusal)

    def _set_clock(self, clock: FleetClock, jump: bool) -> None:
        if clock.speed != 1.0:
            speed = f"runs {clock.speed:g} times as fast as a real arm"
            raise BusError(f"The fleet '{self._link.fleet}' {speed}: its speed must be 1.")
        self._clock = clock
