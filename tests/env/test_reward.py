"""Reward terms against numbers computed by hand and against the event log."""

from dataclasses import asdict

import numpy as np
import pytest

from fleet.engine.batch import TERMS, RewardWeights
from fleet.env.allocation_v1 import AllocationEnv, Episode, parallel_env
from fleet.robot import ThermalLimits


def played(small, jobs, weights=None, *, ticks: int, **world) -> tuple[AllocationEnv, dict[str, np.ndarray]]:
    """Play one arm that claims the oldest job if it may; return the reward terms of each step."""
    made, plant = small.shop([jobs], arms=1, ticks=ticks, **world)
    env = parallel_env(
        lambda seed: Episode(made, plant, ("t",), seed), weights=weights or RewardWeights(), keep_events=True
    )
    observations, _ = env.reset(seed=0)
    terms: dict[str, list[float]] = {name: [] for name in TERMS}
    while env.agents:
        observations, _, _, _, infos = env.step({"arm_0": int(observations["arm_0"]["action_mask"][1])})
        for name, values in terms.items():
            values.append(infos["arm_0"][f"reward_{name}"])
    return env, {name: np.array(values) for name, values in terms.items()}


def test_value_and_tardiness_are_rewarded_in_the_step_that_finishes_a_job(small) -> None:
    """A job lasts 3 s + 3 · 10 s, and 2 s more on the way home: the jobs begin at 0 s and at 40 s."""
    jobs = [small.job("a", value=3.0, due_s=100.0), small.job("b", value=2.0, due_s=13.0)]
    weights = RewardWeights(finished_value=2.0, tardiness=-1.0)
    _, terms = played(small, jobs, weights, ticks=20)
    assert terms["finished_value"].tolist() == [0.0, 0.0, 0.0, 6.0, 0.0, 0.0, 0.0, 4.0]
    assert terms["tardiness"] == pytest.approx([0.0] * 7 + [-2.0 * (73.0 - 13.0) / 60.0])
    assert not terms["faults"].any()
    assert not terms["above_warning"].any()


def test_an_idle_step_costs_only_its_energy(small) -> None:
    env, terms = played(small, [small.job("a", release_s=5000.0)], RewardWeights(energy=-0.5), ticks=6)
    for name in TERMS[:-1]:
        assert not terms[name].any()
    assert terms["energy"].sum() == pytest.approx(-0.5 * env.truth.energy_j.sum() / 3600.0)
    # Idle drives, and the current that holds the arm at home, near 25 °C.
    watts = env.world.motors.idle_w.sum() + (env.world.motors.copper_w_per_a2 * env.world.rest.current_sq).sum()
    assert terms["energy"].sum() == pytest.approx(-0.5 * watts * 60.0 / 3600.0, rel=1e-3)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_rewards_of_an_episode_add_up_to_the_event_log(small, seed) -> None:
    limits = ThermalLimits(warning_c=45.0, error_c=50.0, restart_c=42.0)
    weights = RewardWeights(tardiness=-0.1)
    env = parallel_env(small.Shifts(jobs=15, ticks=100, limits=limits), weights=weights, keep_events=True)
    env.reset(seed=seed)
    rng, got = np.random.default_rng(seed), dict.fromkeys(TERMS, 0.0)
    total = 0.0
    while env.agents:
        _, rewards, *_, infos = env.step(
            {a: int(rng.choice(np.flatnonzero(o.action_mask))) for a, o in env.knowledge().items()}
        )
        total += rewards["arm_0"]
        for name in TERMS:
            got[name] += infos["arm_0"][f"reward_{name}"]
    value = dict(zip(env.world.jobs.names[0], env.world.jobs.value[0].tolist(), strict=True))
    finishes = [e for e in env.events if e.kind == "finish"]
    faults = [e for e in env.events if e.kind == "fault"]
    assert finishes
    assert faults
    measured = {
        "finished_value": sum(value[e.job] for e in finishes),
        "tardiness": sum(value[e.job] * e.value / 60.0 for e in finishes),
        "above_warning": env.truth.above_warning_s.sum() / 60.0,
        "faults": len(faults),
        "energy": env.truth.energy_j.sum() / 3600.0,
    }
    for name, weight in asdict(weights).items():
        assert got[name] == pytest.approx(weight * measured[name])
    assert total == pytest.approx(sum(got.values()))


def test_a_returned_job_is_rewarded_once(small) -> None:
    """The arm faults in the twelfth cycle; the rest is short enough for a second try."""
    jobs = [small.job("a", small.work(payload_kg=small.HOT), value=4.0, repetitions=16)]
    env, terms = played(small, jobs, RewardWeights(faults=-7.0, above_warning=-10.0), ticks=600)
    faults = [event.time_s for event in env.events if event.kind == "fault"]
    assert len(faults) == env.truth.returns[0, 0] > 0
    assert terms["finished_value"].sum() == 4.0
    assert np.flatnonzero(terms["faults"]).tolist() == [int(time_s // 10.0) for time_s in faults]
    assert terms["faults"].sum() == -7.0 * len(faults)
    assert terms["above_warning"].sum() == pytest.approx(-10.0 * env.truth.above_warning_s.sum() / 60.0)


def test_a_job_that_is_given_up_is_not_rewarded(small) -> None:
    """The episode ends with the second fault of the only arm."""
    jobs = [small.job("a", small.work(payload_kg=small.HOT), value=4.0, repetitions=40)]
    env, terms = played(small, jobs, RewardWeights(faults=-7.0), ticks=600)
    assert env.truth.returns[0, 0] == 2
    assert env.events[-1].kind == "give_up"
    assert terms["finished_value"].sum() == 0.0
    assert terms["faults"].sum() == -14.0
    assert len(terms["faults"]) == int(env.events[-1].time_s // 10.0) + 1 < 600
