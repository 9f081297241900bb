"""Tables of the studies: means over seeds with 95 % intervals."""

from collections.abc import Callable, Sequence
from math import isfinite

import numpy as np

from scenarios.evaluate.statistics import interval
from scenarios.report.page import Table
from scenarios.studies.lifetime.arm_transfer import FURTHER, NOTHING, RESCALED, STARTS, Cell
from scenarios.studies.lifetime.augmentation import DATA, NETWORK, REAL, Fitted
from scenarios.studies.lifetime.drift import D_CAL, NEVER, NONE, P_VALUE, THERMAL, WATCHED, DriftSize, Life, delay_days
from scenarios.studies.lifetime.latent_features import INPUTS, Estimate
from scenarios.studies.transfer import REGRESSORS


def transfer_tables(cells: Sequence[Cell]) -> tuple[Table, ...]:
    """Error by start and number of jobs for each second arm, and what a start from the first arm saves."""
    targets, jobs = dict.fromkeys(cell.target for cell in cells), cells[0].curve(NOTHING)[0].tolist()

    def of(target: str, start: str, count: int, name: str) -> str:
        rows = [
            row
            for cell in cells
            if cell.target == target
            for row in cell.trained
            if (row.start, row.jobs) == (start, count)
        ]
        known = [value for row in rows if isfinite(value := getattr(row, name))]  # AUROC needs hot and cool jobs
        return interval(known).text(3) if known else "unknown"

    errors = tuple(
        (f"{target}, {start}", *(of(target, start, count, "error") for count in jobs))
        for target in targets
        for start in STARTS
    )
    saved = []
    for target in targets:
        some = [cell for cell in cells if cell.target == target]
        ratios = [interval([cell.data_ratio(start) for cell in some]).text() for start in (RESCALED, FURTHER)]
        unchanged = interval([cell.unchanged_error for cell in some]).text(3)
        cpu = [of(target, start, jobs[-1], "cpu_s").split(" ")[0] for start in (NOTHING, FURTHER)]
        auroc = [of(target, start, jobs[-1], "auroc").split(" ")[0] for start in (NOTHING, FURTHER)]
        saved.append((target, unchanged, *ratios, " → ".join(cpu), " → ".join(auroc)))
    return (
        Table(
            head=("second arm, start", *(f"{count} jobs" for count in jobs)),
            rows=errors,
            caption="Mean |x − x̂| of held-out cool jobs, in standard deviations of the arm's motion",
        ),
        Table(
            head=(
                "second arm",
                "first twin unchanged",
                f"data, {RESCALED}",
                f"data, {FURTHER}",
                "CPU s",
                "AUROC of d_2",
            ),
            rows=tuple(saved),
            caption=f"Error of the first twin; data: number of jobs that give the error of {jobs[-1]} jobs from "
            f"nothing, divided by {jobs[-1]} (at least {jobs[0] / jobs[-1]:g}); CPU seconds and AUROC with {jobs[-1]} "
            f"jobs, {NOTHING} → {FURTHER}",
        ),
    )


def feature_tables(rows: Sequence[Estimate]) -> tuple[Table, ...]:
    """R² by target, number of jobs and input."""
    keys = dict.fromkeys((row.target, row.labels) for row in rows)

    def r2(target: str, labels: int, inputs: str) -> str:
        return interval([r.r2 for r in rows if (r.target, r.labels, r.inputs) == (target, labels, inputs)]).text()

    return (
        Table(
            head=("target, jobs", *INPUTS),
            rows=tuple((f"{t}, {n} jobs", *(r2(t, n, each) for each in INPUTS)) for t, n in keys),
            caption="R² of ridge regressions, cross-validated by job",
        ),
    )


def augmentation_tables(rows: Sequence[Fitted]) -> tuple[Table, ...]:
    """Error by training data, and its paired difference to the measured jobs alone."""
    counts = dict.fromkeys(row.measured for row in rows)

    def values(count: int, data: str, regressor: str, name: str) -> np.ndarray:
        key = count, data, regressor
        return np.array([getattr(r, name) for r in rows if (r.measured, r.data, r.regressor) == key])

    def cells(count: int, data: str, regressor: str) -> tuple[str, ...]:
        found = []
        for name in ("cool_rmse_k", "all_rmse_k"):
            own, base = values(count, data, regressor, name), values(count, REAL, regressor, name)
            found += [f"{own.mean():.2f}", "" if data == REAL else interval(own - base).text()]
        return tuple(found)

    table = tuple(
        (f"{count} jobs, {regressor}: {data}", *cells(count, data, regressor))
        for count in counts
        for regressor in REGRESSORS
        for data in DATA
    )
    alone = tuple(
        (
            NETWORK,
            f"{values(count, NETWORK, 'none', 'cool_rmse_k').mean():.2f}",
            "",
            f"{values(count, NETWORK, 'none', 'all_rmse_k').mean():.2f}",
            "",
        )
        for count in list(counts)[:1]
    )
    return (
        Table(
            head=("measured jobs, regressor: data", "cool jobs, K", "difference", "all jobs, K", "difference"),
            rows=(*table, *alone),
            caption="RMSE of the peak temperature, and its paired difference to the measured jobs only",
        ),
    )


def drift_tables(lives: Sequence[Life], size: DriftSize) -> tuple[Table, ...]:
    """Delay and false alarms by what changes, and errors and cost by policy."""
    kinds = dict.fromkeys(life.kind for life in lives)
    policies = dict.fromkeys(life.policy for life in lives)

    def some(kind: str, policy: str) -> list[Life]:
        return [life for life in lives if (life.kind, life.policy) == (kind, policy)]

    first = NEVER if NEVER in policies else next(iter(policies))
    noticed = tuple(
        (kind, *(_delays([delay_days(life, size.onset, (name,)) for life in some(kind, first)]) for name in WATCHED))
        for kind in kinds
    )
    before = [life for life in lives if life.policy == first]
    watched_days = sum((size.days if life.kind == NONE else size.onset) - size.reference for life in before)
    false = tuple(f"{100 * sum(_false(life, name, size) for life in before) / watched_days:.2f}" for name in WATCHED)
    measures: dict[str, Callable[[Life], float]] = {
        "peak error, K": lambda life: life.peak_rms_k,
        "p ≤ 5 %, %": lambda life: 100 * life.cool_flagged,
        "retrained": lambda life: float(len(life.retrainings)),
        "CPU s": lambda life: life.cpu_s,
    }
    costs = tuple(
        (
            f"{kind}, {policy}",
            *(interval([of(life) for life in some(kind, policy)]).text(1) for of in measures.values()),
        )
        for kind in kinds
        for policy in policies
    )
    names = {D_CAL: "calibrated d", P_VALUE: "conformal p-value", THERMAL: "thermal residual"}
    return (
        Table(
            head=("change", *(names[name] for name in WATCHED)),
            rows=(*noticed, ("false alarms per 100 days", *false)),
            caption="Days from the onset to the first alarm, without retraining: median, and seeds with an alarm",
        ),
        Table(
            head=("change, retraining", *measures),
            rows=costs,
            caption=f"In the last {size.window} days: error of the predicted peak and share of cool jobs that are "
            "flagged; retrainings and their CPU seconds in all",
        ),
    )


def _delays(days: Sequence[float]) -> str:
    found = [day for day in days if np.isfinite(day)]
    return f"{np.median(found):.0f} ({len(found)} of {len(days)})" if found else f"– (0 of {len(days)})"


def _false(life: Life, name: str, size: DriftSize) -> int:
    """Alarms while the arm had not changed."""
    return sum(life.kind == NONE or day <= size.onset for day in life.alarms[name])
