"""The page of a comparison: one HTML file that opens offline, with verdict, intervals, charts and how to repeat."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isnan
from typing import Any  # values of a card

import numpy as np

from scenarios.evaluate.comparison import HEADINGS, LEAST_DIGITS, Comparison
from scenarios.evaluate.rollout import FIGURES
from scenarios.evaluate.scores import HEADS, Normalised, Scores, ranked, score_cells, scores_of
from scenarios.evaluate.statistics import LEVEL, Interval, profile
from scenarios.evaluate.tables import EQUAL, LEGEND, Figure, remarks
from scenarios.policy_loader import is_on_bus, label
from scenarios.report.page import escape, html_page, paragraph, table
from scenarios.trials.report.charts import Range, lines, points, spans

Array = np.ndarray

MOST_CURVES = 8
"""Policies in the chart of profiles: the best ones, and the baseline."""
MOST_FAILURES = 20
"""Failed shifts with their traceback."""
THRESHOLDS = np.linspace(-0.5, 1.1, 81)
WORST = -1.5
"""Scores below are cut in charts."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What a page is about."""

    title: str
    results: Sequence[Comparison]
    """One for all instances, or one for each."""
    values: Normalised | None
    """Scores over all instances; None without references."""
    card: Mapping[str, Any]
    """Of the study: hashes, versions and settings."""
    command: str
    """That repeats it."""

    @property
    def baseline(self) -> str:
        """That differences refer to."""
        return self.results[0].baseline

    @property
    def scored(self) -> Normalised | None:
        """Scores, if there are some of the baseline: it has none if it failed."""
        return self.values if self.values and self.baseline in self.values.score else None

    @cached_property
    def scores(self) -> Scores | None:
        """The figures of `scored`, which a single comparison has made."""
        if len(self.results) == 1:
            return self.results[0].scores
        return scores_of(self.scored, self.baseline) if self.scored else None


def comparison_page(judged: Judged) -> str:
    """The page; the same input gives the same text."""
    body = [
        *(paragraph(sentence, "verdict") for sentence in verdict(judged)),
        *_scores(judged),
        *_by_cell(judged),
        *_heat(judged),
        *(part for result in judged.results for part in _figures(result, alone=len(judged.results) == 1)),
        *_failures(judged),
        *_repeat(judged),
    ]
    return html_page(judged.title, body, narrow=True)


def verdict(judged: Judged) -> list[str]:
    """What came out, in sentences: the best policy against the baseline, and against the next one.

    The best one is chosen by its figures, so p-values count as many differences as there are other policies
    (Bonferroni).
    """
    values, scores, base = judged.scored, judged.scores, judged.baseline
    failed = {each.policy for result in judged.results for each in result.failures}
    last = [f"Failed: {', '.join(sorted(map(label, failed)))}; a policy with a failed shift has no figures."] * bool(
        failed
    )
    if values is None or scores is None:
        return [*_reward_verdict(judged.results), *last]
    best, *rest = ranked(scores)
    others = {base: "the baseline "} if best != base else {}
    others |= {name: "the next one, " for name in [name for name in rest if name != base][:1]}
    compared = [_against(other, values.difference(best, other), role, len(rest)) for other, role in others.items()]
    told = [f"{label(best)} {'; it '.join(compared)}."] if compared else []
    whose = "Its mean score" if compared else f"The mean score of {label(best)}"
    told.append(
        f"{whose} is {scores.policies[best].mean.text()}, the best of {len(scores.policies)} policies, where 0 is "
        f"random and 1 the best schedule known for each of {scores.instances} instances."
    )
    return [*told, *last]


def _against(other: str, difference: Interval, role: str, tests: int) -> str:
    """`beats the baseline wspt by 0.12 [0.08, 0.16] of the way from random to the best known`."""
    by = f"{difference.text()} of the way from random to the best known"
    if difference.low > 0 and _significant(difference.p, tests):
        return f"beats {role}{label(other)} by {by}"
    among = f", not significant among {tests} policies" if difference.low > 0 else ""
    return f"is not shown to beat {role}{label(other)}: the difference is {by}{among}"


def _significant(p: float, tests: int) -> bool:
    return p * tests < 1 - LEVEL


