"""A comparison as text, and as one HTML file that opens offline: verdict, intervals, charts and its command."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any  # values of a card, and of Plotly's schema

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from scenarios.evaluate.comparison import Comparison, by_reward, failures_by_policy
from scenarios.evaluate.scores import FEWEST, HEADS, Normalised, SuiteScores, ranked, score_cells, scores_of
from scenarios.evaluate.statistics import LEGEND, LEVEL, Interval, profile
from scenarios.policy_loader import is_on_bus, label
from scenarios.show import charts
from scenarios.show.charts import COLOURS, LAYOUT, MARGIN, SYMBOLS, Figure, Trace, axis, plain
from scenarios.show.page import Chart, Head, Page, Section
from scenarios.show.words import value_text
from scenarios.table import Table

Array = np.ndarray
Range = tuple[float, float, float]
"""A value with its lower and upper bound."""

CHOICE = "Intervals are not adjusted for the choice of the best policy; its significance is (Bonferroni)."
MOST_CURVES = 8
"""Policies in the chart of profiles: the best ones, and the baseline."""
THRESHOLDS = np.linspace(-0.5, 1.1, 81)
WORST = -1.5
"""Scores below are cut in charts."""
ROW_PX = 24
"""Of `spans`."""
NAME = 28
"""Most characters of a policy's name in a chart."""


def score_table(scores: SuiteScores, labels: Mapping[str, str] | None = None) -> Table:
    """Normalised scores of all policies, the best first."""
    rows = [((labels or {}).get(name, label(name)), *score_cells(scores, name)) for name in ranked(scores)]
    return Table(head=HEADS, rows=tuple(rows))


def narrow_score_tables(scores: SuiteScores) -> tuple[Table, Table]:
    """The table of scores in two parts, each narrow enough for 80 columns."""
    table = score_table(scores)
    return table.select(0, 1, 2, 3, 7), table.select(0, 4, 5, 6)


def result_text(result: Comparison) -> Group:
    """The table of a comparison, then its scores, illegal actions and failures, for a console of rich."""
    parts: list[RenderableType] = [result.table] if result.figures else []
    if result.scores:
        title = f"\nNormalised scores, paired difference to {label(result.baseline)}, {LEGEND}"
        parts += [Text(title), *narrow_score_tables(result.scores), *map(Text, result.scores.remarks)]
    elif result.figures:
        parts.append(Text(_no_scores(result)))
    if illegal := _illegal([result]):
        parts.append(Text(illegal))
    parts += [Text(f"\n{sentence}\n{trace}".rstrip()) for sentence, trace in _failures([result])]
    return Group(*parts)


def _failures(results: Sequence[Comparison]) -> list[tuple[str, str]]:
    """Number of failures of each policy and its first one, a sentence and a traceback; the most failures first."""
    failures = [each for result in results for each in result.failures]
    return [
        (f"{label(policy)} failed in {count} shift{'s' * (count > 1)}, first in {first.text}", first.trace)
        for policy, count, first in failures_by_policy(failures)
    ]


def _no_scores(result: Comparison) -> str:
    """Why a comparison has no normalised scores."""
    if result.randomise:
        return "No normalised scores: references are of shifts without randomisation."
    have = f"{result.referenced or 'none'} of {result.scenario} {'has' if result.referenced < 2 else 'have'} one"
    return (
        f"No normalised scores: they need {FEWEST} or more shifts with a reference of the same scenario and seed, and "
        f"{have}. Make them with thermofleet bounds, then compare with --references FILE."
    )


def _replaced_baseline(result: Comparison) -> str:
    """That the baseline failed, and which policy takes its place; "" if it did not."""
    if not result.failed_baseline:
        return ""
    if not result.figures:
        return "Every policy failed."
    return f"The baseline {label(result.failed_baseline)} failed: differences are to {label(result.baseline)}."


