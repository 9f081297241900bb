"""What an arm publishes about itself: constants, state, difficulty of jobs, events."""

import math

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobEstimate
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.events import EVENTS_PER_BOOT, Event


class Publications:
    """Publishers of one arm, which number its messages.

    Attributes:
        tick: Number of states so far.
    """

    def __init__(self, link: BusClient, arm: str, boot: int) -> None:
        """Declare the publishers; `link` is open, and `boot` the number of this start of the arm."""
        self._arm, self._boot = arm, boot
        self.tick = self._events = 0
        self._publish_state = link.publisher(keys.of_arm(link.fleet, arm, "state"), State)
        self._publish_difficulty = link.publisher(keys.of_arm(link.fleet, arm, "difficulty"), DifficultyScores)
        self._publish_event = link.publisher(keys.of_arm(link.fleet, arm, "event"), ArmEvent)
        self._publish_info = link.publisher(keys.of_arm(link.fleet, arm, "info"), Info)  # holds the last one

    def info(self, joints: int, twin: str) -> None:
        """Publish the constants of the arm."""
        self._publish_info(Info(self._arm, joints, twin))

    def next_tick(self) -> int:
        """Return the number of the next state."""
        self.tick += 1
        return self.tick

    def state(self, state: State) -> None:
        """Publish a state."""
        self._publish_state(state)

    def difficulty(self, estimates: tuple[JobEstimate, ...], twin: str, time_s: float) -> None:
        """Publish how difficult jobs are for the arm, by the plan with the least difficulty."""
        plans = [estimate.least for estimate in estimates]
        self._publish_difficulty(
            DifficultyScores(
                arm=self._arm,
                tick=self.tick,
                time_s=time_s,
                twin=twin,
                jobs=tuple(estimate.job for estimate in estimates),
                difficulty=tuple(plan.difficulty for plan in plans),
                p_saturation=tuple(plan.p_saturation for plan in plans),
                peak_c=tuple(plan.peak_c for plan in plans),
            )
        )

    def event(self, event: Event, epoch: str) -> None:
        """Publish an event of an epoch of the fleet."""
        self._events += 1
        self._publish_event(
            ArmEvent(
                arm=self._arm,
                number=self._boot * EVENTS_PER_BOOT + self._events,
                time_s=event.time_s,
                kind=event.kind,
                job=event.job,
                joint=event.joint,
                value=event.value if math.isfinite(event.value) else None,
                reason=event.reason,
                epoch=epoch,
            )
        )
