"""AgileRL takes the environment: IPPO and MADDPG by its own training loops, a few updates."""

import random

import numpy as np
import pytest

from tests.adapters.training import (  # noqa: F401 -- the tests of every trainer
    Parameters,
    test_a_seed_repeats_the_training_and_another_does_not,
    test_it_trains_and_sends_no_illegal_action,
    test_the_hash_seed_changes_nothing,
)

pytestmark = [pytest.mark.adapter, pytest.mark.filterwarnings("default")]
CHANGED_SHARE = 0.5
"""Of the parameters; some actors of a group learn nothing in a short training."""


def parameters(agent) -> Parameters:
    networks = agent.actors.items()
    return {
        f"{group}.{name}": value.detach().numpy().copy()
        for group, net in networks
        for name, value in net.named_parameters()
    }


def trained(workshop, seed: int, algorithm: str = "IPPO", masks: str = "list") -> tuple[Parameters, Parameters]:
    import torch
    from agilerl import algorithms
    from agilerl.components.replay_buffer import ReplayBuffer
    from agilerl.training.train_multi_agent_off_policy import train_multi_agent_off_policy
    from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy

    from fleet.env.adapters.agilerl import AgileRLEnv

    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002  # AgileRL shuffles by the global one
    torch.manual_seed(seed)
    env = AgileRLEnv(workshop(), masks=masks)
    env.reset(seed=seed)
    arms = env.possible_agents
    spaces = [env.observation_space(arm) for arm in arms], [env.action_space(arm) for arm in arms]
    options = {"learn_step": 30, "batch_size": 16, "net_config": {"latent_dim": 16}}
    common = {"max_steps": 120, "evo_steps": 60, "eval_steps": 15, "verbose": False}
    if algorithm == "IPPO":
        agent = algorithms.IPPO(*spaces, agent_ids=arms, lr=1e-3, **options)
        before = parameters(agent)
        train_multi_agent_on_policy(env, "small", algorithm, [agent], **common)
    else:
        agent = getattr(algorithms, algorithm)(*spaces, agent_ids=arms, **options)
        before = parameters(agent)
        train_multi_agent_off_policy(env, "small", algorithm, [agent], ReplayBuffer(1000), **common)
    return before, parameters(agent)


@pytest.fixture(scope="module", params=[("IPPO", "list"), ("MADDPG", "list"), ("MATD3", "array")], ids="-".join)
def session(request, small_workshop):
    workshop = small_workshop()
    return workshop.log, *trained(workshop, 0, *request.param)


@pytest.mark.parametrize("masks", ["list", "array"])
def test_it_is_the_environment_with_the_mask_elsewhere(small_workshop, by_hand, ending, masks) -> None:
    from fleet.env.adapters.agilerl import AgileRLEnv

    env, plain = AgileRLEnv(small_workshop(**ending.shift)(), masks=masks), small_workshop(**ending.shift)()

    def same(seen, infos, there, infos_there) -> None:
        for arm in plain.possible_agents:
            assert env.observation_space(arm) is env.observation_space(arm)
            assert env.observation_space(arm).contains(seen[arm])
            np.testing.assert_array_equal(seen[arm], there[arm]["observation"])
            assert isinstance(infos[arm]["action_mask"], list if masks == "list" else np.ndarray)
            np.testing.assert_array_equal(infos[arm].pop("action_mask"), there[arm]["action_mask"])
            assert infos[arm] == infos_there[arm]

    begin, infos_there = plain.reset(seed=3)
    same(*env.reset(seed=3), begin, infos_there)
    for turn in by_hand.turns(plain, begin, by_hand.claim_by_chance(3)):
        seen, rewards, terminated, truncated, infos = env.step(turn.claims)
        same(seen, infos, turn.seen, turn.infos)
        assert (rewards, terminated, truncated) == (turn.rewards, turn.terminated, turn.truncated)
        if turn.last:
            assert turn.ends == (ending.finished, not ending.finished)
    assert env.agents == []


def test_a_reset_brings_the_infos_of_the_end_up_to_date(small_workshop) -> None:
    """AgileRL's own loop acts by them in the new episode."""
    from fleet.env.adapters.agilerl import AgileRLEnv

    env = AgileRLEnv(small_workshop(ticks=3)(), masks="list")
    env.reset(seed=1)
    kept = [env.step(dict.fromkeys(env.possible_agents, 0))[-1] for _ in range(3)]
    before = [repr(infos) for infos in kept]
    _, fresh = env.reset(seed=2)
    assert kept[2] == fresh
    assert repr(fresh) != before[2]
    assert [repr(infos) for infos in kept[:2]] == before[:2]


def test_the_example_of_the_page_runs(example) -> None:
    told = example("AgileRL")
    assert set(told["actions"]) == {"arm_0", "arm_1", "arm_2"}
    for arm, claim in told["actions"].items():
        assert told["infos"][arm]["action_mask"][int(claim[0])] == 1
