"""Comparisons of policies and sources: paired by seed, the same on any number of cores, and their page."""

import base64
import csv
import gzip
import io
import json
import math
import re
import shlex
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import plotly.graph_objects as go
import pytest
import typer
from plotly.offline import get_plotlyjs
from rich.console import Console
from scipy import stats

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.evaluate import runner
from scenarios.evaluate.comparison import Comparison, Failed, compare, comparisons, figures_table, scores_over_all
from scenarios.evaluate.rollout import FIGURES, KINDS, Outcome
from scenarios.evaluate.scores import HEADS, Shift
from scenarios.evaluate.sources import _Random
from scenarios.evaluate.statistics import Figure, interval
from scenarios.evaluate.store import read_rows
from scenarios.evaluate.study import Case, Row, RowKey, Study, suite_label
from scenarios.prepare.randomisation import Randomisation
from scenarios.show.comparison_page import Judged, comparison_page, points, result_text, spans, verdict
from scenarios.spec.load import load
from scenarios.spec.schema import Scenario
from scenarios.suite.splits import manifest
from scenarios.table import Table
from tests.scenarios.conftest import Known

POLICIES = ("random", "round_robin")


def compared(scenario: Scenario, plans: Path, workers: int, **changes) -> Comparison:
    how = {"policies": POLICIES, "seeds": range(3), "baseline": "round_robin"} | changes
    return compare(scenario, difficulty="blind", cache_dir=plans, workers=workers, **how)


def printed(result: Comparison) -> str:
    """The table of a comparison in 80 columns."""
    page = io.StringIO()
    Console(file=page, width=80).print(result.table)
    return page.getvalue()


def test_names_are_whole_and_no_figure_is_cut_in_80_columns() -> None:
    figure, names = "0.41 [0.35, 0.47]", ("train-pairs-*@oracle", "quickstart/0", "auction" * 9)
    table = Table(head=HEADS, rows=tuple((name, figure, f"-{figure}", "**", *[figure] * 4) for name in names))
    page = io.StringIO()
    Console(file=page, width=80).print(table)
    text = page.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert all(name in text.split() for name in names[:2])
    assert [text.split().count(part) for part in ("[0.35,", "0.47]")] == [6 * len(names)] * 2
    spans = [(name, "217.3", "214.1 … 220.5", "-16.4", "-19.9 … -12.8", "**") for name in names[:2]]
    table = Table.grouped(("", "mean", "interval", "difference", "interval", ""), {"reward": spans})
    Console(file=page, width=66).print(table)
    assert "  train-pairs-*@oracle" in page.getvalue()


def test_a_scenario_is_a_file_too_and_the_first_policy_the_default_baseline(small_toml, scenario, plans):
    policies = ["round_robin", "random"]
    first = compare(small_toml, policies, seeds=range(3), difficulty="blind", cache_dir=plans, workers=1)
    assert first == compared(scenario, plans, workers=1, policies=policies)


def test_what_takes_no_time_needs_no_worker(scenario, plans, monkeypatch):
    monkeypatch.setattr("scenarios.evaluate.runner.HERE_S", 1e9)  # on however slow a machine
    monkeypatch.setattr("scenarios.evaluate.runner.LocalWorker", None)
    told: list[tuple[str, float]] = []
    compared(scenario, plans, workers=2, progress=lambda stage, share: told.append((stage, share)))
    assert [share for stage, share in told if stage == "comparing"] == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"policies": ("rnd", "round_robin")}, "No policy 'rnd'; did you mean 'random'?"),
        ({"policies": ()}, "A comparison needs a policy and a seed (got policies: 0, seeds: 3)."),
        ({"policies": ("random", "random")}, "The policy 'random' is given twice"),
        ({"baseline": "coolest_first"}, "The baseline 'coolest_first' is not among the policies compared: random, "),
    ],
)
def test_a_comparison_that_makes_no_sense_is_told(scenario, plans, changes, sentence):
    with pytest.raises(FleetError) as error:
        compared(scenario, plans, workers=1, **changes)
    assert sentence in str(error.value)


