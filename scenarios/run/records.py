"""A shift as it was recorded: readings, events, jobs, and the offers behind each award."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any  # values of a card

import numpy as np

from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, RUNNING, WAITING, State, World
from fleet.events import Event
from fleet.observation import Observation
from fleet.robot import ThermalLimits
from fleet.telemetry import Telemetry
from scenarios.run.schedule import Schedule, payloads, schedule

JOB_STATES = {WAITING: "waiting", RUNNING: "running", DONE: "finished", GIVEN_UP: "given_up", EXPIRED: "expired"}


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """One job of a shift, as at its end."""

    job: str
    state: str
    """One of `JOB_STATES`."""
    release_s: float
    due_s: float
    finished_s: float | None
    """None if it was not finished."""
    value: float
    payload_kg: float
    cycles: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Offer:
    """What one arm knew of a job at the moment it was awarded."""

    time_s: float
    job: str
    arm: str
    awarded: bool
    state: str
    """idle, working or faulted."""
    feasible: bool
    """Whether the arm has a plan for it."""
    free: bool
    """Whether it was allowed to claim it then."""
    difficulty: float | None
    """d of the plan that was awarded, of other arms the least of their plans; None if unknown."""
    peak_c: float | None
    """Predicted peak of that plan; None if unknown."""
    p_saturation: float | None
    """P(saturation) of that plan; None without a plan."""
    duration_s: float | None
    """Time for the rest of the job by that plan; None without a plan."""
    plan: int | None = None
    """Number of that plan: 0 is the fastest, 1 the coolest; None without a plan, and in runs of earlier versions."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShiftLog:
    """A shift of a simulated or of a live fleet, as its readers need it."""

    card: Mapping[str, Any]
    """Settings and figures: of a run, the content of run.json; of a recording, those that are known."""
    arms: tuple[str, ...]
    """Names of the arms."""
    limits: ThermalLimits
    readings: Telemetry
    """Sensor readings as arrays, arms in the order of `arms`; without samples if recording was off or the shift ended
    before its first step."""
    events: tuple[Event, ...]
    jobs: tuple[JobRecord, ...] = ()
    offers: tuple[Offer, ...] = ()
    """Offers of all arms at every award."""

    @property
    def policy(self) -> str:
        """Name of its policy."""
        return str(self.card.get("policy", "unknown policy"))

    @property
    def faults(self) -> list[Event]:
        """In order of time."""
        return sorted((event for event in self.events if event.kind == "fault"), key=lambda event: event.time_s)

    @cached_property
    def plan(self) -> Schedule:
        """Which arm worked on what, until the last reading or event.

        Raises:
            ValueError: as `schedule`.
        """
        ends_s = [float(self.readings.time_s[-1])] if len(self.readings.time_s) else []
        if not ends_s and "time_s" in self.card:
            ends_s.append(float(self.card["time_s"]))
        ends_s += [event.time_s for event in self.events]
        horizon_s = float(self.card.get("scenario", {}).get("horizon_s", 0.0))
        return schedule(self.events, self.arms, max(ends_s, default=horizon_s))

    def offers_behind(self, job: str, arm: str, time_s: float) -> tuple[Offer, ...]:
        """Offers of all arms at the award of a job to an arm; in a recording its time is that of another clock, so the
        award nearest the time is meant."""
        times_s = [each.time_s for each in self.offers if each.awarded and (each.job, each.arm) == (job, arm)]
        award_s = min(times_s, key=lambda each: abs(each - time_s), default=None)
        return tuple(each for each in self.offers if (each.job, each.time_s) == (job, award_s))

    @cached_property
    def load_kg(self) -> np.ndarray:
        """Payload in each hand, kg, [sample, arm]."""
        return payloads(self.readings, self.plan, self.arms, {job.job: job.payload_kg for job in self.jobs})


def job_records(world: World, state: State) -> tuple[JobRecord, ...]:
    """The jobs of env 0 in the order of the shift."""
    jobs = world.jobs
    return tuple(
        JobRecord(
            job=jobs.names[0][j],
            state=JOB_STATES[int(state.status[0, j])],
            release_s=float(jobs.release_s[0, j]),
            due_s=float(jobs.due_s[0, j]),
            finished_s=float(state.finished_s[0, j]) if state.status[0, j] == DONE else None,
            value=float(jobs.value[0, j]),
            payload_kg=float(jobs.payload_kg[0, j]),
            cycles=int(jobs.repetitions[0, j]),
        )
        for j in np.flatnonzero(jobs.exists[0]).tolist()
    )


def offers_of(event: Event, seen: Mapping[str, Observation], actions: Mapping[str, int], plans: int) -> Iterator[Offer]:
    """What each arm knew of the job of an award.

    Args:
        seen: Observation of each arm at the decision.
        actions: Of each arm at the decision.
        plans: Plans per slot.
    """
    chosen = actions[event.arm] - 1
    slot = range(chosen // plans * plans, (chosen // plans + 1) * plans)
    for arm, own in seen.items():
        able = [option for option in slot if own.feasible[option]]
        known = [option for option in able if own.known[option]]
        best = chosen if arm == event.arm else min(known or able, key=lambda o: own.difficulty[o], default=-1)
        peak_c = float(own.peak_c[best])
        yield Offer(
            time_s=event.time_s,
            job=event.job,
            arm=arm,
            awarded=arm == event.arm,
            state="faulted" if own.faulted else "working" if own.working else "idle",
            feasible=bool(able),
            free=bool(any(own.action_mask[1 + option] for option in slot)),
            difficulty=float(own.difficulty[best]) if best in known else None,
            peak_c=peak_c if able and peak_c else None,
            p_saturation=float(own.p_saturation[best]) if able else None,
            duration_s=float(own.duration_s[best]) if able else None,
            plan=best % plans if able else None,
        )
