"""Cost of a job for one arm: its plan, difficulty, peak temperature and duration.

It uses what the arm knows: planned motions, the difficulty model, measured motor temperatures and the thermal network
of a nominal arm; not the true parameters of its body.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Protocol

import numpy as np

from fleet.bus.protocol.auction import JobEstimate, JobSpec
from fleet.difficulty import Difficulty, DifficultyModel
from fleet.errors import InfeasibleJob
from fleet.job import Job, Place, Work
from fleet.motion import Drive, Plan, drives
from fleet.motor import Motors, gen3_motors
from fleet.thermal import WINDING, ThermalModel, gen3_network, temperature_steps, thermal_model

Array = np.ndarray

MAX_WORKS = 512
"""Works whose plans are kept; the least recently used is dropped."""
MAX_SCORES = 4096
STEPS = 24
"""Time steps of a job when its temperatures are predicted."""
NOT_PLANNED = "not planned yet; ask again"


class PeakPredictor(Protocol):
    """Predicts the peak temperatures of an arm."""

    def peaks_c(self, plans: Sequence[Plan], repetitions: Sequence[int], temp_c: Array, ambient_c: float) -> Array:
        """Hottest motor during each job, °C, [job], from motor temperatures measured now, [joint]."""
        ...


class NominalPeaks:
    """Predicts by the thermal network of a nominal Gen3, with housings as warm as the measured windings."""

    def __init__(self, motors: Motors | None = None, thermal: ThermalModel | None = None) -> None:
        """Prepare; the default is a nominal Gen3 in still air."""
        self._motors = motors or gen3_motors()
        self._thermal = thermal or thermal_model(gen3_network())
        self._drives: dict[int, tuple[Plan, Drive]] = {}

    def peaks_c(self, plans: Sequence[Plan], repetitions: Sequence[int], temp_c: Array, ambient_c: float) -> Array:
        """Hottest motor during each job, °C, [job], in `STEPS` steps of constant heat each."""
        if not plans:
            return np.zeros(0)
        jobs = list(zip(plans, repetitions, strict=True))
        weights = [plan.weights(times) for plan, times in jobs]
        loads = [self._drive(plan) for plan in plans]
        mean = Drive(
            np.stack([share @ load.current_sq for share, load in zip(weights, loads, strict=True)]),
            np.stack([share @ load.friction_w for share, load in zip(weights, loads, strict=True)]),
        )
        steps = temperature_steps(
            repeat(mean, STEPS),
            np.array([plan.duration_s(times) for plan, times in jobs]) / STEPS,
            motors=self._motors,
            thermal=self._thermal,
            start_c=np.tile(np.asarray(temp_c, dtype=float), (len(plans), 2)),  # [job, node]: windings, housings
            ambient_c=ambient_c,
        )
        return np.max([step[:, WINDING].max(axis=1) for step in steps], axis=0)

    def _drive(self, plan: Plan) -> Drive:
        """Mean drive of each phase, [phase, joint]."""
        if id(plan) not in self._drives:
            if len(self._drives) >= MAX_SCORES:
                del self._drives[next(iter(self._drives))]
            # The plan is kept with its drive: another could otherwise get the same id.
            self._drives[id(plan)] = plan, drives([phase.profile for phase in plan.phases], self._motors)
        return self._drives[id(plan)][1]


@dataclass(frozen=True, eq=False)
class ScoredPlan:
    """How an arm would do a job: the variant with the least difficulty."""

    plan: Plan
    difficulty: Difficulty | None


class Estimator:
    """Chooses how one arm would do a job, and estimates its cost."""

    def __init__(
        self,
        model: DifficultyModel,
        plan: Callable[[Work], tuple[Plan, ...]],
        places: Mapping[str, Place],
        peaks: PeakPredictor,
    ) -> None:
        """Start without any plan.

        Args:
            plan: Returns all variants of a work, maybe slowly; raises `InfeasibleJob`.
            places: Of the cell, by name.
        """
        self.model = model
        self._plan, self._places, self._peaks = plan, places, peaks
        self._variants: dict[Work, tuple[Plan, ...] | str] = {}
        self._scored: dict[tuple[Work, int], ScoredPlan] = {}

    def plan_ahead(self, works: Iterable[Work]) -> None:
        """Plan some works before they are asked for."""
        for work in works:
            self._variants[work] = self._plan_or_reason(work)

    def is_prepared(self, job: JobSpec) -> bool:
        """Whether an estimate of the job needs neither planning nor scoring."""
        work = self._work(job)
        return isinstance(work, str) or self._is_scored(work, job.repetitions)

    def prepare(self, job: JobSpec) -> None:
        """Plan and score the job, maybe slowly; never raises."""
        self.best_plan(job)

    def job(self, job: JobSpec) -> Job | None:
        """Return the job with its work; None if it is not possible in this cell."""
        work = self._work(job)
        if isinstance(work, str):
            return None
        return Job(
            name=job.name,
            work=work,
            repetitions=job.repetitions,
            release_s=job.release_s,
            due_s=np.inf if job.due_s is None else job.due_s,
            value=job.value,
            after=job.after,
        )

    def best_plan(self, job: JobSpec) -> ScoredPlan | None:
        """Return how the arm would do the job, planned if needed; None if it cannot."""
        work = self._work(job)
        best = work if isinstance(work, str) else self._best(work, job.repetitions)
        return None if isinstance(best, str) else best

    def estimate(
        self, jobs: Sequence[JobSpec], temp_c: Array, ambient_c: float, busy_s: float
    ) -> tuple[JobEstimate, ...]:
        """Estimate each job from what is planned already.

        Args:
            temp_c: Motor temperatures as measured now, [joint].
            busy_s: Seconds until the arm is free; inf if unknown.
        """
        best = [self._best_if_scored(job) for job in jobs]
        feasible = [
            (scored.plan, job.repetitions)
            for job, scored in zip(jobs, best, strict=True)
            if isinstance(scored, ScoredPlan)
        ]
        peaks_c = self._peaks.peaks_c([plan for plan, _ in feasible], [n for _, n in feasible], temp_c, ambient_c)
        peaks = iter(peaks_c.tolist())
        return tuple(
            JobEstimate(job=job.name, feasible=False, reason=scored)
            if isinstance(scored, str)
            else _estimate(job, scored, temp_c, next(peaks), busy_s)
            for job, scored in zip(jobs, best, strict=True)
        )

    def _best_if_scored(self, job: JobSpec) -> ScoredPlan | str:
        work = self._work(job)
        if isinstance(work, str):
            return work
        return self._best(work, job.repetitions) if self._is_scored(work, job.repetitions) else NOT_PLANNED

    def _is_scored(self, work: Work, repetitions: int) -> bool:
        return (work, repetitions) in self._scored or isinstance(self._variants.get(work), str)

    def _work(self, job: JobSpec) -> Work | str:
        """Return the work, or why it is not possible."""
        unknown = [name for name in job.places if name not in self._places]
        if unknown:
            return f"there is no place '{unknown[0]}' in this cell; places: {', '.join(self._places)}"
        try:
            return Work(
                kind=job.kind,
                places=tuple(self._places[name] for name in job.places),
                payload_kg=job.payload_kg,
                dwell_s=job.dwell_s,
                force_n=job.force_n,
            )
        except ValueError as error:
            return str(error)

    def _best(self, work: Work, repetitions: int) -> ScoredPlan | str:
        """Return the easiest variant, or why there is none."""
        scored = self._scored.get((work, repetitions))
        if scored is not None:
            return scored
        variants = self._variants.pop(work, None)
        if variants is None:
            variants = self._plan_or_reason(work)
        self._variants[work] = variants  # the most recently used is last
        if len(self._variants) > MAX_WORKS:
            del self._variants[next(iter(self._variants))]
        if isinstance(variants, str):
            return variants
        if len(self._scored) >= MAX_SCORES:
            del self._scored[next(iter(self._scored))]
        every = [ScoredPlan(plan, self.model.score(plan, repetitions)) for plan in variants]
        best = min(every, key=lambda each: each.difficulty.total if each.difficulty else 0.0)
        self._scored[work, repetitions] = best
        return best

    def _plan_or_reason(self, work: Work) -> tuple[Plan, ...] | str:
        try:
            return self._plan(work)
        except InfeasibleJob as infeasible:
            return f"at '{infeasible.place}': {infeasible.reason}"


def _estimate(job: JobSpec, scored: ScoredPlan, temp_c: Array, peak_c: float, busy_s: float) -> JobEstimate:
    score, plan = scored.difficulty, scored.plan
    finish_s = busy_s + plan.approach.duration_s + job.repetitions * plan.cycle.duration_s
    return JobEstimate(
        job=job.name,
        feasible=True,
        joint_difficulty=None if score is None else tuple(score.per_joint.tolist()),
        difficulty=None if score is None else score.total,
        p_saturation=None if score is None else score.p_at(temp_c),
        peak_c=peak_c,
        duration_s=plan.duration_s(job.repetitions),
        finish_in_s=finish_s if np.isfinite(finish_s) else None,
    )
