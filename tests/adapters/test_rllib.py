"""RLlib takes the environment: masked PPO, one policy for all arms, a few iterations."""

import gc
from collections.abc import Iterator

import numpy as np
import pytest

from tests.adapters.training import (  # noqa: F401 -- the tests of every trainer
    Parameters,
    test_a_seed_repeats_the_training_and_another_does_not,
    test_it_trains_and_sends_no_illegal_action,
    test_the_hash_seed_changes_nothing,
)

pytestmark = [
    pytest.mark.adapter,
    # Its vectors of environments are closed twice and complain in __del__.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    # It registers its one Gymnasium id anew for every algorithm.
    pytest.mark.filterwarnings("ignore:.*Overriding environment rllib-multi-agent-env-v0"),
]


def parameters(algo) -> Parameters:
    return {name: value.detach().numpy().copy() for name, value in algo.get_module("arm").named_parameters()}


def built(workshop, seed: int):
    """The algorithm, with its environment in this process."""
    import ray

    from fleet.env.adapters.rllib import masked_ppo

    if not ray.is_initialized():
        ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = masked_ppo(workshop).env_runners(num_env_runners=0).debugging(seed=seed)
    return config.training(train_batch_size=60, minibatch_size=60, num_epochs=2, lr=1e-3).build_algo()


def trained(workshop, seed: int) -> tuple[Parameters, Parameters]:
    algo = built(workshop, seed)
    before = parameters(algo)
    for _ in range(2):
        algo.train()
    after = parameters(algo)
    algo.stop()
    return before, after


@pytest.fixture(scope="module", autouse=True)
def quiet(home) -> Iterator[None]:
    """Ray without tokens and reports, and gone at the end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        yield
        import ray

        ray.shutdown()


@pytest.fixture(autouse=True)
def swept() -> Iterator[None]:
    """What is left of a test goes while its complaints are not heard."""
    yield
    gc.collect()


@pytest.fixture(scope="module")
def session(small_workshop):
    workshop = small_workshop()
    return workshop.log, *trained(workshop, seed=0)


def test_an_episode_ends_as_the_environment_says(small_workshop, ending) -> None:
    """RLlib bootstraps the value of the last state of a cut episode, and only of such a one."""
    algo, finished = built(small_workshop(**ending.shift), seed=0), ending.finished
    for episode in algo.env_runner.sample(num_episodes=2, random_actions=finished):
        assert episode.is_done
        assert (episode.is_terminated, episode.is_truncated) == (finished, not finished)
        for own in episode.agent_episodes.values():
            assert (own.is_terminated, own.is_truncated) == (finished, not finished)
            assert len(own) == (len(episode) if finished else 6)
    algo.stop()


def test_the_last_observation_comes_with_the_end(small_workshop, by_hand) -> None:
    from fleet.env.adapters.rllib import RLlibEnv

    env, plain = RLlibEnv(small_workshop(ticks=4)()), small_workshop(ticks=4)()
    assert env.get_observation_space(1).keys() == {"action_mask", "observations"}
    (seen, _), (begin, _) = env.reset(seed=1), plain.reset(seed=1)
    terminated, truncated = {}, {}
    for turn in by_hand.turns(plain, begin, by_hand.claim_by_chance(1)):
        for i, there in enumerate(turn.before.values()):
            np.testing.assert_array_equal(seen[i]["observations"], there["observation"])
            np.testing.assert_array_equal(seen[i]["action_mask"], there["action_mask"])
            assert env.get_observation_space(i).contains(seen[i])
        assert env.agents == env.possible_agents == [0, 1, 2]
        seen, rewards, terminated, truncated, _ = env.step(dict(enumerate(turn.claims.values())))
        assert list(rewards.values()) == list(turn.rewards.values())
        np.testing.assert_array_equal(seen[2]["observations"], turn.seen["arm_2"]["observation"])
    assert (terminated, truncated, env.agents) == ({"__all__": False}, {"__all__": True}, [])
    assert env.render() is None
    env.close()


def test_the_example_of_the_page_runs(example) -> None:
    told = example("RLlib")
    assert told["log"].steps >= 600
    assert told["log"].illegal == 0
    told["algo"].stop()