def test_the_table_fits_eighty_columns_without_losing_a_word(scenario, plans):
    result = compared(scenario, plans, workers=1)
    text = printed(result)
    assert "…  " not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert tuple(field.name for field in fields(Outcome)) == FIGURES
    for name in (*(kind.heading for kind in KINDS.values()), *POLICIES):
        assert name in text
    figure = result.figures["random"]["peak_c"]
    row = text.partition(KINDS["peak_c"].heading)[2].splitlines()[1]
    mean, low, high, difference, *bounds = (float(number) for number in re.findall(r"[+-]?\d+\.\d+", row))
    assert [mean, low, high] == pytest.approx([figure.mean, figure.low, figure.high], abs=0.05)
    differences = [figure.difference, figure.difference_low, figure.difference_high]
    assert [difference, *bounds] == pytest.approx(differences, abs=0.05)


def shown(difference, low, high, p_holm):
    """Cells of a row of the table with this difference and its interval."""
    same = Figure(mean=1.0, iqm=1.0, low=1.0, high=1.0, note="", difference=0.0, difference_low=0.0,
                  difference_high=0.0, difference_note="", p=1.0, p_holm=1.0)  # fmt: skip
    other = replace(same, mean=-0.01, low=-0.04, difference=difference, difference_low=low, difference_high=high,
                    p_holm=p_holm)  # fmt: skip
    figures = {"a": dict.fromkeys(FIGURES, same), "b": dict.fromkeys(FIGURES, other)}
    result = Comparison("s", (0, 1), "2 seeds", 2, "a", figures, {"a": "arm", "b": "arm"}, PERFECT.described(), "")
    rows = [line.split() for line in printed(result).splitlines()]
    return rows[rows.index(["faults"]) + 2]


@pytest.mark.parametrize(
    ("values", "cells"),
    [
        ((-0.01, -0.02, 0.01, 1.0), "b 0.0 0.0 … 1.0 +0.0 +0.0 … +0.0"),
        ((0.3, 0.02, 0.5, 0.06), "b -0.01 -0.04 … 1.00 +0.30 +0.02 … +0.50 *"),
        ((-2.0, -3.0, -0.5, 0.04), "b 0.0 0.0 … 1.0 -2.0 -3.0 … -0.5 **"),
        ((1e-6, 1e-7, 1e-5, 0.01), "b -0.0100 -0.0400 … 1.0000 +0.0000 +0.0000 … +0.0000"),
        ((-0.2, math.nan, math.nan, math.nan), "b 0.0 0.0 … 1.0 -0.2 all equal"),
    ],
)
def test_no_starred_zero_and_no_negative_zero_is_shown(values, cells):
    assert shown(*values) == cells.split()


def test_the_scope_of_every_policy_is_shown_and_which_read_no_messages(scenario, plans):
    late = Channel(delay_s=10.0)
    for channel, said in ((PERFECT, False), (late, True)):
        result = compared(scenario, plans, workers=1, seeds=range(2), channel=channel)
        assert result.scopes == {"random": "arm", "round_robin": "central"}
        lines = [" ".join(line.split()) for line in printed(result).splitlines()]
        assert {"random arm", "round_robin central"} <= set(lines)
        assert ("Central policies read no messages: round_robin." in lines) is said


@pytest.mark.parametrize(
    ("seeds", "title"), [((3, 4, 5), "s, seeds 3 to 5 (u)"), ((1, 7), "s (u)"), ((0, 10**15), "s (u)")]
)
def test_a_title_names_seeds_that_follow_each_other(seeds, title):
    """Seeds of the suite's instances are 32-bit numbers; a range from the first to the last would take all memory."""
    result = Comparison("s", seeds, "u", 2, "a", {}, {}, PERFECT.described(), "")
    assert result.title == title


