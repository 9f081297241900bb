"""P(saturation) and predicted peaks in the shift: a small case of `reliability`."""

import numpy as np

from benchmarks.paper.saturation import _plans, _true_peak, reliability_rows
from fleet.events import Event
from scenarios.prepare import twins
from scenarios.spec.load import load
from twin.vae.measures import PARTS, Features


class Plain:
    """Stands in for the learned twin, which P by `rc` does not need: every plan is equally difficult."""

    version = "plain"
    joint_weight = None

    def features(self, plans, repetitions) -> Features:
        return Features(np.full((len(plans), 7, PARTS), 0.1))


def test_p_and_peaks_come_true_in_the_shift(monkeypatch) -> None:
    monkeypatch.setattr(
        twins, "train_twins", lambda scenario, planned, folder, progress, seed: [Plain()] * len(planned)
    )
    ((key, row),) = reliability_rows(load("heat_wave"), (10_000, 10_001), 1, "rc", {"key": "wspt"}, ["key"])
    assert (key, row["policy"]) == ("key", "wspt")
    said = row["groups"]["all"]
    assert said["awards"] > 100
    assert 20 < said["passed"] < said["awards"] - 20
    assert said["ece"] <= 0.05
    assert said["brier"] <= 0.05
    assert said["auroc"] >= 0.95
    assert said["peak_rms_k"] < 2.0
    assert row["groups"]["warm"]["brier"] <= 0.05
    assert row["groups"]["warm"]["awards"] + row["groups"]["cool"]["awards"] == said["awards"]


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
