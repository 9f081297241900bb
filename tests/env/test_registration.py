"""Entry points: PettingZoo's registry, `make_env`, `make_batch`."""

import subprocess
import sys

import numpy as np
import pettingzoo
import pytest
from pettingzoo import AECEnv, ParallelEnv

import scenarios
from fleet.env.allocation_v1 import AllocationEnv
from fleet.env.vector import BatchEnv
from fleet.offered_plans import PLANS

NAME = "thermofleet/allocation_v1"


def test_pettingzoo_makes_the_env_by_name(cell, plans, play) -> None:
    options = {"scenario": cell, "difficulty": "blind", "cache": plans, "max_cycles": 5}
    env = pettingzoo.make("parallel", NAME, **options, mask_in="both")
    assert isinstance(env, ParallelEnv)
    assert isinstance(env.unwrapped, AllocationEnv)
    ours = scenarios.make_env(cell, difficulty="blind", cache=plans, max_cycles=5, mask_in="both")
    assert play.plain(env.reset(seed=1)) == play.plain(ours.reset(seed=1))
    for _ in range(5):
        assert play.plain(env.step({"left": 1})) == play.plain(ours.step({"left": 1}))
    assert env.agents == []
    turns = pettingzoo.make("aec", NAME, **options)
    assert isinstance(turns, AECEnv)
    turns.reset(seed=1)
    assert turns.possible_agents == ["left", "right", "far"]
    first, *_ = turns.last()
    np.testing.assert_array_equal(first["observation"], ours.reset(seed=1)[0]["left"]["observation"])


def test_overrides_are_fields_of_the_scenario_or_options_of_the_env(cell, plans) -> None:
    env = pettingzoo.make("parallel", NAME, scenario=cell, difficulty="blind", cache=plans, horizon_s=100, slots=2)
    env.reset(seed=0)
    assert env.action_space("left").n == 1 + 2 * PLANS + 1
    assert env.unwrapped.world.ticks == 10


@pytest.mark.parametrize("kind", ["parallel", "aec"])
def test_an_unknown_scenario_is_named(kind) -> None:
    with pytest.raises(Exception, match="No scenario 'quickstrat'; did you mean 'quickstart'"):
        pettingzoo.make(kind, NAME, scenario="quickstrat")


def test_make_batch_takes_a_scenario(cell, plans) -> None:
    batch = scenarios.make_batch(cell, num_envs=3, seed=0, difficulty="blind", cache=plans, slots=2, max_cycles=4)
    assert isinstance(batch, BatchEnv)
    obs, info = batch.reset()
    assert obs["observation"].shape == (3, 3, batch.layout.size)
    assert obs["action_mask"].shape == (3, 3, 1 + 2 * PLANS + 1)
    assert batch.agents == ("left", "right", "far")
    given = [batch.step(np.zeros((3, 3), int)) for _ in range(4)]
    assert [step[3].all() for step in given] == [False] * 3 + [True]
    assert list(info) == list(given[-1][-1])


def test_make_batch_staggers_envs(cell, plans) -> None:
    batch = scenarios.make_batch(cell, 2, 0, difficulty="blind", cache=plans, max_cycles=4, stagger=True)
    batch.reset()
    ends = [batch.step(np.zeros((2, 3), int))[3].tolist() for _ in range(4)]
    assert ends == [[False, False], [True, False], [False, False], [False, True]]


@pytest.mark.parametrize(
    "first",
    [
        "import pettingzoo, scenarios",
        "import scenarios, pettingzoo; scenarios.make_env",
        "import scenarios.prepare.env_registration",
    ],
)
def test_importing_scenarios_registers_the_name(first) -> None:
    code = f"{first}; import pettingzoo as p; print([p.spec(kind, {NAME!r}).name for kind in ('parallel', 'aec')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.strip() == "['allocation', 'allocation']", done.stderr