@pytest.mark.parametrize(("names", "text"), [("a, b,c", "a, b, c"), ("a,b,c,d", "a and 3 others"), ("test", "test")])
def test_picked_instances_are_no_range(names, text):
    assert suite_label(names) == text


REWARD = {"wspt": 10.0, "wsept": 14.0, "fifo": 6.0}


KNOWN_SHIFTS = {("quickstart", seed): Known(f"quickstart/{seed}", 0.0, 20.0, 40.0) for seed in range(6)}


@pytest.fixture
def study() -> Study:
    scenario = load("quickstart")
    case = Case(name=scenario.name, scenario=scenario, seeds=tuple(range(6)))
    return Study(policies=[*REWARD, "random"], cases=[case], difficulties=["blind"])


def rows_of(study: Study, error: str | None = None, failing: str = "random") -> list[Row]:
    """Rewards around those of `REWARD`; a policy fails in its last shift if there is an error."""
    blank, rng = Outcome(**dict.fromkeys(FIGURES, 0.0)), np.random.default_rng(0)
    rows: list[Row] = []
    for policy in study.policies:
        for seed in study.cases[0].seeds:
            key = RowKey(policy, study.cases[0].name, 0, 0, "blind", seed)
            reward = REWARD.get(policy, 0.0) + 0.5 * rng.normal()
            failed = error is not None and policy == failing and seed == 5
            rows.append(Row(key, None, 0, error, "line 3") if failed else Row(key, replace(blank, reward=reward), 2))
    return rows


def judged(study: Study, rows: list[Row], known: dict[Shift, Known], baseline: str = "wspt") -> Judged:
    return Judged(
        title="Comparison <here>",
        results=comparisons(study, rows, baseline, references=known),  # pyright: ignore[reportArgumentType]  # a stand-in
        values=scores_over_all(study, rows, known),  # pyright: ignore[reportArgumentType]
        card=study.card,
        command="thermofleet compare quickstart",
    )


def test_figures_of_a_suite_are_clustered_by_cell(study: Study):
    """Three cells of two instances each: the intervals are those of the means of the cells."""
    cells = dict[str, list[str]]()
    for line in manifest("test"):
        cells.setdefault(line.cell, []).append(line.name)
    names = [name for own in list(cells.values())[:3] for name in own[:2]]
    rewards = {"wspt": np.zeros(6), "wsept": np.array([1.0, 2.0, 5.0, 4.0, 9.0, 9.0])}
    several = replace(study, policies=[*rewards], cases=[replace(study.cases[0], name=n, seeds=(0,)) for n in names])
    blank = Outcome(**dict.fromkeys(FIGURES, 0.0))
    rows = [
        Row(RowKey(policy, name, 0, 0, "blind", 0), replace(blank, reward=float(reward)))
        for policy, own in rewards.items()
        for name, reward in zip(names, own, strict=True)
    ]
    (result,) = comparisons(several, rows, "wspt", "test")
    found, expected = result.figures["wsept"]["reward"], interval([1.5, 4.5, 9.0])
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert (found.difference_low, found.p) == pytest.approx((expected.low, expected.p))
    assert (result.unit, result.draws, found.iqm) == ("6 instances of 3 cells", 3, 5.0)


def test_randomised_shifts_have_no_normalised_scores(study: Study):
    warmer = replace(study, randomise=Randomisation(ambient_k=(0.0, 5.0)))
    plain, varied = (judged(each, rows_of(each), KNOWN_SHIFTS) for each in (study, warmer))
    assert plain.results[0].scores is not None
    assert varied.results[0].scores is None
    assert varied.values is None
    assert "Randomisation: ambient temperature +0 to +5 K." in comparison_page(varied)
    assert "Predictions: blind. Channel: complete. Randomisation: none." in comparison_page(plain)
    assert re.search(r">randomise</t.>\s*<t.[^>]*>none<", comparison_page(plain))
    assert "Hashes of 1 scenario<" in comparison_page(plain)


