"""The suite: its splits never change, heat is calibrated, most arms can do a job; stored results repeat."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.freeze_suite import drawn_rows, faults_of, minutes_of
from fleet.bus.exchange.channel import Channel
from fleet.errors import ScenarioError
from scenarios.evaluate.leaderboard import read_all
from scenarios.evaluate.runner import run_study
from scenarios.evaluate.study import Study, suite_of
from scenarios.prepare.fleet import prepare
from scenarios.spec.jobs import all_works, alternatives_of
from scenarios.spec.load import load, own_seed
from scenarios.spec.parse import scenario_content
from scenarios.spec.schema import SPLITS, Scenario
from scenarios.suite.instances import (
    BUSES,
    CELLS,
    FAULTS,
    LIGHT_DUE_S,
    Axes,
    SuiteCell,
    calibrations,
    layout,
    scenario_of,
)
from scenarios.suite.splits import cell_of_instance, instance, manifest, split

PLAIN = Axes(heat="warm", arrivals="poisson", due="usual", faults="attended", bus="perfect")


def cell_named(name: str) -> SuiteCell:
    return next(cell for cell in CELLS if cell.name == name)


@pytest.mark.parametrize("name", SPLITS)
def test_a_split_never_changes(name) -> None:
    """Draw every instance anew; the manifest has the hashes of its scenario and of its jobs."""
    frozen = manifest(name)
    assert len(frozen) >= 160
    assert frozen == tuple(drawn_rows(name))


def test_splits_share_no_cell_and_no_seed() -> None:
    cells = [{row.cell for row in manifest(name)} for name in SPLITS]
    assert sum(map(len, cells)) == len(set.union(*cells)) == len(CELLS)
    seeds = [row.seed for name in SPLITS for row in manifest(name)]
    assert len(seeds) == len(set(seeds))
    assert len({(cell.seed, layout(cell)) for cell in CELLS}) == len(CELLS)


@pytest.mark.parametrize("name", SPLITS)
def test_every_split_has_every_control_and_every_level(name) -> None:
    rows = manifest(name)
    assert {cell_of_instance(row).asks for row in rows} == {
        "advantage", "equal_arms", "overload", "one_able_arm", "light_work"
    }  # fmt: skip
    counts = {level: sum(row.axes.heat == level for row in rows) for level in FAULTS}
    assert 0.25 <= counts["cool"] / len(rows) <= 0.3
    assert counts["warm"] == counts["hot"] == counts["severe"]


def test_instances_of_a_cell_share_what_is_prepared() -> None:
    """Plans depend on arms and works, twins besides on the air of past jobs, repetitions and limits of two kinds."""
    for row in manifest("validation")[:12]:
        cell = cell_of_instance(row)
        plain = scenario_of("plain", cell, replace(PLAIN, heat="cool"), 0)
        scenario = instance(row.name).scenario
        arms = [replace(arm, sensor_noise_k=None) for arm in scenario.arms]
        assert (arms, scenario.places, scenario.twin) == (list(plain.arms), plain.places, plain.twin)
        assert (all_works(scenario), scenario.spread) == (all_works(plain), plain.spread)
        assert {stream.repetitions for stream in scenario.jobs} == {stream.repetitions for stream in plain.jobs}


def test_axes_are_honoured() -> None:
    cell = cell_named("bench_6_polishing")

    def at(**values) -> Scenario:
        return scenario_of("x", cell, replace(PLAIN, **values), 3)

    def light(scenario: Scenario) -> float:
        return sum(s.arrivals.expected(7200.0) for s in scenario.jobs if s.due == "soft")

    plain = at()
    assert light(at(arrivals="rush")) == pytest.approx(light(plain), rel=1e-3)
    assert light(at(arrivals="waves")) == pytest.approx(light(plain), rel=0.25)
    traced = [light(scenario_of("x", cell, replace(PLAIN, arrivals="trace"), n)) for n in range(20)]
    assert np.mean(traced) == pytest.approx(light(plain), abs=4 * np.sqrt(light(plain) / 20))
    assert {s.due_s for s in at(due="tight").jobs if s.due == "soft"} == {LIGHT_DUE_S["tight"]}
    assert at(faults="unattended").limits.clear_s > 10 * plain.limits.clear_s
    assert [arm.sensor_noise_k for arm in at(faults="noisy").arms] == [None, 2.0] * 3
    assert at(bus="late").bus == BUSES["late"] != Channel()
    (cut,) = at(bus="cut").bus.partitions
    assert cut.cuts([arm.name for arm in plain.arms]).sum() == 18
    assert [at(heat=level).ambient.points[0][1] for level in FAULTS] == sorted(
        calibrations()[cell.name].ambient_c.values()
    )


@pytest.mark.parametrize("name", ["gantry_5_assembly", "line_4_inspection"])
def test_every_job_can_be_done_by_most_arms_and_in_the_control_by_one(name, plans) -> None:
    cell = cell_named(name)
    fleet = prepare(scenario_of("x", cell, PLAIN, 0), difficulty="blind", cache=plans)
    shares = [
        np.mean([any(work in arm.plans for work in alternatives_of(fleet.scenario, stream, kg)) for arm in fleet.arms])
        for stream in fleet.scenario.jobs
        for kg in stream.payload_kg
    ]
    assert set(shares) == {1 / cell.arms} if cell.asks == "one_able_arm" else np.mean(shares) >= 0.7


def test_hotter_levels_have_more_faults_of_a_policy_that_ignores_heat() -> None:
    """Few shifts; `python -m benchmarks.freeze_suite --check` takes many in every cell."""
    cell = cell_named("ring_6_palletising")
    _, fleet = minutes_of(cell)
    means = [faults_of(cell, calibrations()[cell.name], level, fleet, 3_000_000, 2).mean() for level in FAULTS]
    assert means[0] == 0.0
    for mean, wanted in zip(means[1:], list(FAULTS.values())[1:], strict=True):
        assert mean == pytest.approx(wanted, abs=4 * np.sqrt(wanted / 16))


def test_a_default_changes_no_hash() -> None:
    scenario = load("quickstart")
    assert "bus" not in scenario_content(scenario)
    assert scenario_content(replace(scenario, bus=Channel(loss=0.5)))["bus"] == {"loss": 0.5}


def test_an_instance_is_loaded_by_name() -> None:
    first = split("test")[0]
    assert load("test/0000") == first.scenario == instance("test/0000").scenario
    assert (own_seed("test/0003"), own_seed("heat_wave")) == (manifest("test")[3].seed, 0)
    with pytest.raises(ScenarioError, match=r"No instance 'test/9999' in the suite; they are test/0000 to test/0"):
        load("test/9999")
    with pytest.raises(ScenarioError, match="split"):
        split("exam")


RESULTS = Path(__file__).parents[2] / "docs" / "results" / "leaderboard"


@pytest.mark.ci_slow
def test_stored_results_of_built_in_policies_repeat():
    """One shift of each, with the present code: a change of a policy needs new results."""
    found = [each for each in read_all(RESULTS, "test") if not each.card.policy_hash]
    for difficulty in {each.card.difficulty for each in found}:
        stored = {each.card.policy: each for each in found if each.card.difficulty == difficulty}
        study = Study(policies=list(stored), cases=suite_of("test/0000", 1), difficulties=[difficulty])
        for row in run_study(study, workers=1):
            (before,) = [own.figures for own in stored[row.key.policy].rows if own.instance == "test/0000"]
            assert row.outcome is not None
            assert list(asdict(row.outcome).values()) == pytest.approx(before, rel=1e-4, abs=1e-6), row.key
