"""Figures of several policies beside a baseline: means, paired differences, and Holm's correction over all of them."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import trim_mean

from scenarios.evaluate.statistics import Interval, count_interval, holm, interval, paired, paired_counts, share_bounds

Array = np.ndarray

LEGEND = "95 % intervals; * excludes 0, ** also after Holm's correction over the table"
EQUAL = "all equal"
HEAD = ("", "mean", "interval", "difference", "interval", "")
MORE_DIGITS = 3
"""Decimals that a row may have beyond the least, so that no interval that excludes 0 seems to include it."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of one policy, and its paired difference to that of the baseline."""

    mean: float
    iqm: float
    """Interquartile mean (Agarwal et al., NeurIPS 2021)."""
    low: float
    high: float
    """95 % interval of the mean; NaN where the values do not determine it."""
    note: str
    """What the interval rests on if not on the spread of the values, or why there is none."""
    difference: float
    """Mean paired difference to the baseline."""
    difference_low: float
    difference_high: float
    difference_note: str
    p: float
    """Of no difference; NaN without a test."""
    p_holm: float
    """Adjusted for all differences of the table."""

    @property
    def to_base(self) -> Interval:
        """The difference to the baseline."""
        return Interval(self.difference, self.difference_low, self.difference_high, self.p, self.difference_note)

    @property
    def stars(self) -> str:
        """As `LEGEND` says."""
        return self.to_base.stars(self.p_holm)


def figures_of(
    values: Mapping[str, Mapping[str, Array]],
    baseline: str,
    *,
    counts: Collection[str] = (),
    possible: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, dict[str, Figure]]:
    """The figures of every policy, by policy and name.

    Args:
        values: By policy and name of the figure, [seed] or [fleet, training, seed], the same for every policy.
        baseline: The policy that differences refer to.
        counts: Names of counts of rare events; see `counts.count_interval`.
        possible: Smallest and largest possible value by name.
    """
    possible, made = possible or {}, dict[tuple[str, str], tuple[Interval, Interval]]()
    for policy, figures in values.items():
        for name, x in figures.items():
            least, most = possible.get(name, (-math.inf, math.inf))
            own = count_interval(x) if name in counts else interval(x, least=least, most=most)
            to_base = (paired_counts if name in counts else paired)(x, values[baseline][name])
            made[policy, name] = own, Interval(0.0, 0.0, 0.0) if policy == baseline else to_base
    adjusted = dict(zip(made, holm([to_base.p for _, to_base in made.values()]).tolist(), strict=True))
    return {
        policy: {name: _figure(*made[policy, name], x, adjusted[policy, name]) for name, x in figures.items()}
        for policy, figures in values.items()
    }


def _figure(own: Interval, to_base: Interval, values: Array, p_holm: float) -> Figure:
    return Figure(
        mean=own.mean,
        iqm=float(trim_mean(values.ravel(), 0.25)),
        low=own.low,
        high=own.high,
        note=own.note,
        difference=to_base.mean,
        difference_low=to_base.low,
        difference_high=to_base.high,
        difference_note=to_base.note,
        p=to_base.p,
        p_holm=p_holm if p_holm == p_holm else math.nan,  # one object, so that equal results compare equal
    )


def figure_rows(
    figures: Mapping[str, Figure], baseline: str, label: Callable[[str], str], least_digits: int = 1
) -> list[tuple[str, ...]]:
    """A row of `HEAD` for each policy: mean and paired difference, each with its interval."""
    digits, rows = _digits(list(figures.values()), least_digits), list[tuple[str, ...]]()
    for policy, f in figures.items():
        cells = (label(policy), f"{f.mean:z.{digits}f}", _span(f.low, f.high, digits))
        if policy == baseline:
            rows.append((*cells, "", "", ""))
            continue
        low, high = (round(bound, digits) for bound in (f.difference_low, f.difference_high))
        stars = f.stars if low > 0 or high < 0 else ""
        rows.append((*cells, f"{f.difference:+z.{digits}f}", _span(low, high, digits, "+"), stars))
    return rows


def remarks(figures: Mapping[str, Mapping[str, Figure]], draws: int) -> Iterator[str]:
    """What a reader of the table must know of cells without variation.

    Args:
        draws: Independent values that the intervals rest on.
    """
    notes = [note for each in figures.values() for f in each.values() for note in (f.note, f.difference_note)]
    if any(np.isnan(f.low + f.difference_low) for each in figures.values() for f in each.values()):
        most = share_bounds(0, draws)[1]
        yield f"{EQUAL}: no variation in {draws}, which is not certainty; up to {most:.0%} of all may differ."
    if any(note.endswith("Poisson") for note in notes):
        yield "Counts without an event have the exact bound of a Poisson mean."


def _span(low: float, high: float, digits: int, sign: str = "") -> str:
    return EQUAL if np.isnan(low + high) else f"{low:{sign}z.{digits}f} … {high:{sign}z.{digits}f}"


def _digits(figures: Sequence[Figure], least: int) -> int:
    """Decimals, up to `MORE_DIGITS` more than the least, with which no interval that excludes 0 seems to include it."""
    nearest = [min(abs(f.difference_low), abs(f.difference_high)) for f in figures if f.to_base.excludes_zero]
    enough = (n for n in range(least, least + MORE_DIGITS) if all(round(bound, n) for bound in nearest))
    return next(enough, least + MORE_DIGITS)
