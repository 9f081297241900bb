"""Alarms: the threshold by ranks, what a hold with another mass measures in closed form, and moments of alarms."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.alarms import (
    CHECK,
    LIMIT,
    MINUTE_S,
    QUIET,
    SCALING,
    SIGNALS,
    TEMPERATURE,
    measure,
    root_mean_square,
    summary,
    threshold,
)
from fleet.engine.world import Arm
from fleet.heat.motor import friction_torque, gen3_motors
from fleet.motion import Phase, Plan
from scenarios.prepare.fleet import prepare

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def arm() -> Arm:
    """A nominal arm, which knows its motors."""
    arm = prepare("quickstart", difficulty="blind").arms[0]
    return replace(arm, motors=gen3_motors())


def moving(arm: Arm, qd: np.ndarray) -> Plan:
    """Two seconds with some torque at constant speeds; other phases empty."""
    plan = next(plan for variants in arm.plans.values() for plan in variants)
    profile = np.tile(np.stack([0.0 * qd, qd, np.linspace(4.0, 16.0, 7)]), (100, 1, 1)).astype(np.float32)
    nothing = Phase(profile[:0], np.zeros(0, np.float32))
    return replace(plan, approach=nothing, cycle=Phase(profile, np.ones(100, np.float32)), retreat=nothing)


def test_one_of_a_hundred_exchangeable_scores_exceeds_the_threshold_of_the_others():
    scores = RNG.standard_normal(200)
    exceeds = [score > threshold(np.delete(scores, i).tolist()) for i, score in enumerate(scores)]
    assert sum(exceeds) == 2
    assert threshold(list(range(99))) == 98.0
    with pytest.raises(ValueError, match=r"at least 99 scores \(got 98\)"):
        threshold(list(range(98)))


def test_a_hold_with_more_torque_heats_by_its_square(arm):
    """At rest current is proportional to torque, and copper loss to its square; there is no friction heat."""
    hold = moving(arm, np.zeros(7))
    tau = hold.cycle.profile[:, 2].astype(float)
    measured = measure(arm, hold, 0.2 * tau, RNG, noise=0.0)
    assert arm.excess(hold, measured.drive) == pytest.approx(1.2**2 - 1.0, rel=1e-5)
    assert measured.by_current.cycle.profile[:, 2] == pytest.approx(1.2 * tau, rel=1e-5)


def test_torque_by_current_holds_the_friction_that_has_grown(arm):
    qd = np.linspace(-0.5, 0.5, 7)
    plan, worn = moving(arm, qd), replace(arm, motors=gen3_motors(wear=1.5))
    more = measure(worn, plan, np.zeros((100, 7)), RNG, noise=0.0)
    grown_nm = 1.5 * friction_torque(qd, gen3_motors())
    off = more.by_current.cycle.profile[:, 2] - plan.cycle.profile[:, 2]
    assert root_mean_square(off) == pytest.approx(np.abs(arm.motors.eta * grown_nm), abs=1e-5)
    same = measure(arm, plan, np.zeros((100, 7)), RNG, noise=0.0)
    assert same.drive.friction_w == pytest.approx(friction_torque(qd, arm.motors) * qd, abs=1e-6)


def rows() -> list[dict[str, object]]:
    """Quiet shifts of uniform signals, and shifts of each kind in which the second job and third minute are higher."""

    rng = np.random.default_rng(0)  # its own, so that the order of the tests does not matter

    def row(kind: str, role: str, more: float) -> dict[str, object]:
        values = rng.random((len(SIGNALS), 3))
        values[:, 1:] += [more, 0.0]
        signals = {name: own for name, own in zip(SIGNALS, values.tolist(), strict=True) if " by" not in name}
        signals[TEMPERATURE] = [*rng.random(2).tolist(), float(rng.random() + more)]
        own = {"arm": "a", "since_s": 60.0 if more else None, "fault_s": 660.0 if more else None}
        arms = [own | {"job_s": [100.0, 360.0, 500.0], "plan": [0, 0, 0], "signals": signals}]
        return {"cell": "c", "kind": kind, "role": role, "arms": arms}

    quiet = [row("nothing", role, 0.0) for role in QUIET for _ in range(150)]
    return [*quiet, *(row(kind, CHECK, 9.0) for kind in ("payload", "friction", "fan", "sensor") for _ in range(3))]


def test_delay_counts_from_the_surprise_and_lead_until_the_fault():
    found = dict(summary(rows()))
    assert {*QUIET} == {SCALING, LIMIT, CHECK}
    assert len(found) == 4 * len(SIGNALS)
    for name in SIGNALS:
        row = found[f"friction/{name}"]
        alarm_s = 3 * MINUTE_S if name == TEMPERATURE else 360.0
        assert row["share"][0] == 1.0
        assert (row["alarm_min"], row["delay_min"]) == (alarm_s / 60.0, (alarm_s - 60.0) / 60.0)
        assert (row["before_fault"], row["faults"]) == (3, 3)
        assert row["lead_min"] == (660.0 - alarm_s) / 60.0
        assert row["false_alarms"][0] < 0.05