def test_the_page_says_who_beats_whom_and_loads_nothing(study: Study):
    rows = rows_of(study, "Oops: <script>alert(1)</script>")
    about = judged(study, rows, KNOWN_SHIFTS)
    first, second, below, choice, failed = verdict(about)
    mean = np.mean([row.outcome.reward for row in rows[6:12] if row.outcome]) / 20
    better = mean - np.mean([row.outcome.reward for row in rows[:6] if row.outcome]) / 20
    assert first.startswith(f"wsept beats the baseline and next policy wspt by {better:.2f} [")
    assert second.startswith(f"Its mean score is {mean:.2f} [")
    assert below == "Significantly below the baseline wspt: fifo."
    assert choice.startswith("Intervals are not adjusted for the choice of the best policy")
    assert failed.startswith("Failed: random;")
    page = comparison_page(about)
    assert page == comparison_page(about)
    packed, *drawn = re.findall(r'<script type="text/plain" id="\w+">([^<]*)</script>', page)
    assert gzip.decompress(base64.b64decode(packed)).decode() == get_plotlyjs()
    own = page.replace(packed, "")
    assert not re.search(r"https?://|src=", own)
    assert own.count("<script") == 1 + 1 + len(drawn)
    assert "Oops: &lt;script&gt;" in page
    assert "Illegal actions, which count as waits: wspt 12" in page
    assert page.count("data-drawn=") == len(drawn) == 3
    colours: dict[str, set[str]] = {}
    for figure in map(json.loads, drawn):
        go.Figure(figure)  # raises on any property or value that Plotly does not know
        for trace in figure["data"]:
            name = trace.get("name") or trace.get("customdata", [""])[0]
            colours.setdefault(name, set()).add((trace.get("marker") or trace["line"]).get("color"))
    assert {name: len(colours[name]) for name in ("wspt", "wsept", "fifo")} == {"wspt": 1, "wsept": 1, "fifo": 1}
    assert len(set.union(*(colours[name] for name in ("wspt", "wsept", "fifo")))) == 3


def test_the_first_policy_that_did_not_fail_takes_the_place_of_a_baseline_that_did(study: Study):
    about = judged(study, rows_of(study, "Oops", failing="wspt"), KNOWN_SHIFTS)
    *_, failed, replaced = verdict(about)
    assert failed.startswith("Failed: wspt;")
    assert replaced == "The baseline wspt failed: differences are to wsept."
    alone = replace(study, policies=["wspt"])
    (only,) = verdict(judged(alone, rows_of(alone), KNOWN_SHIFTS))
    assert only.startswith("The mean score of wspt is ")
    assert "best of" not in only
    assert "Normalised score" in comparison_page(about)


def test_text_and_page_name_every_failed_policy_once_with_its_number_of_failures(study: Study):
    about = judged(study, rows_of(study), {})
    failures = [
        Failed(f"mine.py:Bad{n}", "quickstart", 0, 0, seed, "Oops", "line 3") for n in range(9) for seed in (3, 4)
    ]
    about = replace(about, results=[replace(about.results[0], failures=tuple(failures))])
    console = Console(width=200)
    with console.capture() as told:
        console.print(result_text(about.results[0]))
    for text in (told.get(), comparison_page(about)):
        for n in range(9):
            assert text.count(f"Bad{n} failed in 2 shifts, first in quickstart, fleet 0, training 0, seed 3: Oops") == 1


def test_the_best_of_several_must_be_significant_among_them(study: Study):
    about = judged(study, rows_of(study), {})
    (result,) = about.results
    assert result.lead is not None
    for p, said in ((0.016, "wspt."), (0.02, "wspt (not significant).")):  # of three
        first, _ = verdict(replace(about, results=[replace(result, lead=replace(result.lead, p=p))]))
        assert said in first


