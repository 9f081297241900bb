"""Reward terms: each what its name says, and together what the shift came to."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from fleet.env.allocation_v0 import parallel_env
from fleet.env.reward import TERMS, RewardWeights, terms
from fleet.robot import ThermalLimits
from fleet.sim.state import DONE, initial


def test_each_term_is_its_weight_times_its_measure(small) -> None:
    jobs = [small.job("a", value=3.0, due_s=100.0), small.job("b", value=2.0, due_s=500.0), small.job("c", value=9.0)]
    world, _ = small.shop([jobs])
    before = initial(world)
    before.status[0, 2], before.finished_s[0, 2] = DONE, 1.0  # paid earlier
    after = before.copy()
    after.status[0, :2], after.finished_s[0, :2] = DONE, [220.0, 400.0]
    after.above_warning_s[0] += [30.0, 60.0]
    after.faults[0, 1] += 2
    after.energy_j[0] += [3600.0, 7200.0]
    weights = RewardWeights(finished_value=2.0, tardiness=-1.0, above_warning=-10.0, faults=-7.0, energy=-0.5)
    found = {name: float(value[0]) for name, value in terms(world, before, after, weights).items()}
    assert found == {
        "finished_value": 2.0 * 5.0,
        "tardiness": -1.0 * 3.0 * 2.0,  # two minutes late
        "above_warning": -10.0 * 1.5,
        "faults": -7.0 * 2,
        "energy": -0.5 * 3.0,
    }
    assert tuple(found) == TERMS


def test_nothing_happening_is_worth_nothing(small) -> None:
    world, _ = small.shop([[small.job("a")], [small.job("a"), small.job("b")]])
    state = initial(world)
    for value in terms(world, state, state, RewardWeights()).values():
        assert value.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_rewards_of_an_episode_add_up_to_what_it_came_to(small, seed) -> None:
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


def test_a_job_is_paid_once_though_it_was_returned(small) -> None:
    world, _ = small.shop([[small.job("a", value=4.0)]])
    done = initial(world)
    done.status[0, 0], done.finished_s[0, 0] = DONE, 5.0
    only = replace(RewardWeights(), tardiness=0.0, energy=0.0)
    paid = [terms(world, a, b, only)["finished_value"][0] for a, b in ((initial(world), done), (done, done.copy()))]
    assert paid == [4.0, 0.0]
