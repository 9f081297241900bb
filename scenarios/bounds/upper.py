"""Upper bound of the reward of a shift."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, vstack

from scenarios.bounds.heat_budget import HeatBudget
from scenarios.bounds.relaxation import Relaxation

Array = np.ndarray

ROUNDS = 3
"""Most times that heat budgets are added."""


LEAST_GAIN = 1e-3
"""No more budgets are added once they lower the bound by less than this share."""
MOST_COLUMNS = 12_000
"""Programs with more columns, of some 40 arms, keep the bound with parts of jobs: whole ones take minutes."""
GAP = 5e-4
"""The branch and bound ends once bound and solution differ by this share."""
ROUNDING = 1e-6
"""Share added to a bound that a solver computed in floating point."""


@dataclass(frozen=True, eq=False)
class UpperBound:
    """An upper bound and how it was found."""

    reward: float
    """No policy has more."""
    linear: float
    """The bound with parts of jobs, without heat."""
    budgets: int
    """Number of heat budgets used."""


def upper_bound(relaxation: Relaxation, *, heat: bool = True, nodes: int = 2000) -> UpperBound:
    """The upper bound of a relaxation: with whole jobs, and with the heat budgets that its solution in parts passes.

    Args:
        nodes: Most nodes of the branch and bound; what it has proved by then counts. 0: the linear program alone.
    """
    rows, bounds = relaxation.rows
    linear, shares = _solve(relaxation, rows, bounds)
    value, count, budget = linear, 0, HeatBudget(relaxation)
    for _ in range(ROUNDS if heat and nodes else 0):
        more, limits = budget.violated(shares)
        if not len(limits):
            break
        faults, none = budget.losses()
        rows, bounds = csr_array(vstack([rows, faults, more])), np.concatenate([bounds, none, limits])
        count += len(limits)
        better, shares = _solve(relaxation, rows, bounds)
        gain, value = value - better, min(value, better)
        if gain < LEAST_GAIN * abs(value):
            break
    if nodes:
        value = min(value, _whole(relaxation, rows, bounds, nodes))
    return UpperBound(value + relaxation.constant, linear + relaxation.constant, count)


def _solve(relaxation: Relaxation, rows: csr_array, bounds: Array) -> tuple[float, Array]:
    """Bound with parts of jobs by the dual prices of the rows, and the solution, [column].

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


def _whole(relaxation: Relaxation, rows: csr_array, bounds: Array, nodes: int) -> float:
    """Bound with whole jobs; inf if branch and bound proved none, or if the program is too large."""
    if relaxation.columns > MOST_COLUMNS:
        return np.inf
    whole = np.zeros(relaxation.columns)
    whole[relaxation.job_columns()] = 1
    result = milp(
        -relaxation.worth,
        constraints=LinearConstraint(rows, -np.inf, bounds),  # pyright: ignore[reportArgumentType]
        bounds=Bounds(0.0, relaxation.most),  # pyright: ignore[reportArgumentType]  # SciPy's stubs allow no arrays
        integrality=whole,
        options={"node_limit": nodes, "mip_rel_gap": GAP},
    )
    if result.mip_dual_bound is None:
        return np.inf
    return -result.mip_dual_bound + ROUNDING * (1.0 + abs(result.mip_dual_bound))