def test_a_difference_of_one_seed_is_called_untested(study: Study):
    single = replace(study, cases=[replace(study.cases[0], seeds=(0,))])
    first, _ = verdict(judged(single, rows_of(single), {}, "fifo"))
    assert first.count("(one seed: not tested)") == 2
    assert "significant" not in first


@pytest.mark.parametrize(
    ("baseline", "others"),
    [
        ("wspt", ["the baseline and next policy wspt"]),
        ("fifo", ["the baseline fifo", "the next policy wspt"]),
        ("wsept", ["the next policy wspt"]),
    ],
)
@pytest.mark.parametrize("known", [KNOWN_SHIFTS, {}], ids=["scores", "rewards"])
def test_the_verdict_names_the_baseline_and_the_policy_that_is_second(study: Study, baseline, others, known):
    """Of wsept 14, wspt 10, fifo 6 and random 0; the differences are those of the means."""
    rows = rows_of(study)
    means = {p: np.mean([r.outcome.reward for r in rows if r.key.policy == p and r.outcome]) for p in study.policies}
    first, *more = verdict(judged(study, rows, known, baseline))
    worse = {"wspt": "fifo, random", "fifo": "random", "wsept": "wspt, fifo, random"}[baseline]
    assert f"Significantly below the baseline {baseline}: {worse}." in " ".join([first, *more])
    first = first.partition(" Significantly")[0]
    assert first.startswith("quickstart, 6 seeds, this fleet only: wsept has the most reward, 14.") == (not known)
    for other in others:
        more = means["wsept"] - means[other.split()[-1]]
        number = rf"{more / 20:.2f}" if known else rf"{more:.1f}"
        by = rf"beats {other} by {number} \[" if known else rf"{number} \[[^]]*\] more than {other}[;.]"
        assert re.search(by, first), (by, first)
    assert ("baseline" in first) == (baseline != "wsept")
    assert len(re.findall("wspt|fifo|random", first.partition("wsept")[2])) == len(others)


def test_charts_place_points_by_value():
    numbers = {"a": 0, "b": 1, "c": 2}
    chart = spans([("a", 0.0, -0.5, 0.5), ("b", 1.0, -7.0, 1.1), ("c", -9.0, -9.9, 2.0)], numbers, "score", least=-1.0)
    dots = chart["data"]
    assert [(dot["x"], dot["y"]) for dot in dots] == [([0.0], [0]), ([1.0], [1]), ([-9.0], [2])]
    assert [dot["error_x"]["array"][0] for dot in dots] == pytest.approx([0.5, 0.1, 11.0])
    assert [dot["error_x"]["arrayminus"][0] for dot in dots] == pytest.approx([0.5, 8.0, 0.9])
    assert chart["layout"]["xaxis"]["range"][0] > -2.0
    assert [(note["text"], note["y"]) for note in chart["layout"]["annotations"]] == [("◂", 1), ("◂ -9.00", 2)]
    unknown = float("nan")
    rows = [("a", (1.0, 0.5, 2.5), (2.0, unknown, unknown)), ("b", (1.0, 1.0, 1.0), (2.0, 2.0, 2.0))]
    one, two = points(rows, numbers, "x", "y")["data"]
    assert (one["name"], one["error_x"]["array"], one["error_x"]["arrayminus"]) == ("a", [1.5], [0.5])
    assert (one["error_y"]["array"], two["error_y"]["arrayminus"]) == ([0.0], [0.0])
    assert one["marker"] != two["marker"]


