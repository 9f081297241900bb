"""Calibration errors by hand, and the outcomes of awards."""

import numpy as np
import pytest

from benchmarks.paper.reliability import _plans, _true_peak, awards_of_shift, calibration_error
from fleet.events import Event
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load


def test_the_error_of_two_bins_by_hand() -> None:
    p = np.array([0.1, 0.2, 0.3, 0.9, 0.9, 1.0])
    event = np.array([0, 0, 1, 1, 1, 0], bool)
    # Means 0.2 and 2.8/3, shares 1/3 and 2/3, three jobs each.
    assert calibration_error(p, event, bins=2) == pytest.approx(0.5 * (1 / 3 - 0.2) + 0.5 * (2.8 / 3 - 2 / 3))


def test_a_true_probability_has_little_error_and_a_boast_has_much() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(20_000)
    event = rng.random(20_000) < p
    assert calibration_error(p, event) < 0.01
    # A forecast pushed to the ends errs by the mean distance between stated and known probability.
    share = np.square(p) / (np.square(p) + np.square(1 - p))
    grid = np.linspace(0, 1, 100_001)
    expected = np.mean(np.abs(np.square(grid) / (np.square(grid) + np.square(1 - grid)) - grid))
    assert calibration_error(share, event) == pytest.approx(expected, abs=0.012)


@pytest.mark.slow
def test_true_p_agrees_with_the_outcomes_of_a_shift() -> None:
    """With the true state P is exact but for the noise of the sensors."""
    fleet = prepare(load("heat_wave"), difficulty="oracle")
    p, passed = (
        np.concatenate(each) for each in zip(*(awards_of_shift(fleet, "wspt", s) for s in (1, 2)), strict=True)
    )
    assert len(p) > 100
    assert 20 < passed.sum() < len(p) - 20
    assert calibration_error(p, passed) <= 0.05
    assert np.mean(np.square(p - passed)) <= 0.05


def test_a_plan_ends_at_home_or_by_a_fault_and_else_its_outcome_is_unknown() -> None:
    times = {
        "a": [("award", 0), ("home", 50), ("award", 60), ("fault", 90), ("recover", 200), ("award", 210)],
        "b": [("award", 10), ("give_back", 40), ("home", 60)],
    }
    events = [Event(time_s=t, kind=kind, arm=arm) for arm, log in times.items() for kind, t in log]  # pyright: ignore
    assert list(_plans(events)) == [
        ("a", 0, 50, False),
        ("a", 60, 90, True),
        ("a", 210, None, False),
        ("b", 10, None, False),
    ]


def test_the_first_two_minutes_do_not_count_but_in_short_plans() -> None:
    ends_c = 80.0 - np.arange(60.0)[:, None]  # cooling by 1 K in each step of 10 s
    assert _true_peak(ends_c, 10.0, 0.0, 400.0) == 80.0 - 11  # at 120 s
    assert _true_peak(ends_c, 10.0, 100.0, 150.0) == 80.0 - 14  # at its end
    assert _true_peak(-ends_c, 10.0, 100.0, 400.0) == 39.0 - 80.0
