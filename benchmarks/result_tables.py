"""Tables of stored results, and their cells: benchmarks print them, `docs/tables.py` puts them into pages."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # values of JSON

import numpy as np

from scenarios.evaluate.rollout import KINDS as FIGURE_KINDS
from scenarios.evaluate.statistics import Figure, figures_of, paired, paired_counts
from scenarios.table import markdown_table as table


def difference(mean: float, low: float | None, high: float | None, digits: int = 1) -> str:
    """`**−6.0 (−10.4 … −2.5)**`: a difference with its interval, bold if that excludes 0; else the mean."""
    text = signed(mean, digits)
    if low is None or high is None or math.isnan(low + high):
        return text
    text += f" ({signed(low, digits)} … {signed(high, digits)})"
    return bold_if(low > 0 or high < 0, text)


def bold_if(shown: bool, text: str) -> str:
    """The text, bold where a difference is shown."""
    return f"**{text}**" if shown else text


def signed(value: float, digits: int = 1) -> str:
    """A number with its sign."""
    return f"{value:+.{digits}f}".replace("-", "−")


def read_json(path: Path) -> Any:
    """The content of a file of results."""
    return json.loads(path.read_text(encoding="utf-8"))


CHANNEL_COLUMNS = {
    "value": ("value", 1),
    "on_time": ("on time", 1),
    "faults": ("faults", 2),
    "above_warning_min": ("minutes above the warning limit", 0),
    "lost": ("rejected", 1),
}
"""Heading and decimals of a figure."""


def channel_table(measured: Mapping[str, Any]) -> str:
    """Means, and paired differences to the first channel with 95 % intervals, of each policy and channel.

    Args:
        measured: A result of `benchmarks/bench_channel.py`.
    """
    names: list[str] = list(measured["figures"])
    values = {(row["policy"], row["channel"]): np.array(row["values"]) for row in measured["rows"]}
    policies = dict.fromkeys(policy for policy, _ in values)
    rows: list[tuple[str, ...]] = []
    for (policy, channel), x in values.items():
        base = next(each for (other, _), each in values.items() if other == policy)
        cells = [_channel_cell(name, x[:, names.index(name)], base[:, names.index(name)]) for name in CHANNEL_COLUMNS]
        who = (f"`{policy}`",) if len(policies) > 1 else ()
        rows.append((*who, channel, *cells, f"{100 * x[:, names.index('received')].mean():.0f} %"))
    who = ("policy",) if len(policies) > 1 else ()
    return table((*who, "channel", *(heading for heading, _ in CHANNEL_COLUMNS.values()), "received"), rows)


def _channel_cell(name: str, x: np.ndarray, base: np.ndarray) -> str:
    digits = CHANNEL_COLUMNS[name][1]
    mean = f"{x.mean():.{digits}f}"
    if np.array_equal(x, base):
        return mean
    d = (paired_counts if name == "faults" else paired)(x, base)
    text = d.text(digits, "+")
    return f"{mean} ({bold_if(d.excludes_zero, text)})"


KINDS = ("interval", "events")
SHARES = (("env_choices", "env"), ("arm_choices", "arm"))
"""Steps with a choice, and all steps."""
STEP_HEADS = ("", "steps per shift: interval", "events", "times fewer", "env steps with a choice: interval", "events")


def steps_table(measured: dict[str, Any]) -> str:
    """The range over all policies, for each scenario."""
    rows: list[tuple[str, ...]] = []
    for scenario in dict.fromkeys(row["scenario"] for row in measured["rows"]):
        own = [row for row in measured["rows"] if row["scenario"] == scenario]
        counts = (_range(row[kind]["env"] for row in own) for kind in KINDS)
        fewer = _range(row["interval"]["env"] / row["events"]["env"] for row in own)
        shares = [
            _range((100 * row[kind][part] / row[kind][whole] for row in own), digits, " %")
            for part, whole in SHARES
            for kind, digits in zip(KINDS, (1, 0), strict=True)
        ]
        rows.append((f"`{scenario}`", *counts, fewer, *shares))
    return table((*STEP_HEADS, "arm steps with a choice: interval", "events"), rows)


def _range(values: Iterable[float], digits: int = 0, unit: str = "") -> str:
    shown = [f"{value:.{digits}f}" for value in sorted(values)]
    return (shown[0] if shown[0] == shown[-1] else f"{shown[0]}–{shown[-1]}") + unit


def env_table(measured: Mapping[str, Any]) -> str:
    """Speed of every environment, and its observations beside a copy of them.

    Args:
        measured: A result of `benchmarks/env.py`.
    """
    rows: list[tuple[str, ...]] = []
    for row in measured["rows"]:
        if "missing" in row:
            rows.append((row["what"], row["missing"], "", "", "", ""))
            continue
        speed, copied = row["observed_gb_per_s"], row["copied_gb_per_s"]
        cells = (f"{row[name]:,.0f}" for name in ("steps_per_s", "ns_per_agent_step", "observed_bytes"))
        shown = (np.format_float_positional(x, 2, fractional=False, trim="-") for x in (speed, 100 * speed / copied))
        rows.append((row["what"], *cells, *shown))
    heads = ("env", "env steps per CPU-second", "ns per agent step", "bytes observed per env step", "GB/s",
             "% of `np.copyto`")  # fmt: skip
    return table(heads, rows)


def env_ratios_table(measured: Mapping[str, Any]) -> str:
    """Ratios of rows of `env_table` with their goals, and the machine."""
    rows = [(each["what"], "–" if each["ratio"] is None else f"{each['ratio']:.3g}", each["goal"])
            for each in measured["ratios"]]  # fmt: skip
    load = measured["load_average"][0]
    machine = f"{measured['processor']}, {measured['cores']} cores, load {load:.1f}, Python {measured['python']}"
    memory = f"1024 envs with 8 arms take {measured['memory_mb']:.0f} MB. " if measured["memory_mb"] else ""
    return f"{table(('ratio', 'measured', 'goal'), rows)}\n\n{memory}Machine: {machine}."


def halls_table(path: Path) -> str:
    """The costs of halls of every size, from the rows of `benchmarks/scaling/arms.py`."""
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        per_arm = {name: 1000.0 * seconds / one["arms"] for name, seconds in one["cpu_s"].items()}
        once = (per_arm[name] for name in ("plans", "conflicts"))
        hourly = (per_arm[name] / one["hours"] for name in ("engine", "matching", "scores"))
        sizes = (str(one[name]) for name in ("arms", "halls"))
        rows.append((*sizes, *(f"{cost:.3g}" for cost in (*once, *hourly)), str(one["most_mb"])))
    heads = ("plans, ms per arm", "conflict table, ms per arm")
    heads += tuple(f"{name}, ms per arm and hour" for name in ("engine", "matching", "twins"))
    return table(("arms", "halls", *heads, "peak memory, MB"), rows)


SAME = 1e-9
"""Share of a reward within which it counts as the same: decisions were, and sums were rounded in another order."""


def processor_sentence(measured: dict[str, Any]) -> str:
    """How many shifts have another reward, and how far apart the others are."""
    policies = " and ".join(f"`{name}`" for name in measured["policies"])
    share = measured["largest_share"]
    apart = "all are equal to the last bit" if not share else f"the others differ by at most {share:.0e} of the reward"
    return (
        f"{measured['instances']} instances of the test split, {policies}: {len(measured['other_reward'])} of "
        f"{measured['shifts']} shifts have a reward that differs by more than {SAME:g} of it; {apart}."
    )


Array = np.ndarray
Shift = tuple[int, int, int]
"""Fleet, training and seed."""

FIGURES = ("faults", "value", "reward")


@dataclass(frozen=True)
class StoredAblation:
    """The shifts of a folder, by POLICY@SOURCE, or by SOURCE alone of the policy that all others have."""

    shifts: Mapping[str, Mapping[Shift, Mapping[str, float]]]
    """Figures by name."""
    shape: tuple[int, int, int]
    """Fleets, trainings and seeds."""
    first_seed: int

    def effects(self, first: str) -> dict[str, dict[str, Figure]]:
        """Figures by name of each policy and source, with differences to the first one."""
        names = (first, *(name for name in self.shifts if name != first))
        values = {name: {figure: self._values(name, figure) for figure in FIGURES} for name in names}
        return figures_of(values, first, FIGURE_KINDS)

    def _values(self, name: str, figure: str) -> Array:
        """[fleet, training, seed]; the same for every training if the source has none."""
        fleets, trainings, seeds = self.shape
        of = self.shifts[name]
        own = {training for _, training, _ in of}

        def value(fleet: int, training: int, seed: int) -> float:
            return of[fleet, training if training in own else 0, self.first_seed + seed][figure]

        return np.array(
            [[[value(f, t, s) for s in range(seeds)] for t in range(trainings)] for f in range(fleets)],
            dtype=float,
        )


def stored(folder: Path) -> StoredAblation:
    """The content of the folder of a comparison."""
    from scenarios.evaluate.store import read_rows

    rows = read_rows(folder)
    policies = {row.key.policy for row in rows}
    shifts = _by_name(
        (
            key.difficulty if len(policies) == 1 else f"{key.policy}@{key.difficulty}",
            (key.fleet, key.training, key.seed),
            {name: getattr(row.outcome, name) for name in FIGURES},
        )
        for row in rows
        for key in [row.key]
    )
    fleets, trainings, seeds = (len({shift[k] for of in shifts.values() for shift in of}) for k in range(3))
    return StoredAblation(shifts, (fleets, trainings, seeds), min(row.key.seed for row in rows))


def _by_name(
    rows: Iterable[tuple[str, Shift, Mapping[str, float]]],
) -> dict[str, dict[Shift, Mapping[str, float]]]:
    found: dict[str, dict[Shift, Mapping[str, float]]] = {}
    for name, shift, figures in rows:
        found.setdefault(name, {})[shift] = figures
    return found
