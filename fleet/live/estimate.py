"""What a job would cost an arm: its plan, its difficulty, how warm the motors would get, and how long it takes.

All of it is what the arm knows: its planned motion, its difficulty model, measured motor temperatures, and a thermal
network of its make (`NominalHeat`); the truth of its body is not among it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fleet.bus.trade import JobWord, Offer
from fleet.difficulty import Difficulty, DifficultyModel
from fleet.errors import InfeasibleJob
from fleet.job import Job, Place, Work
from fleet.motion import Plan, drive
from fleet.motor import Motors, gen3_motors
from fleet.thermal import WINDING, ThermalModel, advance, drive_heat, gen3_network, thermal_model

Array = np.ndarray

MOST_WORKS = 512
"""Of which an arm remembers how it would do them; the longest unused is forgotten."""
MOST_SCORES = 4096
STEPS = 24
"""Into which a job is cut when its heat is foreseen."""
NOT_YET = "not planned yet; ask again"


class Foresight(Protocol):
    """Foresees how warm the motors of an arm would get."""

    def peaks_c(self, plans: Sequence[Plan], repetitions: Sequence[int], temp_c: Array, air_c: float) -> Array:
        """Hottest motor during each job from motor temperatures [joint] as measured now, °C, [job]."""
        ...


class NominalHeat:
    """By the thermal network of a nominal Gen3, with housings as warm as the windings are measured."""

    def __init__(self, motors: Motors | None = None, thermal: ThermalModel | None = None) -> None:
        """Prepare it; by default of a nominal Gen3 in still air."""
        self._motors = motors or gen3_motors()
        self._thermal = thermal or thermal_model(gen3_network())
        self._loads: dict[tuple[int, int], tuple[Plan, tuple[Array, ...]]] = {}

    def peaks_c(self, plans: Sequence[Plan], repetitions: Sequence[int], temp_c: Array, air_c: float) -> Array:
        """Hottest motor during each job, °C, [job], in `STEPS` steps of constant heat each."""
        if not plans:
            return np.zeros(0)
        loads = [self._load(plan, times) for plan, times in zip(plans, repetitions, strict=True)]
        current_sq, friction_w, phi, gamma = (np.stack(parts) for parts in zip(*loads, strict=True))
        temp = np.tile(np.asarray(temp_c, dtype=float), (len(plans), 2))  # [job, node]: windings, housings
        peak = temp[:, WINDING].max(axis=1)
        for _ in range(STEPS):
            heat_w = drive_heat(temp, current_sq, friction_w, self._motors)
            temp = advance(temp, heat_w, air_c, phi, gamma, self._thermal.to_ambient)
            peak = np.maximum(peak, temp[:, WINDING].max(axis=1))
        return peak

    def _load(self, plan: Plan, repetitions: int) -> tuple[Array, ...]:
        """Mean squared current and friction heat of a job, and the two matrices of one of its steps."""
        key = (id(plan), repetitions)
        if key not in self._loads:
            if len(self._loads) >= MOST_SCORES:
                del self._loads[next(iter(self._loads))]
            drives = [drive(phase.profile, self._motors) for phase in plan.phases]
            weights = plan.weights(repetitions)
            current_sq = weights @ np.stack([d.current_sq for d in drives])
            friction_w = weights @ np.stack([d.friction_w for d in drives])
            phi, gamma = self._thermal.step_matrices(plan.duration_s(repetitions) / STEPS)
            # The plan is kept with it: another could otherwise get its id.
            self._loads[key] = plan, (current_sq, friction_w, phi, gamma)
        return self._loads[key][1]


@dataclass(frozen=True, eq=False)
class Way:
    """How an arm would do a job: the variant that its model finds easiest."""

    plan: Plan
    difficulty: Difficulty | None


class Estimator:
    """Finds the way in which one arm would do a job, and says what it would cost."""

    def __init__(
        self,
        model: DifficultyModel,
        plan: Callable[[Work], tuple[Plan, ...]],
        places: Mapping[str, Place],
        foresight: Foresight,
    ) -> None:
        """Know nothing yet.

        Args:
            plan: All variants of a work; raises `InfeasibleJob`. May take long.
            places: Of the cell, by name.
        """
        self.model = model
        self._plan, self._places, self._foresight = plan, places, foresight
        self._variants: dict[Work, tuple[Plan, ...] | str] = {}
        self._ways: dict[tuple[Work, int], Way] = {}

    def know(self, works: Iterable[Work]) -> None:
        """Plan some works beforehand."""
        for work in works:
            self._variants[work] = self._planned(work)

    def ready(self, word: JobWord) -> bool:
        """Whether an offer for the job takes neither planning nor scoring."""
        work = self._work(word)
        return isinstance(work, str) or self._known(work, word.repetitions)

    def prepare(self, word: JobWord) -> None:
        """Plan the job and score it, which may take long; cannot fail."""
        work = self._work(word)
        if not isinstance(work, str):
            self._way(work, word.repetitions)

    def job(self, word: JobWord) -> Job | None:
        """The job as a noun; None if it names a place that the cell does not have."""
        work = self._work(word)
        if isinstance(work, str):
            return None
        return Job(
            name=word.name,
            work=work,
            repetitions=word.repetitions,
            release_s=word.release_s,
            due_s=np.inf if word.due_s is None else word.due_s,
            value=word.value,
            after=word.after,
        )

    def way(self, word: JobWord) -> Way | None:
        """How the arm would do the job, planned if need be; None if it cannot."""
        work = self._work(word)
        found = work if isinstance(work, str) else self._way(work, word.repetitions)
        return None if isinstance(found, str) else found

    def offers(self, words: Sequence[JobWord], temp_c: Array, air_c: float, busy_s: float) -> tuple[Offer, ...]:
        """One offer per job, from what is planned already.

        Args:
            temp_c: Motor temperatures as measured now, [joint].
            busy_s: Until the arm is free, s; inf if nobody knows.
        """
        found = [self._found(word) for word in words]
        able = [(way, word.repetitions) for word, way in zip(words, found, strict=True) if isinstance(way, Way)]
        peaks = iter(
            self._foresight.peaks_c([way.plan for way, _ in able], [n for _, n in able], temp_c, air_c).tolist()
        )
        return tuple(
            Offer(job=word.name, feasible=False, reason=way)
            if isinstance(way, str)
            else _offer(word, way, temp_c, next(peaks), busy_s)
            for word, way in zip(words, found, strict=True)
        )

    def _found(self, word: JobWord) -> Way | str:
        work = self._work(word)
        if isinstance(work, str):
            return work
        return self._way(work, word.repetitions) if self._known(work, word.repetitions) else NOT_YET

    def _known(self, work: Work, repetitions: int) -> bool:
        return (work, repetitions) in self._ways or isinstance(self._variants.get(work), str)

    def _work(self, word: JobWord) -> Work | str:
        """The work, or why there is none."""
        unknown = [name for name in word.places if name not in self._places]
        if unknown:
            return f"there is no place '{unknown[0]}' in this cell; places: {', '.join(self._places)}"
        try:
            return Work(
                kind=word.kind,
                places=tuple(self._places[name] for name in word.places),
                payload_kg=word.payload_kg,
                dwell_s=word.dwell_s,
                force_n=word.force_n,
            )
        except ValueError as error:
            return str(error)

    def _way(self, work: Work, repetitions: int) -> Way | str:
        known = self._ways.get((work, repetitions))
        if known is not None:
            return known
        variants = self._variants.pop(work, None)
        if variants is None:
            variants = self._planned(work)
        self._variants[work] = variants  # the last used comes last
        if len(self._variants) > MOST_WORKS:
            del self._variants[next(iter(self._variants))]
        if isinstance(variants, str):
            return variants
        if len(self._ways) >= MOST_SCORES:
            del self._ways[next(iter(self._ways))]
        scored = [Way(plan, self.model.score(plan, repetitions)) for plan in variants]
        best = min(scored, key=lambda way: way.difficulty.total if way.difficulty else 0.0)
        self._ways[work, repetitions] = best
        return best

    def _planned(self, work: Work) -> tuple[Plan, ...] | str:
        try:
            return self._plan(work)
        except InfeasibleJob as infeasible:
            return f"at '{infeasible.place}': {infeasible.reason}"


def _offer(word: JobWord, way: Way, temp_c: Array, peak_c: float, busy_s: float) -> Offer:
    score, plan = way.difficulty, way.plan
    finish_s = busy_s + plan.approach.duration_s + word.repetitions * plan.cycle.duration_s
    return Offer(
        job=word.name,
        feasible=True,
        difficulty=None if score is None else tuple(score.per_joint.tolist()),
        d=None if score is None else score.total,
        p_saturation=None if score is None else score.p_at(temp_c),
        peak_c=peak_c,
        duration_s=plan.duration_s(word.repetitions),
        finish_in_s=finish_s if np.isfinite(finish_s) else None,
    )