def test_a_comparison_is_one_table_in_every_form(study: Study):
    (result,) = judged(study, rows_of(study), {}).results
    figure = result.figures["wsept"]["reward"]
    text, html, markdown, lines = printed(result), result.table.html(), result.table.markdown(), result.table.csv()
    assert re.search(rf"^  wsept +{figure.mean:.1f} ", text, re.MULTILINE)
    assert f"<td>{figure.mean:.1f}</td>" in html
    assert f"| wsept | {figure.mean:.1f} |" in markdown
    assert f"reward,wsept,{figure.mean:.1f}," in lines
    assert result._repr_html_() == html
    assert replace(result, seeds=(7,)).title.startswith(f"{result.scenario}, seed 7 (")


def test_an_exported_figure_is_a_number_and_a_name_is_no_formula(study: Study):
    openpyxl = pytest.importorskip("openpyxl")
    (result,) = judged(study, rows_of(study), {}).results
    table = figures_table([result])
    formula = replace(table, rows=(*table.rows, ("=1+1", *table.rows[0][1:])))
    head, *rows = openpyxl.load_workbook(io.BytesIO(formula.content(".xlsx"))).active.iter_rows()
    of = {(row[1].value, row[2].value): row for row in rows}
    mean = dict(zip((cell.value for cell in head), of["reward", "wsept"], strict=True))["mean"].value
    assert mean == pytest.approx(result.figures["wsept"]["reward"].mean, rel=1e-5)
    assert (rows[-1][0].value, rows[-1][0].data_type) == ("=1+1", "s")
    assert table.content(".csv").decode().count("\n") == 1 + len(table.rows)


def test_an_export_names_the_first_failure_of_a_policy(study: Study):
    rows = [
        replace(row, outcome=None, error=f"Oops: {row.key.seed}", trace="line 7") if row.key.policy == "wspt" else row
        for row in rows_of(study)
    ]
    (result,) = judged(study, rows, {}).results
    head, *lines = csv.reader(io.StringIO(figures_table([result]).csv()))
    cells = [dict(zip(head, line, strict=True)) for line in lines]
    (failed,) = [each for each in cells if each["policy"] == "wspt"]
    first = result.failures[0]
    assert failed["figure"] == "failed shifts"
    assert int(failed["mean"]) == len(result.failures) == sum(row.error is not None for row in rows)
    assert failed["first_failure"] == f"{first.instance}, fleet 0, training 0, seed {first.seed}: {first.error}\nline 7"
    assert {each["first_failure"] for each in cells if each["policy"] != "wspt"} == {""}


def test_an_export_has_the_normalised_scores_of_the_page(study: Study):
    of_all = judged(study, rows_of(study), KNOWN_SHIFTS)
    assert of_all.scores is not None
    table = figures_table(of_all.results, of_all.scores)
    score = of_all.scores.policies["wsept"]
    (row,) = (row for row in table.rows if row[1:3] == ("normalised score", "wsept"))
    assert [float(cell) for cell in row[4:8]] == pytest.approx(
        [score.mean.mean, score.mean.low, score.mean.high, score.difference.mean], rel=1e-5
    )
    assert row[0] == of_all.results[0].scenario
    twice = figures_table([*of_all.results] * 2, of_all.scores).rows
    assert {row[0] for row in twice if row[1].startswith("normalised score")} == {"all"}


def test_only_texts_that_a_spreadsheet_would_compute_get_an_apostrophe():
    formulas = ("=1+1", "+49 30", "-2+3", "@SUM(A1)", " =x", '=HYPERLINK("a")')
    plain = ("-3.5", "+1", "-12 %", "-1,234.5", "1e-5", "4711/10", "–", "a=b", "")
    table = Table(head=("name",), rows=tuple((cell,) for cell in (*formulas, *plain)))
    _, *cells = csv.reader(io.StringIO(table.csv()))
    assert [text for (text,) in cells if text] == [*(f"'{text}" for text in formulas), *filter(None, plain)]