def _reward_verdict(results: Sequence[Comparison]) -> Iterator[str]:
    """By reward, for instances without references."""
    for result in results:
        where = f"{result.scenario}, {result.unit}: "
        if not result.figures:
            yield f"{where}no differences, as the baseline {label(result.baseline)} failed."
            continue
        base = result.baseline
        best, *others = sorted(result.figures, key=lambda name: -result.figures[name]["reward"].mean)
        reward = f"{result.figures[best]['reward'].mean:.1f}"
        if not others:
            yield f"{where}no policy has more reward than the baseline {label(base)} ({reward})."
            continue
        compared = best if best != base else others[0]
        figure = result.figures[compared]["reward"]
        span = figure.to_base.text(1)
        significant = figure.to_base.excludes_zero and _significant(figure.p, len(others))
        if best == base:
            doubt = "" if significant else ", which is not significant"
            yield (
                f"{where}no policy has more reward than the baseline {label(base)} ({reward}); "
                f"the difference of {label(compared)} to it is {span}{doubt}."
            )
            continue
        doubt = "" if significant else ", which is not significant"
        yield f"{where}{label(best)} has the most reward, {reward}; {span} more reward than {label(base)}{doubt}."


def _scores(judged: Judged) -> Iterator[str]:
    values, scores = judged.scored, judged.scores
    if values is None or scores is None:
        return
    order = ranked(scores)
    yield "<h2>Normalised score</h2>"
    yield from (paragraph(sentence, "faint") for sentence in scores.remarks)
    means = [(label(name), scores.policies[name].mean) for name in order]
    rows = [(name, mean.mean, mean.low, mean.high) for name, mean in means]
    yield spans(rows, "mean normalised score, 95 % interval", least=WORST, marked=label(judged.baseline))
    cells = [(label(name), *score_cells(scores, name)) for name in order]
    yield table(HEADS, cells, style="numbers scores")
    yield paragraph(
        f"difference: paired, to {label(judged.baseline)}; {LEGEND}. IQM: mean of the middle half. short of 1: mean "
        "shortfall, where scores above 1 count as 1 (optimality gap). better in: share of instances with a better "
        "score than the baseline. to bound: distance to the upper bound, of the way from random to it.",
        "faint",
    )
    yield "<h2>Performance profiles</h2>"
    about = f"bands: pointwise 95 % intervals of the best and of {label(judged.baseline)}"
    yield paragraph(f"Share of instances with a score above each threshold; {about}.", "faint")
    chosen = order[:MOST_CURVES]
    if judged.baseline not in chosen:
        chosen = [*chosen[:-1], judged.baseline]
    curves = {name: profile(values.score[name], THRESHOLDS, "both", groups=values.groups) for name in chosen}
    bands = {label(name): (each.share, each.low, each.high) for name, each in curves.items()}
    banded = {label(chosen[0]), label(judged.baseline)}
    yield lines(THRESHOLDS, bands, banded, "normalised score", "share of instances above")


def _by_cell(judged: Judged) -> Iterator[str]:
    """Mean score of each policy in each cell of a split, or in each scenario."""
    values = judged.scored
    if values is None:
        return
    names = sorted(set(values.cells))
    if len(names) < 2 or len(names) == len(values.instances):
        return
    member = {name: np.array(values.cells) == name for name in names}
    order = sorted(values.score, key=lambda policy: -values.score[policy].mean())
    means = {policy: [float(values.score[policy][:, member[name]].mean()) for name in names] for policy in order}
    best = [max(column) for column in zip(*means.values(), strict=True)]
    rows = [
        (label(policy), *(f"{v:.2f}{' ●' if v == top else ''}" for v, top in zip(own, best, strict=True)))
        for policy, own in means.items()
    ]
    head = ("policy", *(f"{name.replace('_', ' ')} ({int(member[name].sum())})" for name in names))
    yield "<h2>By cell or scenario</h2>"
    yield paragraph("Mean normalised score; ● best of the column; number of instances in brackets.", "faint")
    yield table(head, rows, style="numbers scores")


