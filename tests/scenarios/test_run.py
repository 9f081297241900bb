"""A shift from beginning to end: reproducible, complete, and the same over either bus."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.registry import RULES
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import RunLog, run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import scenario_hash

TICKS = 18


@pytest.fixture(scope="module")
def fleet(plans: Path, tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    folder = tmp_path_factory.mktemp("small")
    path = folder / "heat.toml"
    path.write_text(_small(), encoding="utf-8")
    return prepare(load(path), difficulty="blind", cache=plans)


def _small() -> str:
    text = (Path(__file__).parent / "conftest.py").read_text(encoding="utf-8")
    return text.split('SMALL = """')[1].split('"""')[0]


def spec(policy: str = "round_robin", seed: int = 0, **changes) -> RunSpec:
    return replace(RunSpec(policy=policy, seed=seed, bus="memory", difficulty="blind"), **changes)


def same(one: RunLog, two: RunLog) -> bool:
    pairs = zip(vars(one.readings).values(), vars(two.readings).values(), strict=True)
    alike = all(np.array_equal(a, b) for a, b in pairs)
    return alike and repr(one.events) == repr(two.events) and one.metrics == two.metrics


@pytest.mark.parametrize("policy", RULES)
def test_the_same_seed_gives_the_same_shift(fleet, policy):
    assert same(run(fleet, spec(policy, 7)), run(fleet, spec(policy, 7)))


def test_another_seed_gives_another_shift(fleet):
    assert not same(run(fleet, spec(seed=0)), run(fleet, spec(seed=1)))


def test_zenoh_and_memory_give_the_same_shift(fleet):
    over_zenoh, in_memory = run(fleet, spec(bus="zenoh")), run(fleet, spec())
    assert same(over_zenoh, in_memory)
    assert over_zenoh.metrics.messages > 0


def test_progress_runs_from_the_first_step_to_one(fleet):
    heard: list[tuple[str, float]] = []
    result = run(fleet, spec(), progress=lambda stage, share: heard.append((stage, share)))
    assert result.finished
    assert {stage for stage, _ in heard} == {"working"}
    shares = [share for _, share in heard]
    assert shares == sorted(shares)
    assert shares[-1] <= 1.0


def test_a_stopped_shift_is_the_beginning_of_the_whole_one(fleet):
    counted = iter(range(100))
    part = run(fleet, spec(), stopped=lambda: next(counted) >= 5)
    whole = run(fleet, spec())
    assert not part.finished
    assert part.time_s == 50.0
    assert whole.finished
    n = len(part.readings.time_s)
    assert part.readings.time_s[-1] == 50.0
    assert np.array_equal(part.readings.temp_c, whole.readings.temp_c[:n])
    assert repr(part.events) == repr(whole.events[: len(part.events)])


def test_a_shift_stopped_before_it_begins_has_no_telemetry(fleet):
    nothing = run(fleet, spec(), stopped=lambda: True)
    assert len(nothing.readings.time_s) == 0
    assert nothing.time_s == 0.0
    assert nothing.metrics.finished == 0
    json.dumps(nothing.card, allow_nan=False)


def test_ctrl_c_outside_the_steps_is_not_taken_for_a_result(fleet, monkeypatch):
    class Broken:
        def reset(self, rng):
            """Begin."""

        def act(self, observations):
            raise KeyboardInterrupt

    monkeypatch.setattr("scenarios.policy_loader.policy_of", lambda *name: Broken())
    with pytest.raises(KeyboardInterrupt):
        run(fleet, spec())


def test_telemetry_is_read_once_a_second_from_every_arm(fleet):
    result = run(fleet, spec())
    assert np.array_equal(result.readings.time_s, np.arange(1, len(result.readings.time_s) + 1))
    assert result.readings.temp_c.shape == (len(result.readings.time_s), 2, 7)
    assert run(fleet, spec(), record=False).telemetry.num_rows == 0


def test_telemetry_at_the_end_of_a_step_is_what_the_policy_observes_next(fleet, monkeypatch):
    """The temperatures with the same noise."""
    seen = []

    class Watching:
        def reset(self, rng):
            """Begin."""

        def act(self, observations):
            seen.append(np.stack([each.temp_c for each in observations.values()]))
            return {arm: int(each.action_mask[1]) for arm, each in observations.items()}

    monkeypatch.setattr("scenarios.policy_loader.policy_of", lambda *name: Watching())
    telemetry = run(fleet, spec()).readings
    assert telemetry is not None
    ends = telemetry.time_s % fleet.scenario.decision_interval_s == 0
    assert len(seen) > 5
    np.testing.assert_allclose(telemetry.temp_c[ends][: len(seen) - 1], seen[1:], rtol=1e-6, atol=0)


def test_awards_state_what_the_chosen_plan_promised(fleet, plans):
    oracle = prepare(fleet.scenario, difficulty="oracle", cache=plans)
    events = run(oracle, spec("round_robin", 2)).events
    ends = {event.job: event for event in events if event.kind == "finish"}
    stated = [event for event in events if event.kind == "award" and event.job in ends]
    assert stated
    for award in stated:
        match = re.fullmatch(r"predicted peak ([\d.]+) °C, P\(saturation\) ([01]\.\d\d)", award.reason)
        assert match is not None
        assert (float(match[1]) > fleet.scenario.limits.warning_c) == (float(match[2]) > 0.5)
    assert not any(event.reason for event in run(fleet, spec("round_robin", 2)).events if event.kind == "award")


def test_the_metrics_agree_with_the_event_log(fleet):
    result = run(fleet, spec("random", 2))
    kinds = [event.kind for event in result.events]
    m = result.metrics
    assert kinds.count("finish") == m.finished
    assert kinds.count("release") == m.jobs
    assert kinds.count("fault") == m.faults
    awards = [event for event in result.events if event.kind == "award"]
    assert len(awards) >= m.finished
    last = max(event.time_s for event in result.events if event.kind == "finish")
    assert m.makespan_s == pytest.approx(last)
    assert set(m.peak_c) == {"left", "right"}


def test_the_summary_says_how_the_run_was_made_and_holds_no_clock_time(fleet):
    page = run(fleet, spec(seed=4)).card
    assert page["status"] == "finished"
    assert page["seed"] == 4
    assert page["policy"] == "round_robin"
    assert page["bus"] == "memory"
    assert page["difficulty"] == "blind"
    assert page["scenario_hash"] == scenario_hash(fleet.scenario)
    assert {"thermofleet", "mujoco", "python"} <= set(page["versions"])
    assert page["twins"] == {"left": {"version": "blind"}, "right": {"version": "blind"}}
    assert json.loads(json.dumps(page, allow_nan=False))["metrics"] == page["metrics"]


def test_the_hash_names_the_content_of_a_scenario(fleet):
    scenario = fleet.scenario
    assert scenario_hash(scenario) == scenario_hash(replace(scenario))
    assert scenario_hash(scenario) != scenario_hash(replace(scenario, horizon_s=190.0))
