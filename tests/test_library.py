"""Every scenario of the library, found by looking: it loads, it can be done, it runs under two rules."""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fleet.robot import JOINTS
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.log import telemetry_table
from scenarios.run.shift import run
from scenarios.show.layout import describe
from scenarios.spec.jobs import all_works, alternatives_of
from scenarios.spec.load import library, load
from scenarios.spec.options import RunSpec

FILES = (Path(__file__).parents[1] / "scenarios" / "library").glob("*.toml")
NAMES = sorted(path.stem for path in FILES)
TICKS = 20
LARGE = ("assembly", "machine_tending", "palletising_line")
"""Cells that take seconds to plan; `scale_64` takes minutes."""
CELLS = [pytest.param(n, marks=pytest.mark.ci_slow if n in LARGE else ()) for n in NAMES if n != "scale_64"]


@pytest.fixture(scope="session")
def fleet_of() -> Callable[[str], Fleet]:
    """A function of the fleet of a scenario, planned once."""
    return cache(lambda name: prepare(load(name), difficulty="blind"))


def test_the_library_lists_every_file():
    assert set(library()) == set(NAMES)
    assert len(NAMES) >= 12


@pytest.mark.parametrize("name", CELLS)
def test_every_work_can_be_done_by_two_arms_or_more(fleet_of, name):
    """Otherwise there would be nothing to allocate; an arm whose own limit is lower than the load counts."""
    fleet = fleet_of(name)
    able = {
        work: [arm.robot.name for arm in fleet.arms if work in arm.plans or work in arm.too_heavy]
        for work in all_works(fleet.scenario)
    }
    lonely = {f"{w.kind} at {w.places[0].name}, {w.payload_kg} kg": who for w, who in able.items() if len(who) < 2}
    assert lonely == {}
    assert fleet.scenario.description.endswith((".", "?"))
    assert len(fleet.scenario.arms) >= 2


@pytest.mark.parametrize("name", [cell for cell in CELLS if cell.values != ("assembly",)])
def test_most_arms_can_do_most_jobs(fleet_of, name):
    """Second method: by the rates of the streams, not by jobs of sampled shifts."""
    fleet = fleet_of(name)
    share = rate = 0.0
    for stream in fleet.scenario.jobs:
        times = getattr(stream.arrivals, "every_s", None) or fleet.scenario.horizon_s
        for payload_kg in stream.payload_kg:
            works = alternatives_of(fleet.scenario, stream, payload_kg)
            able = np.mean([any(work in arm.plans for work in works) for arm in fleet.arms])
            weight = (getattr(stream.arrivals, "count", None) or 1) / times / len(stream.payload_kg)
            share, rate = share + weight * float(able), rate + weight
    assert share / rate > 0.59
    if name == "quickstart":  # elsewhere the same, but slower
        shown = re.search(r"(\d+)% of the arms can do a job", str(describe(fleet.scenario)[0]))
        assert shown is not None
        assert int(shown[1]) / 100 == pytest.approx(share / rate, abs=0.06)


@pytest.mark.parametrize("policy", ["random", "wsept"])
@pytest.mark.parametrize("name", [*CELLS, pytest.param("scale_64", marks=pytest.mark.slow)])
def test_a_simple_rule_and_one_that_reads_scores_work_their_first_minutes(fleet_of, name, policy):
    fleet = fleet_of(name)
    asked = iter(range(TICKS + 1))
    spec = RunSpec(policy=policy, seed=1, bus="memory", difficulty="blind")
    result = run(fleet, spec, stopped=lambda: next(asked) >= TICKS)
    assert result.time_s == TICKS * fleet.scenario.decision_interval_s
    assert result.metrics.illegal_actions == 0
    arms = [arm.name for arm in fleet.scenario.arms]
    table = telemetry_table(result.readings, arms)
    joints = [f"{name}_{j + 1}" for name in ("q", "qd", "tau", "current_a", "temp_c") for j in range(JOINTS)]
    assert table.column_names == ["time_s", "arm", "mode", *joints]
    assert table.num_rows == len(arms) * round(result.time_s / fleet.scenario.telemetry_interval_s)
    assert 0 < min(result.metrics.peak_c.values()) < 75
