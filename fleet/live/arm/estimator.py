"""Cost of a job for one arm: its plan, difficulty, peak temperature and duration.

Inputs are planned motions, the difficulty model, measured motor temperatures and the thermal network of a nominal
arm; not the true parameters of its body.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import NamedTuple

import numpy as np

from fleet.arm.space import space_name
from fleet.arm.time_limit import check_time, time_limit
from fleet.bus.protocol.auction import NOT_PLANNED, JobEstimate, JobSpec, PlanQuote
from fleet.difficulty import Difficulty, DifficultyModel
from fleet.errors import InfeasibleJob, listed, printable
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, gen3_network, temperature_steps, thermal_model
from fleet.job import LONGEST_JOB_S, Job, Place, Work
from fleet.motion import Drive, Plan, distinct
from fleet.offered_plans import nominal_drive, offered_plans
from fleet.robot import JOINTS

Array = np.ndarray
_LOG = logging.getLogger(__name__)

MAX_WORKS, MAX_SCORES, MAX_BYTES = 512, 1024, 24_000_000
"""Of works that were not known at the start: how many are kept, jobs whose scores are kept, and size of the plans."""
PLAN_S = 20.0
"""Seconds of processor time that planning and scoring of one job may take; a usual one takes 0.05 to 0.5."""
MAX_REASON = 300
"""Characters of an error in a reason."""
STEPS = 24
"""Time steps of a job when its temperatures are predicted."""
NO_CYCLES: Mapping[str, int] = {}


class NominalPeaks:
    """Predicts peak temperatures by the thermal network of a nominal Gen3 in still air."""

    def __init__(self) -> None:
        self._motors, self._thermal = gen3_motors(), thermal_model(gen3_network())

    def peaks_c(self, plans: Sequence[Plan], repetitions: Sequence[int], known_c: Array) -> Array:
        """Hottest motor during each plan, °C, [plan], in `STEPS` steps of constant heat each.

        Args:
            known_c: Known temperatures, [KNOWN].
        """
        if not plans:
            return np.zeros(0)
        jobs = list(zip(plans, repetitions, strict=True))
        shares = [plan.weights(times) for plan, times in jobs]
        loads = [nominal_drive(plan) for plan in plans]
        mean = Drive(
            np.stack([share @ load.current_sq for share, load in zip(shares, loads, strict=True)]),
            np.stack([share @ load.friction_w for share, load in zip(shares, loads, strict=True)]),
        )
        steps = temperature_steps(
            repeat(mean, STEPS),
            np.array([plan.duration_s(times) for plan, times in jobs]) / STEPS,
            motors=self._motors,
            thermal=self._thermal,
            start_c=np.tile(known_c[:NODES], (len(plans), 1)),  # [plan, node]: windings, then housings
            ambient_c=float(known_c[NODES]),
        )
        return np.max([step[:, WINDING].max(axis=1) for step in steps], axis=0)


class ScoredPlan(NamedTuple):
    """A plan on offer for a job."""

    plan: Plan
    difficulty: Difficulty | None


@dataclass(frozen=True)
class NoPlan:
    """Why an arm cannot do a job."""

    reason: str
    too_heavy: bool = False


Offers = tuple[ScoredPlan, ...] | NoPlan
"""Plans on offer for a job, the fastest first, or why there is none."""


class Estimator:
    """Plans the jobs of one arm, and estimates what each plan costs.

    Args:
        plan: Returns all variants of a work, maybe slowly; raises `InfeasibleJob`.
        places: Places of the cell by name.
    """

    def __init__(
        self,
        model: DifficultyModel,
        plan: Callable[[Work], tuple[Plan, ...]],
        places: Mapping[str, Place],
        peaks: NominalPeaks,
    ) -> None:
        self.model = model
        self._plan, self._places, self._peaks = plan, places, peaks
        self._known: dict[Work, tuple[Plan, ...] | NoPlan] = {}
        self._requested: dict[Work, tuple[Plan, ...] | NoPlan] = {}
        """Variants of the works known at the start, and of others, oldest first."""
        self._bytes = 0
        """Size of the plans of requested works."""
        self._offers: dict[tuple[tuple[Work, ...], int, int], Offers] = {}
        """By works that serve alike, number of repetitions and how many of them are done."""
        self._excess: dict[tuple[Work, ...], float] = {}
        """Excess of heat that was measured in works that serve alike, oldest first."""
        self.heat_ratio = 1.0
        """Of the measured to the expected heat, see `fleet.live.arm.body.Body.found`."""

    def plan_ahead(self, works: Iterable[Work]) -> None:
        """Plan some works before they are requested; they are never dropped."""
        for work in works:
            self._known[work] = self._variants_or_reason(work)

    def is_prepared(self, job: JobSpec, done: int = 0) -> bool:
        """Whether an estimate of the job needs neither planning nor scoring.

        Args:
            done: Cycles that are done.
        """
        return self._offers_or_reason(job, done) != NoPlan(NOT_PLANNED)

    def prepare(self, job: JobSpec, done: int = 0) -> None:
        """Plan and score the job, maybe slowly; never raises. Arguments as in `is_prepared`.

        An error is a reason why there is no plan.
        """
        for cycles in {0, done}:
            if not self.is_prepared(job, cycles):
                works = self._works(job)
                assert not isinstance(works, NoPlan)
                try:
                    with time_limit(PLAN_S):
                        offers = self._scored_or_reason(works, job.repetitions, cycles)
                except Exception as error:  # whatever it is, the arm goes on
                    offers = failed(job, error)
                while len(self._offers) >= MAX_SCORES:
                    del self._offers[next(iter(self._offers))]
                self._offers[works, job.repetitions, cycles] = offers

    def _variants(self, work: Work) -> tuple[Plan, ...] | NoPlan:
        """Variants of a work, kept within `MAX_WORKS` and `MAX_BYTES`."""
        for kept in (self._known, self._requested):
            if work in kept:
                return kept[work]
        variants = self._variants_or_reason(work)
        self._requested[work] = variants
        self._bytes += _size(variants)
        while self._requested and (len(self._requested) > MAX_WORKS or self._bytes > MAX_BYTES):
            oldest = next(iter(self._requested))
            self._bytes -= _size(self._requested.pop(oldest))
            for key in [key for key in self._offers if oldest in key[0]]:
                del self._offers[key]
        return variants

    def _scored_or_reason(self, works: tuple[Work, ...], repetitions: int, done: int) -> Offers:
        each = [self._variants(work) for work in works]
        variants = [plan for own in each if not isinstance(own, NoPlan) for plan in own]
        if not variants:
            return next(reason for reason in each if isinstance(reason, NoPlan))
        offered = offered_plans(variants, repetitions)  # the plans and their numbers stay the same when cycles are done
        if (takes_s := offered[0].duration_s(repetitions)) > LONGEST_JOB_S:
            days = f"it would take {takes_s / 86400:.1f} days; at most {LONGEST_JOB_S / 86400:g} are allowed"
            return NoPlan(f"{days}: use fewer repetitions")
        scored: list[ScoredPlan] = []
        for plan in offered:
            check_time()
            scored.append(ScoredPlan(plan, self.model.score(plan, _left(repetitions, done))))
        return tuple(scored)

    def learn(self, job: JobSpec, excess: float) -> None:
        """Correct later estimates of jobs with the same works by a measured excess of heat; see `Forecast.value`."""
        works = self._works(job)
        if isinstance(works, NoPlan):
            return
        if works not in self._excess and len(self._excess) >= MAX_WORKS:
            del self._excess[next(iter(self._excess))]
        self._excess[works] = excess

    def excess_of(self, job: JobSpec) -> float:
        """Excess of heat of a job, by what was measured in jobs with the same works and by the temperatures."""
        works = self._works(job)
        own = 0.0 if isinstance(works, NoPlan) else self._excess.get(works, 0.0)
        return (1.0 + own) * self.heat_ratio - 1.0

    def job(self, job: JobSpec) -> Job:
        """Return the job with its work.

        Raises:
            ValueError: it is not possible in this cell.
        """
        works = self._works(job)
        if isinstance(works, NoPlan):
            raise ValueError(works.reason)
        return Job(
            name=job.name,
            work=works[0],
            alternatives=works[1:],
            repetitions=job.repetitions,
            release_s=job.release_s,
            due_s=np.inf if job.due_s is None else job.due_s,
            value=job.value,
            after=job.after,
            expires=job.expires,
        )

    def plans(self, job: JobSpec) -> tuple[ScoredPlan, ...]:
        """Return the plans on offer for a prepared job, the fastest first; none if the arm cannot do it."""
        offers = self._offers_or_reason(job)
        return () if isinstance(offers, NoPlan) else offers

    def space_of(self, job: JobSpec, plan: int) -> str | None:
        """Return the name of the space that the arm takes by a plan on offer; None if no such plan is prepared."""
        offers = self.plans(job)
        return space_name(offers[plan].plan) if plan < len(offers) else None

    def estimate(
        self, jobs: Sequence[JobSpec], known_c: Array, busy_s: float, cycles: Mapping[str, int] = NO_CYCLES
    ) -> tuple[JobEstimate, ...]:
        """Estimate the cycles of each job that are not done, from what is planned already; an error is a reason.

        Args:
            known_c: Measured motor temperatures, estimated housing temperatures and ambient temperature, [KNOWN].
            busy_s: Seconds until the arm is free; inf if unknown.
            cycles: Cycles that are done, by job; 0 if not named.
        """
        try:
            return self._estimate(jobs, known_c, busy_s, cycles)
        except Exception as error:
            if len(jobs) == 1:
                return (JobEstimate(job=jobs[0].name, reason=failed(jobs[0], error).reason),)
            return tuple(each for job in jobs for each in self.estimate([job], known_c, busy_s, cycles))

    def _estimate(
        self, jobs: Sequence[JobSpec], known_c: Array, busy_s: float, cycles: Mapping[str, int]
    ) -> tuple[JobEstimate, ...]:
        offers = [(job, self._offers_or_reason(job, cycles.get(job.name, 0))) for job in jobs]
        left = [_left(job.repetitions, cycles.get(job.name, 0)) for job in jobs]
        pairs = [
            (scored.plan, times)
            for (_, plans), times in zip(offers, left, strict=True)
            if not isinstance(plans, NoPlan)
            for scored in plans
        ]
        nominal_c = iter(self._peaks.peaks_c([p for p, _ in pairs], [times for _, times in pairs], known_c).tolist())
        return tuple(
            JobEstimate(job=job.name, reason=plans.reason, too_heavy=plans.too_heavy)
            if isinstance(plans, NoPlan)
            else JobEstimate(
                job=job.name,
                plans=tuple(
                    _quote(n, times, scored, known_c, next(nominal_c), busy_s, self.excess_of(job))
                    for n, scored in enumerate(plans)
                ),
            )
            for (job, plans), times in zip(offers, left, strict=True)
        )

    def _offers_or_reason(self, job: JobSpec, done: int = 0) -> Offers:
        """Plans of a prepared job, or why there is none."""
        works = self._works(job)
        if isinstance(works, NoPlan):
            return works
        return self._offers.get((works, job.repetitions, done), NoPlan(NOT_PLANNED))

    def _works(self, job: JobSpec) -> tuple[Work, ...] | NoPlan:
        """Return the task at each alternative place, or why one is not possible."""
        unknown = [name for names in job.every_places for name in names if name not in self._places]
        if unknown:
            return NoPlan(f"there is no place '{unknown[0]}' in this cell; places: {listed(self._places)}")
        try:
            return tuple(
                Work(
                    kind=job.kind,
                    places=tuple(self._places[name] for name in names),
                    payload_kg=job.payload_kg,
                    dwell_s=job.dwell_s,
                    force_n=job.force_n,
                )
                for names in job.every_places
            )
        except ValueError as error:
            return NoPlan(str(error))

    def _variants_or_reason(self, work: Work) -> tuple[Plan, ...] | NoPlan:
        try:
            return self._plan(work)
        except InfeasibleJob as infeasible:
            return NoPlan(f"at '{infeasible.place}': {infeasible.reason}", infeasible.too_heavy)


def failed(job: JobSpec, error: Exception) -> NoPlan:
    """Log an unexpected error, and return it as the reason why there is no plan."""
    _LOG.warning("'%s' could not be quoted.", printable(job.name), exc_info=error)
    return NoPlan(f"it could not be planned: {type(error).__name__}: {error}"[:MAX_REASON])


def _size(variants: tuple[Plan, ...] | NoPlan) -> int:
    """Bytes of the samples that are stored."""
    plans = () if isinstance(variants, NoPlan) else variants
    return sum(distinct(phase.profile).nbytes for plan in plans for phase in plan.phases)


def _left(repetitions: int, done: int) -> int:
    """Return how many cycles are left; the last one is never assumed done."""
    return max(1, repetitions - done)


def _quote(
    number: int, left: int, scored: ScoredPlan, known_c: Array, nominal_c: float, busy_s: float, excess: float
) -> PlanQuote:
    """Return what a plan costs; its peak is that of the arm's model, or else that of a nominal arm.

    Args:
        left: Cycles that are not done.
        excess: As in `Forecast.value`.
    """
    plan, score = scored
    own_c = None if score is None else score.peak_at(known_c, excess=excess)
    peak_c, hottest_c = nominal_c if own_c is None else own_c, float(known_c[:JOINTS].max())
    finish_s = busy_s + plan.approach.duration_s + left * plan.cycle.duration_s
    return PlanQuote(
        plan=number,
        peak_c=peak_c,
        gained_k=peak_c - hottest_c,
        p_saturation=None if score is None else score.p_at(known_c, excess=excess),
        joint_difficulty=None if score is None else tuple(score.per_joint.tolist()),
        difficulty=None if score is None else score.total,
        duration_s=plan.duration_s(left),
        finish_in_s=finish_s if np.isfinite(finish_s) else None,
        space=space_name(plan),
    )
