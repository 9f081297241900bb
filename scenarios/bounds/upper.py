"""Upper bound of the reward of a shift."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, vstack

from scenarios.bounds.heat_budget import HeatBudget
from scenarios.bounds.relaxation import Relaxation

Array = np.ndarray

ROUNDS = 6
"""Most times that heat budgets are added."""


@dataclass(frozen=True, eq=False)
class UpperBound:
    """An upper bound and how it was found."""

    reward: float
    """No policy has more."""
    without_heat: float
    """The bound before heat budgets were added."""
    budgets: int
    """Number of heat budgets added."""
    shares: Array
    """Solution of the relaxation, [column]."""


def upper_bound(relaxation: Relaxation, *, heat: bool = True) -> UpperBound:
    """The upper bound of a relaxation, with heat budgets as far as they are violated."""
    rows, most = relaxation.rows
    value, shares = _solve(relaxation, rows, most)
    first, count, budget = value, 0, HeatBudget(relaxation)
    for _ in range(ROUNDS if heat else 0):
        more, bounds = budget.violated(shares)
        if not len(bounds):
            break
        rows, most = csr_array(vstack([rows, more])), np.concatenate([most, bounds])
        count += len(bounds)
        better, shares = _solve(relaxation, rows, most)
        value = min(value, better)
    return UpperBound(value + relaxation.constant, first + relaxation.constant, count, shares)


def _solve(relaxation: Relaxation, rows: csr_array, bounds: Array) -> tuple[float, Array]:
    """Bound by the dual prices of the rows, and the solution, [column].

    Any prices >= 0 give a valid bound, so rounding errors of the solver make it looser and never wrong
    (Neumaier & Shcherbina, Mathematical Programming 99, 2004).
    """
    worth, most = relaxation.worth, relaxation.most
    result = linprog(-worth, rows, bounds, bounds=np.stack([np.zeros(len(most)), most], axis=1), method="highs")
    if not result.success:
        raise ValueError(f"The relaxation of the shift could not be solved: {result.message}")
    prices = np.maximum(-result.ineqlin.marginals, 0.0)
    surplus = np.maximum(worth - rows.T @ prices, 0.0)
    return float(prices @ bounds + surplus @ most), result.x
