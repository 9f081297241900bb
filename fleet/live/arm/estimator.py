"""Cost of a job for one arm: its plan, difficulty, peak temperature and duration.

Inputs are planned motions, the difficulty model, measured motor temperatures and the thermal network of a nominal
arm; not the true parameters of its body.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import repeat
from typing import NamedTuple

import numpy as np

from fleet.bus.protocol.auction import JobEstimate, JobSpec
from fleet.difficulty import Difficulty, DifficultyModel
from fleet.errors import InfeasibleJob
from fleet.job import LONGEST_JOB_S, Job, Place, Work
from fleet.motion import Drive, Plan, drives, offered_plans
from fleet.motor import gen3_motors
from fleet.planning.space import plan_key, space_name
from fleet.thermal import WINDING, gen3_network, temperature_steps, thermal_model

Array = np.ndarray

MAX_WORKS, MAX_SCORES = 512, 4096
"""Works whose plans are kept, and jobs whose best plan is kept."""
STEPS = 24
"""Time steps of a job when its temperatures are predicted."""
NOT_PLANNED = "not planned yet; ask again"


class NominalPeaks:
    """Predicts peak temperatures by the thermal network of a nominal Gen3 in still air."""

    def __init__(self) -> None:
        self._motors, self._thermal = gen3_motors(), thermal_model(gen3_network())
        self._drive = lru_cache(MAX_SCORES)(self._mean_drive)

    def peaks_c(self, plans: Sequence[Plan], repetitions: Sequence[int], temp_c: Array, ambient_c: float) -> Array:
        """Hottest motor during each job, °C, [job], in `STEPS` steps of constant heat each.

        Args:
            temp_c: Motor temperatures measured now, [joint]; the housings are assumed to be as warm.
        """
        if not plans:
            return np.zeros(0)
        jobs = list(zip(plans, repetitions, strict=True))
        shares = [plan.weights(times) for plan, times in jobs]
        loads = [self._drive(plan) for plan in plans]
        mean = Drive(
            np.stack([share @ load.current_sq for share, load in zip(shares, loads, strict=True)]),
            np.stack([share @ load.friction_w for share, load in zip(shares, loads, strict=True)]),
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

    def _mean_drive(self, plan: Plan) -> Drive:
        """Mean drive of each phase, [phase, joint]."""
        return drives([phase.profile for phase in plan.phases], self._motors)


class ScoredPlan(NamedTuple):
    """How an arm would do a job: the variant with the least difficulty."""

    plan: Plan
    difficulty: Difficulty | None


class Estimator:
    """Chooses how one arm would do a job, and estimates its cost.

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
        self._variants = lru_cache(MAX_WORKS)(self._variants_or_reason)
        self._best: dict[tuple[Work, int], ScoredPlan | str] = {}
        """Best plan of a work and a number of repetitions, or why there is none."""

    def plan_ahead(self, works: Iterable[Work]) -> None:
        """Plan some works before they are requested."""
        for work in works:
            self._variants(work)

    def is_prepared(self, job: JobSpec) -> bool:
        """Whether an estimate of the job needs neither planning nor scoring."""
        return self._best_or_reason(job) != NOT_PLANNED

    def prepare(self, job: JobSpec) -> None:
        """Plan and score the job, maybe slowly; never raises."""
        if self.is_prepared(job):
            return
        work = self._work(job)
        assert isinstance(work, Work)
        if len(self._best) >= MAX_SCORES:
            del self._best[next(iter(self._best))]
        variants = self._variants(work)
        if isinstance(variants, str):
            self._best[work, job.repetitions] = variants
            return
        best = offered_plans(variants, job.repetitions)[0]
        if (takes_s := best.duration_s(job.repetitions)) > LONGEST_JOB_S:
            days = f"it would take {takes_s / 86400:.1f} days; at most {LONGEST_JOB_S / 86400:g} are allowed"
            self._best[work, job.repetitions] = f"{days}: use fewer repetitions"
            return
        self._best[work, job.repetitions] = ScoredPlan(best, self.model.score(best, job.repetitions))

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
        self.prepare(job)
        best = self._best_or_reason(job)
        return None if isinstance(best, str) else best

    def space_of(self, job: JobSpec) -> str | None:
        """Return the name of the space that the arm takes for the job; None if it cannot do it."""
        scored = self.best_plan(job)
        return None if scored is None else space_name(plan_key(scored.plan))

    def estimate(
        self, jobs: Sequence[JobSpec], temp_c: Array, ambient_c: float, busy_s: float
    ) -> tuple[JobEstimate, ...]:
        """Estimate each job from what is planned already.

        Args:
            temp_c: Motor temperatures as measured now, [joint].
            busy_s: Seconds until the arm is free; inf if unknown.
        """
        best = [(job, self._best_or_reason(job)) for job in jobs]
        feasible = [(job, scored) for job, scored in best if isinstance(scored, ScoredPlan)]
        plans, repetitions = [scored.plan for _, scored in feasible], [job.repetitions for job, _ in feasible]
        peaks = iter(self._peaks.peaks_c(plans, repetitions, temp_c, ambient_c).tolist())
        return tuple(
            JobEstimate(job=job.name, feasible=False, reason=scored)
            if isinstance(scored, str)
            else _estimate(job, scored, temp_c, next(peaks), busy_s)
            for job, scored in best
        )

    def _best_or_reason(self, job: JobSpec) -> ScoredPlan | str:
        """Best plan of a prepared job, or why there is none."""
        work = self._work(job)
        return work if isinstance(work, str) else self._best.get((work, job.repetitions), NOT_PLANNED)

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

    def _variants_or_reason(self, work: Work) -> tuple[Plan, ...] | str:
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
        space=space_name(plan_key(plan)),
    )
