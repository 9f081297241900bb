"""Cost of giving each job to each arm by each plan: matrices [arm, option] from the observations of all arms.

+inf where the arm may not claim the job. Lower is better, and only differences count.
"""

from collections.abc import Sequence

import numpy as np

from agents.policy import plans_of
from fleet.observation import Observation

Array = np.ndarray

RISK = 9.0
"""The cost of a job in which a motor surely passes its warning limit is 1 + RISK times its difficulty."""
LATE_PER_H = 1.0
"""Cost of an hour of tardiness for each unit of a job's value, in units of difficulty."""
TIME_PER_H = 0.01
"""Cost of an hour until the finish: it decides where difficulties are equal."""
DIGITS = 9
"""Costs are rounded to this many digits, so that rounding errors do not break ties."""


def thermal(observations: Sequence[Observation]) -> Array:
    """Difficulty weighted by risk, relative to the fleet's average for that job; late and valuable jobs come first.

    The difficulty is weighted by 1 + RISK · P(saturation). As in `agents.rules.LeastDifficulty` it is relative to the
    average of the arms that may claim the job, and an unknown difficulty equals that average. If no arm has a
    difficulty, the risk decides, then the time until the finish.
    """
    able, plans = _able(observations), plans_of(observations[0])
    difficulty, known = _stack(observations, "difficulty"), _stack(observations, "known") > 0
    difficulty = np.where(known, difficulty, _mean(difficulty, known & able, plans, otherwise=1.0))
    tardiness_s = np.maximum(0.0, _busy_s(observations) - _stack(observations, "slack_s"))
    late = LATE_PER_H * np.repeat(_stack(observations, "value"), plans, axis=1) * tardiness_s / 3600.0
    time = TIME_PER_H * _finish_s(observations) / 3600.0
    cost = difficulty * (1.0 + RISK * _stack(observations, "p_saturation")) + late + time
    # Waiting makes a job late for every arm: the average lateness decides between jobs, not between arms.
    return np.where(able, cost - _mean(cost, able, plans) - _mean(late, able, plans), np.inf).round(DIGITS)


def quickest(observations: Sequence[Observation]) -> Array:
    """Seconds until the arm would finish the job; heat is ignored."""
    return np.where(_able(observations), _finish_s(observations), np.inf).round(DIGITS)


def _able(observations: Sequence[Observation]) -> Array:
    """Whether the arm may claim the job now, bool, [arm, option]."""
    return np.stack([seen.action_mask[1:-1] for seen in observations]) > 0


def _finish_s(observations: Sequence[Observation]) -> Array:
    """Seconds until the arm would finish the job, after its current one, [arm, option]."""
    return _busy_s(observations) + _stack(observations, "duration_s")


def _busy_s(observations: Sequence[Observation]) -> Array:
    return np.array([[float(seen.busy_s)] for seen in observations])


def _stack(observations: Sequence[Observation], field: str) -> Array:
    return np.stack([np.asarray(getattr(seen, field), dtype=float) for seen in observations])


def _mean(values: Array, where: Array, plans: int, otherwise: float = 0.0) -> Array:
    """Average over some of the arms and the plans of a job, [option]; the same for all plans of a job."""
    total = np.where(where, values, 0.0).sum(axis=0).reshape(-1, plans).sum(axis=1)
    count = where.sum(axis=0).reshape(-1, plans).sum(axis=1)
    return np.repeat(np.where(count > 0, total / np.maximum(count, 1), otherwise), plans)
