"""Export of results in the format of raw data that marl-eval reads (Gorsane et al., NeurIPS 2022).

A run is one fleet, training and seed of an instance. A policy without trainings repeats its runs for each training of
the others, because marl-eval compares arrays of one shape.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any  # rows of a result file, and JSON

from fleet.errors import FleetError

ENVIRONMENT = "thermofleet"
"""Of instances whose name has no split before a slash."""
Key = tuple[int, int, int]
"""Fleet, training and seed."""
Runs = dict[Key, dict[str, list[float]]]


def to_marl_eval(rows: Iterable[Mapping[str, Any]], metrics: Sequence[str]) -> dict[str, Any]:
    """Results as JSON: environment → task → algorithm → run → step → metrics.

    The environment is the split of the instance (`test` of `test/0017`), the task the rest of its name, the algorithm
    the policy, with `@DIFFICULTY` if there are several. There is one step, the evaluation, which `absolute_metrics`
    repeats.

    Args:
        rows: With policy, instance, fleet, training, seed, difficulty and the metrics.
        metrics: Names of figures.

    Raises:
        FleetError: a run that is missing or given twice, a figure that is not finite, or names that differ by case
            only, which marl-eval ignores.
    """
    tasks: dict[tuple[str, str], dict[str, Runs]] = {}
    rows = list(rows)
    several = len({row["difficulty"] for row in rows}) > 1
    for row in rows:
        environment, _, task = str(row["instance"]).rpartition("/")
        algorithm = str(row["policy"]).replace(",", ";") + (f"@{row['difficulty']}" if several else "")
        runs = tasks.setdefault((environment or ENVIRONMENT, task), {}).setdefault(algorithm, {})
        key = (int(row["fleet"]), int(row["training"]), int(row["seed"]))
        figures = {name: [float(row[name])] for name in metrics}
        bad = [name for name, (value,) in figures.items() if not math.isfinite(value)]
        if key in runs or bad:
            what = f"has no finite {bad[0]}" if bad else "is given twice"
            raise FleetError(f"{_run_name(algorithm, str(row['instance']), key)} {what}.")
        runs[key] = figures
    algorithms = {name for each in tasks.values() for name in each}
    for names in (algorithms, {"/".join(task) for task in tasks}):
        if len({name.lower() for name in names}) < len(names):
            raise FleetError(f"marl-eval ignores case, so names must differ by more (got {', '.join(sorted(names))}).")
    result: dict[str, Any] = {}
    for (environment, task), by_algorithm in tasks.items():
        keys = sorted({key for runs in by_algorithm.values() for key in runs})
        result.setdefault(environment, {})[task] = {
            name: {
                f"run_{n}": _steps(_figures(by_algorithm.get(name, {}), key, name, f"{environment}/{task}"))
                for n, key in enumerate(keys, start=1)
            }
            for name in sorted(algorithms)
        }
    counts = {len(runs) for each in result.values() for task in each.values() for runs in task.values()}
    if len(counts) > 1:
        raise FleetError(f"marl-eval needs as many runs of every instance (got {', '.join(map(str, sorted(counts)))}).")
    return result


def _figures(runs: Runs, key: Key, algorithm: str, instance: str) -> dict[str, list[float]]:
    trainings = {training for _, training, _ in runs}
    own = (key[0], min(trainings), key[2]) if len(trainings) == 1 else key
    if own not in runs:
        raise FleetError(f"{_run_name(algorithm, instance, key)} is missing.")
    return runs[own]


def _steps(figures: dict[str, list[float]]) -> dict[str, Any]:
    return {"step_1": {"step_count": 1, **figures}, "absolute_metrics": figures}


def _run_name(algorithm: str, instance: str, key: Key) -> str:
    return f"{algorithm} on {instance}, fleet {key[0]}, training {key[1]}, seed {key[2]}"