def _heat(judged: Judged) -> Iterator[str]:
    for result in judged.results:
        rows = [(label(name), _range(each["peak_c"]), _range(each["value"])) for name, each in result.figures.items()]
        if rows:
            yield f"<h2>Value against heat{'' if len(judged.results) == 1 else f': {escape(result.scenario)}'}</h2>"
            yield points(rows, "hottest motor, °C, mean over shifts", "value of finished jobs, mean over shifts")


def _range(figure: Figure) -> Range:
    return figure.mean, figure.low, figure.high


def _figures(result: Comparison, *, alone: bool) -> Iterator[str]:
    """Every figure of every policy, with the difference to the baseline."""
    yield f"<h2>All figures{'' if alone else f': {escape(result.scenario)}'}</h2>"
    if not result.figures:
        yield paragraph(f"None: the baseline {label(result.baseline)} failed.", "status bad")
        return
    about = f"{result.scenario}, {result.unit}. Mean [interval] and paired difference to {label(result.baseline)}"
    settings = f"Channel: {result.channel_text}. Randomisation: {result.randomise.text}."
    yield paragraph(f"{about}; {LEGEND}. {settings}", "faint")
    yield from (paragraph(sentence, "faint") for sentence in remarks(result.figures, result.draws))
    order = sorted(result.figures, key=lambda name: -result.figures[name]["reward"].mean)
    for name in FIGURES:
        digits = LEAST_DIGITS.get(name, 1)
        rows = []
        for policy in order:
            f = result.figures[policy][name]
            own = _with_equal(Interval(f.mean, f.low, f.high), digits)
            to_base = "" if policy == result.baseline else f"{_with_equal(f.to_base, digits)} {f.stars}".rstrip()
            rows.append((label(policy), own, to_base))
        summary = f"{HEADINGS[name]}"
        inner = table(("policy", "mean", "difference"), rows, style="numbers scores")
        yield f"<details{' open' if name == 'reward' else ''}><summary>{escape(summary)}</summary>{inner}</details>"


def _with_equal(figure: Interval, digits: int) -> str:
    """The text of an interval; values without variation say so."""
    return f"{figure.text(digits)} {EQUAL}" if isnan(figure.low + figure.high) else figure.text(digits)


def _failures(judged: Judged) -> Iterator[str]:
    yield "<h2>Failures and illegal actions</h2>"
    failures = [each for result in judged.results for each in result.failures]
    if not failures:
        yield paragraph("No policy failed.")
    for each in failures[:MOST_FAILURES]:
        where = f"{label(each.policy)}, {each.instance}, fleet {each.fleet}, training {each.training}, seed {each.seed}"
        yield paragraph(f"{where}: {each.error}", "bad")
        if each.trace:
            yield f"<details><summary>traceback</summary><pre>{escape(each.trace)}</pre></details>"
    if len(failures) > MOST_FAILURES:
        yield paragraph(f"{len(failures) - MOST_FAILURES} more are in results.parquet.", "faint")
    illegal: dict[str, int] = {}
    for result in judged.results:
        for policy, count in result.illegal.items():
            illegal[policy] = illegal.get(policy, 0) + count
    some = ", ".join(f"{label(policy)} {count}" for policy, count in illegal.items() if count)
    yield paragraph(f"Illegal actions, which count as waits: {some}." if some else "No illegal action.")


def _repeat(judged: Judged) -> Iterator[str]:
    yield "<h2>How to repeat</h2>"
    yield f'<pre class="command"><code>{escape(judged.command)}</code></pre>'
    card = judged.card
    rows = [("code", str(card["code_hash"])), *((f"version of {k}", str(v)) for k, v in card["versions"].items())]
    rows += [(name, _plain(card[name])) for name in ("risk", "channel", "randomise", "decision_limit_s")]
    rows += [(f"policy {label(name)}", digest or _without_file(name)) for name, digest in card["policies"].items()]
    yield table((), rows)
    hashes = [(name, digest) for name, digest in card["instances"].items()]
    yield f"<details><summary>Hashes of {len(hashes)} scenarios</summary>{table((), hashes)}</details>"
    yield paragraph("Every shift is a row of results.parquet beside this page; study.json has these hashes.", "faint")


def _without_file(policy: str) -> str:
    return "in another process, no file" if is_on_bus(policy) else "of the code"


def _plain(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(inner)}" for key, inner in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)