def _illegal(results: Sequence[Comparison]) -> str:
    """Number of illegal actions of each policy in a sentence; "" for none."""
    illegal: dict[str, int] = {}
    for result in results:
        for policy, count in result.illegal.items():
            illegal[policy] = illegal.get(policy, 0) + count
    some = ", ".join(f"{label(policy)} {count}" for policy, count in illegal.items() if count)
    return f"Illegal actions, which count as waits: {some}." if some else ""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """The results of a page."""

    title: str
    results: Sequence[Comparison]
    """One for all instances, or one for each."""
    values: Normalised | None
    """Scores over all instances; None without references."""
    card: Mapping[str, Any]
    """Hashes, versions and settings of the study."""
    command: str
    """Command that repeats it."""

    @property
    def baseline(self) -> str:
        """That differences refer to."""
        return self.results[0].baseline

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Number of each policy by its label, for one look in all charts; the first ones have different colours."""
        order = (self.baseline, *(ranked(self.scores) if self.scores else ()), *self.results[0].scopes)
        return {label(policy): number for number, policy in enumerate(dict.fromkeys(order))}

    @property
    def scored(self) -> Normalised | None:
        """Scores, if there are some of the baseline: it has none if it failed."""
        return self.values if self.values and self.baseline in self.values.score else None

    @cached_property
    def scores(self) -> SuiteScores | None:
        """The figures of `scored`, which a single comparison has made."""
        if len(self.results) == 1:
            return self.results[0].scores
        return scores_of(self.scored, self.baseline) if self.scored else None


def comparison_page(judged: Judged) -> str:
    """The page; the same input gives the same text."""
    head = Head(sentences=verdict(judged))
    return Page(title=judged.title, sections=[*_sections(judged)], head=head, origin=_origin(judged)).html()


def _sections(judged: Judged) -> Iterator[Section]:
    base, scores = label(judged.baseline), judged.scores
    if scores:
        means, profiles = _score_charts(judged)
        how = (
            f"difference: paired, to {base}; {LEGEND}. IQM: mean of the middle half. better in: share of instances "
            "with a better score than the baseline. heat binds, it does not: mean scores in instances in which a "
            "policy that ignores heat is expected to fault, and in the others."
        )
        tables, remarks = (score_table(scores),), tuple(scores.remarks)
        own = {"sentences": remarks, "charts": (means,), "tables": tables, "how": how}
        yield Section(key="score", title="Normalised score", **own)
        how = (
            "Share of instances with a score above each threshold; bands: pointwise 95 % intervals of the best and of "
            f"{base}."
        )
        yield Section(key="profile", title="Performance profiles", charts=(profiles,), how=how)
    if cells := _cell_table(judged):
        how = "Mean normalised score; ● best of the column; number of instances in brackets."
        yield Section(key="cells", title="By cell or scenario", tables=(cells,), how=how)
    for number, result in enumerate(judged.results):
        where = f": {result.scenario}" if len(judged.results) > 1 else ""
        if chart := _heat_chart(result, number, judged.numbers):
            how = (
                "Lines: 95 % interval of each mean, not paired; the paired differences to "
                f"{label(result.baseline)} are in the table of all figures."
            )
            yield Section(key=f"heat-{number}", title=f"Value against heat{where}", charts=(chart,), how=how)
        key, title = f"figures-{number}", f"All figures{where}"
        if not result.figures:
            yield Section(key=key, title=title, failed=f"the baseline {label(result.baseline)} failed.")
            continue
        about = f"{result.scenario}, {result.unit}. Mean and paired difference to {label(result.baseline)}; {LEGEND}."
        settings = f"Channel: {result.channel_text}. Randomisation: {result.randomise.text}."
        about += f" Predictions: {', '.join(result.sources)}."
        scope, *groups = result.table.split()
        sentences = (f"{about} {settings}", *result.table.notes)
        yield Section(key=key, title=title, sentences=sentences, details=(*groups, scope))
    failures = tuple(_failures(judged.results))
    sentences = (_illegal(judged.results) or "No illegal action.", *(["No policy failed."] if not failures else []))
    yield Section(key="failures", title="Failures and illegal actions", sentences=sentences, details=failures)
    hashes = [f"{digest}  {name}" for name, digest in judged.card["instances"].items()]
    about = "Every shift is a row of results.parquet beside this page; study.json has these hashes."
    details = ((f"Hashes of {len(hashes)} scenario{'s' * (len(hashes) > 1)}", "\n".join(hashes)),)
    yield Section(key="rows", title="How to repeat", sentences=(judged.command, about), details=details)


def verdict(judged: Judged) -> list[str]:
    """The best policy against the baseline and against the second best, and those below the baseline, in sentences.

    The best one is chosen by its figures, so p-values count as many differences as there are other policies
    (Bonferroni). p-values of those below the baseline are those of the table (Holm).
    """
    values, scores, base = judged.scored, judged.scores, judged.baseline
    failed = {each.policy for result in judged.results for each in result.failures}
    last = [f"Failed: {', '.join(sorted(map(label, failed)))}; a policy with a failed shift has no figures."] * bool(
        failed
    )
    if replaced := _replaced_baseline(judged.results[0]):
        last.append(replaced)
    if values is None or scores is None:
        return [*_reward_verdict(judged.results), *([CHOICE] if len(judged.results[0].figures) > 1 else []), *last]
    best, *rest = ranked(scores)
    compared = [
        _against(other, values.difference(best, other), role, len(rest)) for other, role in _rivals(best, rest, base)
    ]
    sentences = [f"{label(best)} {'; it '.join(compared)}."] if compared else []
    whose = "Its mean score" if compared else f"The mean score of {label(best)}"
    among = f", the best of {len(scores.policies)} policies" if rest else ""
    unscored = [each for each in judged.results if each.scores is None and len(judged.results) > 1]
    scored = [each.scenario for each in judged.results if each.scores is not None]
    where = f" of {', '.join(scored)}" if unscored else ""
    sentences.append(
        f"{whose} is {scores.policies[best].mean.text()}{among}; random has 0, "
        f"and the best schedules that a search found for the {scores.instances} instances{where} have "
        f"{scores.reachable}."
    )
    sentences += _reward_verdict(unscored)
    sentences += _below({name: (each.difference, each.p_holm) for name, each in scores.policies.items()}, base)
    return [*sentences, *([CHOICE] if compared else []), *last]


def _below(differences: Mapping[str, tuple[Interval, float]], base: str) -> list[str]:
    """The policies that are significantly worse than the baseline, in a sentence.

    Args:
        differences: Of each policy to the baseline, with the p-value after Holm's correction.
    """
    names = [
        label(name) for name, (each, p_holm) in differences.items() if each.high < 0 and each.stars(p_holm) == "**"
    ]
    return [f"Significantly below the baseline {label(base)}: {', '.join(names)}."] if names else []


def _rivals(best: str, others: Sequence[str], base: str) -> Iterator[tuple[str, str]]:
    """What the best policy is compared with, each with its role: the baseline, and the first of the others."""
    if base not in (best, *others[:1]):
        yield base, "the baseline"
    for second in others[:1]:
        yield second, "the baseline and next policy" if second == base else "the next policy"


def _against(other: str, difference: Interval, role: str, tests: int) -> str:
    """`beats the baseline wspt by 0.12 [0.08, 0.16] in mean score`."""
    by = f"{difference.text()} in mean score"
    if difference.low > 0 and _significant(difference.p, tests):
        return f"beats {role} {label(other)} by {by}"
    among = f", not significant among {tests} policies" if difference.low > 0 else ""
    return f"is not shown to beat {role} {label(other)}: the difference is {by}{among}"


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
        best, *others = by_reward(result.figures)
        reward = f"{result.figures[best]['reward'].mean:.1f}"
        more: list[str] = []
        for other, role in _rivals(best, others, base):
            difference = result.lead if other == others[0] else result.figures[best]["reward"].to_base
            assert difference is not None
            significant = difference.excludes_zero and _significant(difference.p, len(others))
            doubt = "" if significant else " (not significant)" if result.draws > 1 else " (one seed: not tested)"
            more.append(f"{difference.text(1)} more than {role} {label(other)}{doubt}")
        rewards = {name: (each["reward"].to_base, each["reward"].p_holm) for name, each in result.figures.items()}
        sentences = [f"{'; '.join([f'{label(best)} has the most reward, {reward}', *more])}.", *_below(rewards, base)]
        yield where + " ".join(sentences)


def _score_charts(judged: Judged) -> list[Chart]:
    """Mean scores with their intervals, and profiles of the best policies and of the baseline."""
    values, scores = judged.scored, judged.scores
    assert values is not None
    assert scores is not None
    order = ranked(scores)
    means = [(label(name), scores.policies[name].mean) for name in order]
    rows = [(name, mean.mean, mean.low, mean.high) for name, mean in means]
    base = label(judged.baseline)
    title = "mean normalised score, 95 % interval"
    means_figure = spans(rows, judged.numbers, title, least=WORST, marked=base)
    chosen = order[:MOST_CURVES]
    if judged.baseline not in chosen:
        chosen = [*chosen[:-1], judged.baseline]
    bands, curves, share = list[Trace](), list[Trace](), "share of instances above"
    for name in chosen:
        value, low, high = profile(values.score[name], THRESHOLDS, groups=values.groups)
        look = charts.look_of(judged.numbers[label(name)])
        if name in (chosen[0], judged.baseline):
            bands.append(charts.band(THRESHOLDS, low, high, look["color"], showlegend=False))
        curves.append(charts.curve(plain(label(name), NAME), THRESHOLDS, value, look))
    axes = {
        "xaxis": axis("normalised score", range=THRESHOLDS[[0, -1]].tolist()),
        "yaxis": axis(share, range=[0, 1.02]),
    }
    profiles = {"data": [*bands, *curves], "layout": charts.WITH_LEGEND | axes}
    numbers = ", ".join(f"{name} {value:.2f}" for name, value, _, _ in rows)
    return [
        Chart(key="means", figure=means_figure, alt=f"mean normalised score: {numbers}"),
        Chart(key="profiles", figure=profiles, alt=f"{share} each normalised score of {', '.join(map(label, chosen))}"),
    ]


def _cell_table(judged: Judged) -> Table | None:
    """Mean score of each policy in each cell of a split, or in each scenario; None if there is only one."""
    values = judged.scored
    if values is None:
        return None
    names = sorted(set(values.cells))
    if len(names) < 2 or len(names) == len(values.instances):
        return None
    member = {name: np.array(values.cells) == name for name in names}
    order = sorted(values.score, key=lambda policy: -values.score[policy].mean())
    means = {policy: [float(values.score[policy][:, member[name]].mean()) for name in names] for policy in order}
    best = [max(column) for column in zip(*means.values(), strict=True)]
    rows = tuple(
        (label(policy), *(f"{v:.2f}{' ●' if v == top else ''}" for v, top in zip(own, best, strict=True)))
        for policy, own in means.items()
    )
    head = ("policy", *(f"{name.replace('_', ' ')} ({int(member[name].sum())})" for name in names))
    return Table(head=head, rows=rows)


def _heat_chart(result: Comparison, number: int, numbers: Mapping[str, int]) -> Chart | None:
    """Value against heat; None without figures."""
    figures = {label(name): (each["peak_c"], each["value"]) for name, each in result.figures.items()}
    rows = [(name, (x.mean, x.low, x.high), (y.mean, y.low, y.high)) for name, (x, y) in figures.items()]
    drawn = points(rows, numbers, "hottest motor, °C, mean over shifts", "value of finished jobs, mean over shifts")
    alt = f"value of finished jobs against the hottest motor of {', '.join(figures)}"
    return Chart(key=f"heat_{number}", figure=drawn, alt=alt) if rows else None


def _origin(judged: Judged) -> Table:
    """Code, versions, settings and policies of a study."""
    card = judged.card
    rows = [("code", str(card["code_hash"])), *((f"version of {k}", str(v)) for k, v in card["versions"].items())]
    rows += [(name, value_text(card[name])) for name in ("risk", "decision_limit_s")]
    rows += [("channel", judged.results[0].channel_text), ("randomise", judged.results[0].randomise.text)]
    for name, digest in card["policies"].items():
        without_file = "in another process, no file" if is_on_bus(name) else "of the code"
        rows.append((f"policy {label(name)}", digest or without_file))
    return Table(head=("", ""), rows=tuple(rows), numbers=False)


def spans(
    rows: Sequence[tuple[str, float, float, float]],
    numbers: Mapping[str, int],
    title: str,
    *,
    least: float,
    marked: str = "",
) -> Figure:
    """A row for each name: a point and its interval.

    Args:
        rows: Name, value, low and high.
        numbers: Of the look of each name.
        title: Of the axis.
        least: The axis begins here, so that one bad row does not squeeze the others; values below are written, and an
            interval that goes on is marked.
        marked: A name in bold.
    """
    names, values = [name for name, *_ in rows], np.array([row[1:] for row in rows])
    ends = values[np.isfinite(values)]
    low, high = max(least, float(ends.min())), float(ends.max())
    room = 0.04 * (high - low or 1.0)
    begin = low - room
    labels = [f"<b>{plain(name, NAME)}</b>" if name == marked else plain(name, NAME) for name in names]
    at = np.repeat(np.arange(len(rows))[:, None], 3, axis=1)
    cut = [
        {"text": f"◂ {value:.2f}" if value < begin else "◂", "x": begin, "y": y, "xanchor": "left", "showarrow": False}
        for y, (value, end, _) in enumerate(values.tolist())
        if min(value, end) < begin
    ]
    looks = [{"marker": {"color": charts.look_of(numbers[name])["color"], "size": 9}} for name in names]
    dots = [_dots(values[[n]], at[[n]], [name], look) for n, (name, look) in enumerate(zip(names, looks, strict=True))]
    return {
        "data": dots,
        "layout": LAYOUT
        | {"height": 12 + ROW_PX * len(rows) + MARGIN["b"], "margin": MARGIN | {"t": 12}}
        | {"annotations": cut, "showlegend": False}
        | {"xaxis": axis(title, range=[begin, high + room]), "yaxis": charts.named_rows(labels)},
    }


def points(rows: Sequence[tuple[str, Range, Range]], numbers: Mapping[str, int], x_title: str, y_title: str) -> Figure:
    """A point for each name, with its intervals.

    Args:
        rows: Name, x and y; each of the two with its lower and upper bound.
        numbers: Of the look of each name.
    """
    data = list[Trace]()
    for name, x, y in rows:
        n = numbers[name]
        marker = {"color": COLOURS[n % len(COLOURS)], "symbol": SYMBOLS[n // len(COLOURS) % len(SYMBOLS)], "size": 9}
        data.append(_dots(np.array([x]), np.array([y]), [name], {"name": plain(name, NAME), "marker": marker}))
    return {"data": data, "layout": charts.WITH_LEGEND | {"xaxis": axis(x_title), "yaxis": axis(y_title)}}


def _dots(x: Array, y: Array, names: Sequence[str], look: Trace) -> Trace:
    """Markers with their intervals, and their names as hover texts.

    Args:
        x, y: Value, low and high of each point, [point, 3]; NaN for an unknown end.
    """
    trace: Trace = {"type": "scatter", "mode": "markers", "x": x[:, 0].tolist(), "y": y[:, 0].tolist()}
    for name, values in (("x", x), ("y", y)):
        below, above = np.nan_to_num(np.abs(values[:, 1:] - values[:, :1]), posinf=0.0).T.tolist()
        bars = {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 1.5, "width": 0}
        trace[f"error_{name}"] = bars
    hover = {"customdata": [plain(name) for name in names], "hovertemplate": "%{customdata}: %{x:.3~f}<extra></extra>"}
    return trace | hover | look
