"""Tianshou takes the environment: masked DQN, one network for all arms, a few updates."""

import numpy as np
import pytest

from tests.adapters.training import (  # noqa: F401 -- the tests of every trainer
    Parameters,
    parameters,
    test_a_seed_repeats_the_training_and_another_does_not,
    test_it_trains_and_sends_no_illegal_action,
    test_the_hash_seed_changes_nothing,
)

pytestmark = pytest.mark.adapter


def trained(workshop, seed: int) -> tuple[Parameters, Parameters]:
    import torch
    from tianshou.algorithm import DQN
    from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
    from tianshou.algorithm.multiagent.marl import MultiAgentOffPolicyAlgorithm
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OffPolicyTrainerParams
    from tianshou.utils.net.common import Net

    from fleet.env.adapters.tianshou import TianshouEnv

    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002  # Tianshou explores and samples by the global one
    env = TianshouEnv(workshop())
    arms = len(env.agents)
    net = Net(
        state_shape=env.observation_space["observation"].shape, action_shape=env.action_space.n, hidden_sizes=(32,)
    )
    before = parameters(net)
    policy = DiscreteQLearningPolicy(model=net, action_space=env.action_space, eps_training=0.5, eps_inference=0.5)
    optim = AdamOptimizerFactory(lr=1e-3)
    dqn = DQN(policy=policy, optim=optim, n_step_return_horizon=arms, target_update_freq=5)
    team = MultiAgentOffPolicyAlgorithm(algorithms=[dqn] * arms, env=env)
    envs = DummyVectorEnv([lambda: TianshouEnv(workshop()) for _ in range(2)])
    envs.seed(seed)
    collector = Collector(team, envs, VectorReplayBuffer(2000, 2), exploration_noise=True)
    collector.reset()
    team.run_training(
        OffPolicyTrainerParams(
            training_collector=collector,
            max_epochs=2,
            epoch_num_steps=180,
            collection_step_num_env_steps=60,
            update_step_num_gradient_steps_per_sample=0.1,
            batch_size=32,
            multi_agent_return_reduction=lambda rewards: rewards.mean(axis=1),
            verbose=False,
            show_progress=False,
        )
    )
    return before, parameters(net)


@pytest.fixture(scope="module")
def session(small_workshop):
    workshop = small_workshop()
    return workshop.log, *trained(workshop, seed=0)


def test_turns_are_the_steps_of_the_environment(small_workshop, by_hand, ending) -> None:
    from fleet.env.adapters.tianshou import TianshouEnv

    workshop = small_workshop(**ending.shift)
    env, plain = TianshouEnv(workshop()), workshop()
    (seen, _), (begin, _) = env.reset(seed=3), plain.reset(seed=3)
    for turn in by_hand.turns(plain, begin, by_hand.claim_by_chance(3)):
        for arm, claim in turn.claims.items():
            assert seen["agent_id"] == arm
            np.testing.assert_array_equal(seen["obs"], turn.before[arm]["observation"])
            np.testing.assert_array_equal(seen["mask"], turn.before[arm]["action_mask"] == 1)
            seen, rewards, terminated, truncated, _ = env.step(claim)
            if arm != "arm_2":
                assert not rewards.any()
                assert (terminated, truncated) == (False, False)
                continue
            np.testing.assert_allclose(rewards, list(turn.rewards.values()), rtol=1e-6)
            assert (terminated, truncated) == turn.ends
        np.testing.assert_array_equal(seen["obs"], turn.seen["arm_0"]["observation"])
        if turn.last:
            assert turn.ends == (ending.finished, not ending.finished)
    assert plain.agents == []


def test_rewards_of_a_turn_are_not_written_on(small_workshop) -> None:
    from fleet.env.adapters.tianshou import TianshouEnv

    env = TianshouEnv(small_workshop()())
    env.reset(seed=0)
    _, first, *_ = env.step(0)
    kept = first.copy()
    for _ in range(20):
        env.step(0)
    np.testing.assert_array_equal(first, kept)


def test_the_example_of_the_page_runs(example) -> None:
    seen = example("Tianshou")["observation"]
    assert (seen["agent_id"], seen["mask"][0]) == ("arm_0", True)
