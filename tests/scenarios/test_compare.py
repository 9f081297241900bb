"""Comparisons: paired by seed, the same on any number of cores."""

import io
import math
import re
from dataclasses import fields, replace
from pathlib import Path

import pytest
from rich.console import Console

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from scenarios.evaluate.comparison import Comparison, compare
from scenarios.evaluate.rollout import FIGURES, KINDS, Outcome
from scenarios.evaluate.statistics import Figure
from scenarios.spec.load import load
from scenarios.spec.schema import Scenario

POLICIES = ("random", "round_robin")


@pytest.fixture
def scenario(small_toml: Path) -> Scenario:
    return load(small_toml)


def compared(scenario: Scenario, plans: Path, workers: int, **changes) -> Comparison:
    how = {"policies": POLICIES, "seeds": range(3), "baseline": "round_robin"} | changes
    return compare(scenario, difficulty="blind", cache_dir=plans, workers=workers, **how)


@pytest.mark.parametrize("channel", [PERFECT, Channel(topology="line", delay_s=10.0)], ids=["perfect", "late"])
def test_the_result_does_not_depend_on_the_number_of_workers(scenario, plans, monkeypatch, channel):
    how = {"seeds": range(6), "channel": channel}
    alone = compared(scenario, plans, workers=1, **how)
    monkeypatch.setattr("scenarios.evaluate.study.TOGETHER", 4)
    assert compared(scenario, plans, workers=1, **how) == alone
    monkeypatch.setattr("scenarios.evaluate.runner.HERE_S", 0.0)
    assert compared(scenario, plans, workers=2, **how) == alone


def test_a_scenario_is_a_file_too_and_the_first_policy_the_default_baseline(small_toml, scenario, plans):
    how = {"seeds": range(3), "difficulty": "blind", "cache_dir": plans, "workers": 1}
    found = compare(small_toml, ["round_robin", "random"], **how)
    assert found == compare(scenario, ["round_robin", "random"], baseline="round_robin", **how)
    assert found.baseline == "round_robin"


def test_what_takes_no_time_needs_no_worker(scenario, plans, monkeypatch):
    monkeypatch.setattr("scenarios.evaluate.runner.LocalWorker", None)
    told: list[tuple[str, float]] = []
    compared(scenario, plans, workers=2, progress=lambda stage, share: told.append((stage, share)))
    assert [share for stage, share in told if stage == "comparing"] == [0.5, 1.0]


def test_a_policy_differs_from_itself_by_nothing(scenario, plans):
    result = compared(scenario, plans, workers=1)
    for figure in result.figures["round_robin"].values():
        assert (figure.difference, figure.difference_low, figure.difference_high) == (0.0, 0.0, 0.0)


def test_figures_are_means_over_seeds_with_intervals_around_them(scenario, plans):
    result = compared(scenario, plans, workers=1)
    assert result.seeds == (0, 1, 2)
    assert set(result.figures) == set(POLICIES)
    for figures in result.figures.values():
        assert set(figures) == set(FIGURES)
        for figure in figures.values():
            assert figure.low <= figure.mean <= figure.high or "no variation in 3" in figure.note
            assert figure.difference_low <= figure.difference <= figure.difference_high or figure.difference_note
    random, base = result.figures["random"]["peak_c"], result.figures["round_robin"]["peak_c"]
    assert random.difference == pytest.approx(random.mean - base.mean)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"policies": ("rnd", "round_robin")}, "No policy 'rnd'; did you mean 'random'?"),
        ({"policies": ()}, "A comparison needs a policy and a seed (got 0 policies, 3 seeds)."),
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
    page = io.StringIO()
    Console(file=page, width=80).print(result.table)
    text = page.getvalue()
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
    page = io.StringIO()
    Console(file=page, width=80).print(result.table)
    rows = [line.split() for line in page.getvalue().splitlines()]
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
        page = io.StringIO()
        Console(file=page, width=80).print(result.table)
        lines = [" ".join(line.split()) for line in page.getvalue().splitlines()]
        assert {"random arm", "round_robin central"} <= set(lines)
        assert ("Central policies read no messages: round_robin." in lines) is said


@pytest.mark.parametrize(
    ("seeds", "title"), [((3, 4, 5), "s, seeds 3 to 5 (u)"), ((1, 7), "s (u)"), ((0, 10**15), "s (u)")]
)
def test_a_title_names_seeds_that_follow_each_other(seeds, title):
    """Seeds of the suite's instances are 32-bit numbers; a range from the first to the last would take all memory."""
    result = Comparison("s", seeds, "u", 2, "a", {}, {}, PERFECT.described(), "")
    assert result.title == title