def test_the_command_line_has_what_is_no_default():
    told: list[str] = []
    app = typer.Typer()

    @app.command("compare")
    def _(
        ctx: typer.Context, names: list[str], seeds: int = 3, more: list[str] | None = None, fast: bool = False
    ) -> None:
        told.append(options.command_line(ctx))

    command = typer.main.get_command(app)
    words = ["a", "my b", "--seeds", "5", "--more", "1", "--more", "2", "--fast"]
    command.main(words, "compare", standalone_mode=False)
    command.main(["a", "--seeds", "3"], "compare", standalone_mode=False)
    assert shlex.split(told[0]) == ["thermofleet", "compare", *words]
    assert told[1] == "thermofleet compare a"


def test_random_scores_are_uniform_and_repeat() -> None:
    rng, scores = np.random.default_rng(0), _Random(3)
    cycles = [SimpleNamespace(profile=rng.standard_normal((20, 3, 7))) for _ in range(400)]
    plans = [SimpleNamespace(arm="a", cycle=cycle) for cycle in cycles]
    drawn = np.array([[*score.per_joint, score.p_saturation] for score in (scores.score(each, 4) for each in plans)])
    assert stats.kstest(drawn.ravel(), "uniform").pvalue > 0.01
    other_processor = SimpleNamespace(arm="a", cycle=SimpleNamespace(profile=cycles[0].profile * (1.0 + 1e-14)))
    for same in (plans[0], other_processor):
        assert scores.score(same, 4).per_joint.tolist() == drawn[0, :7].tolist()
    assert _Random(4).score(plans[0], 4).per_joint.tolist() != drawn[0, :7].tolist()


def rewards_of(text: str) -> dict[str, list[float]]:
    """The rewards of each POLICY@SOURCE in a text of names, each with its numbers after it."""
    found: dict[str, list[float]] = {}
    for word in text.split():
        if "@" in word:
            numbers = found[word] = []
        else:
            numbers.append(float(word))
    return found


QUICK = rewards_of("""
wspt@rc-nominal
    5.99749417852418 8.997540478131903 5.997348023627421 8.997400913679169
wspt@blind
    5.99749417852418 8.997540225994873 5.997348023627421 8.997401117223173
wspt@oracle
    5.99749417852418 8.997540225994873 5.997348023627421 8.997401117223173
round_robin@blind
    5.997494576202657 8.997540477589707 5.9973476880432175 8.997400912449335
""")
"""Rewards of the small scenario with seeds 10000 and 10001, of each of two fleets and two trainings, as an earlier
implementation, `thermofleet ablate`, computed them in float64."""

TRAINED = rewards_of("""
wspt@trained
    5.997495397180928 8.997542830431069 5.997495397180928 8.997541460698054
    5.99734675079658 8.997398383369463 5.99734675079658 8.997398629429464
wspt@unweighted
    5.997495397180928 8.997543052291434 5.997495397180928 8.997543052291434
    5.99734675079658 8.997398132164946 5.99734675079658 8.997398132164946
wspt@untrained
    5.99749417852418 8.997540478131903 5.997495397180928 8.99754169904697
    5.99734675079658 8.99739964131719 5.99734675079658 8.997398383369463
wspt@torque
    5.997495397180928 8.9975423294294 5.99734675079658 8.997398132164946
wspt@rc
    5.99749417852418 8.997540225994873 5.997348023627421 8.997401117223173
least_difficulty@rc
    5.9974948357982685 8.997541818562766 5.997347333903775 8.997399587617933
""")


@pytest.mark.parametrize(
    ("twin", "expected"),
    [
        pytest.param("", QUICK, marks=pytest.mark.ci_slow, id="quick"),
        pytest.param('\n[twin]\nsize = "quick"\n', TRAINED, marks=pytest.mark.slow, id="trained"),
    ],
)
def test_sources_have_the_rewards_that_they_always_had(thermofleet, small_toml, tmp_path, twin, expected) -> None:
    """Equal up to the rounding of energies in float32."""
    small_toml.write_text(small_toml.read_text() + twin)
    how = ("--fleets", 2, "--seeds", 2, "--first-seed", 10_000, "--out", tmp_path / "out")
    trainings = ("--trainings", 2) if twin else ()
    thermofleet("compare", small_toml, "--policies", ",".join(expected), *how, *trainings).succeeded()
    found: dict[str, list[float]] = {}
    for row in read_rows(tmp_path / "out"):
        assert row.outcome is not None
        found.setdefault(f"{row.key.policy}@{row.key.difficulty}", []).append(row.outcome.reward)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name] == pytest.approx(values, rel=1e-10), name


