"""Comparisons: paired by seed, the same on any number of cores, intervals that cover."""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from scenarios.load import load
from scenarios.run.compare import FIGURES, HEADINGS, Comparison, Figure, compare, comparison_table, interval
from scenarios.schema import Scenario

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
    monkeypatch.setattr("scenarios.trials.plan.TOGETHER", 4)
    assert compared(scenario, plans, workers=1, **how) == alone
    monkeypatch.setattr("scenarios.trials.contest.HERE_S", 0.0)
    assert compared(scenario, plans, workers=2, **how) == alone


def test_what_takes_no_time_needs_no_worker(scenario, plans, monkeypatch):
    monkeypatch.setattr("scenarios.trials.contest.LocalWorker", None)
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
            assert figure.low <= figure.mean <= figure.high
            assert figure.difference_low <= figure.difference <= figure.difference_high
    random, base = result.figures["random"]["peak_c"], result.figures["round_robin"]["peak_c"]
    assert random.difference == pytest.approx(random.mean - base.mean)


def test_the_bootstrap_interval_covers_the_true_mean_as_it_should():
    """Percentile bootstrap of 30 normal values covers a little less than 95 % (Efron & Tibshirani, ch. 13)."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = interval(rng.normal(3.0, 2.0, size=30))
        hits += low <= 3.0 <= high
    assert 0.88 <= hits / 200 <= 0.98


def test_the_width_of_the_interval_is_that_of_the_normal_law():
    values = np.random.default_rng(1).normal(0.0, 1.0, size=400)
    low, high = interval(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(400), rel=0.1)


def test_equal_values_have_an_interval_of_no_width():
    assert interval(np.full(5, 4.0)) == (4.0, 4.0)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"policies": ("rnd", "round_robin")}, "No policy 'rnd'; did you mean 'random'?"),
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
    Console(file=page, width=80).print(comparison_table(result))
    text = page.getvalue()
    assert "…  " not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert tuple(HEADINGS) == FIGURES
    for name in (*HEADINGS.values(), *POLICIES):
        assert name in text
    figure = result.figures["random"]["peak_c"]
    row = text.partition(HEADINGS["peak_c"])[2].splitlines()[1]
    mean, low, high, difference, *bounds = (float(number) for number in re.findall(r"[+-]?\d+\.\d+", row))
    assert [mean, low, high] == pytest.approx([figure.mean, figure.low, figure.high], abs=0.05)
    differences = [figure.difference, figure.difference_low, figure.difference_high]
    assert [difference, *bounds] == pytest.approx(differences, abs=0.05)


def shown(difference, low, high):
    """Cells of a row of the table with this difference and its interval."""
    same, other = Figure(1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0), Figure(-0.01, 1.0, -0.04, 1.0, difference, low, high)
    figures = {"a": dict.fromkeys(FIGURES, same), "b": dict.fromkeys(FIGURES, other)}
    result = Comparison("s", (0, 1), "a", figures, {"a": "arm", "b": "arm"}, PERFECT.described(), "")
    page = io.StringIO()
    Console(file=page, width=80).print(comparison_table(result))
    rows = [line.split() for line in page.getvalue().splitlines()]
    return rows[rows.index(["faults"]) + 2]


@pytest.mark.parametrize(
    ("values", "cells"),
    [
        ((-0.01, -0.02, 0.01), "b 0.0 0.0 … 1.0 +0.0 +0.0 … +0.0"),
        ((0.3, 0.02, 0.5), "b -0.01 -0.04 … 1.00 +0.30 +0.02 … +0.50 *"),
        ((-2.0, -3.0, -0.5), "b 0.0 0.0 … 1.0 -2.0 -3.0 … -0.5 *"),
        ((1e-6, 1e-7, 1e-5), "b -0.0100 -0.0400 … 1.0000 +0.0000 +0.0000 … +0.0000"),
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
        Console(file=page, width=80).print(comparison_table(result))
        lines = [" ".join(line.split()) for line in page.getvalue().splitlines()]
        assert {"random arm", "round_robin central"} <= set(lines)
        assert ("Central policies read no messages: round_robin." in lines) is said