@pytest.mark.ci_slow
def test_a_comparison_of_sources_resumes(thermofleet, small_toml, tmp_path, monkeypatch) -> None:
    out = tmp_path / "sources"
    how = ("--fleets", 2, "--first-seed", 10_000, "--workers", 1)
    names = ("--policies", "wspt,round_robin@blind", "--difficulty", "blind,rc-nominal,random,oracle")
    call = ("compare", small_toml, *names, *how, "--trainings", 2, "--out", out)
    done = thermofleet(*call, "--seeds", 2).succeeded()
    for name in ("wspt@blind", "wspt@rc-nominal", "wspt@random", "wspt@oracle", "round_robin@blind"):
        assert done.out.count(f"  {name} ") == 1 + len(FIGURES)  # its scope, and each figure
    assert len(read_rows(out)) == 2 * 2 * (1 + 1 + 2 + 1 + 1)  # random numbers have two trainings
    again = thermofleet(*call, "--seeds", 2, "--json")
    alone = thermofleet("compare", small_toml, "--policies", "round_robin", "--difficulty", "blind", *how, "--seeds", 2,
                        "--json")  # fmt: skip
    in_all, single = (json.loads(each.out)["figures"] for each in (again, alone))
    assert in_all["round_robin@blind"]["value"]["mean"] == single["round_robin"]["value"]["mean"]

    units, real = [], runner.run_unit
    monkeypatch.setattr(runner, "run_unit", lambda unit, settings: units.append(unit) or real(unit, settings))
    thermofleet(*call, "--seeds", 3).succeeded()
    assert [unit.case.seeds for unit in units] == [(10_002,)] * 12


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("compare quickstart --difficulty blind --trainings 3", "needs predictions of a trained source (twin, trained"),
        ("compare --suite test/0001 --first-seed 5", "'test/0001' has seeds of its own: leave --first-seed 5 out."),
        ("compare --suite test --first-seed 5", "'test' has seeds of its own"),
        (
            "compare --suite test,validation",
            "A split stands alone: give --suite test, or instances of it, as test/0017",
        ),
        ("compare quickstart --first-seed 4294967295 --seeds 3", "3 from --first-seed 4294967295 on are too many"),
        ("bounds quickstart --show", "--show prints all rows of the file: leave the scenarios and --suite out."),
        ("leaderboard --split train", "Allowed: test, validation."),
    ],
)
def test_options_that_would_have_no_effect_are_refused(thermofleet, arguments, told) -> None:
    name, *rest = arguments.split()
    more = ("--policies", "wspt") if name == "compare" else ()
    assert thermofleet(name, *rest, *more).refused(told)


def test_bad_sources_are_named(thermofleet, small_toml) -> None:
    for words in (("--difficulty", "trained,oracel"), ("--policies", "wspt@oracel")):
        assert thermofleet("compare", small_toml, *words).refused("No difficulty 'oracel'; did you mean 'oracle'?")
    assert thermofleet("compare", small_toml, "--policies", "wspt,wspt@blind", "--difficulty", "blind").refused(
        "The policy 'wspt@blind' is given twice"
    )


@pytest.mark.parametrize("names", [",", "wspt,,fifo", "wspt,", ""])
def test_an_empty_name_is_told(thermofleet, small_toml, names) -> None:
    assert thermofleet("compare", small_toml, "--policies", names).refused(f"A name is empty in '{names}'.")
