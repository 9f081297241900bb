"""Stable-Baselines3 takes the batch: MaskablePPO with one policy for all arms, every arm a row."""

import numpy as np
import pytest

from tests.adapters.training import parameters, test_the_hash_seed_changes_nothing  # noqa: F401

pytestmark = pytest.mark.adapter
ARMS, ENVS, TICKS = 3, 4, 15
BRIEF = {"jobs": 1, "ambient_c": 20.0, "ticks": 30}
"""Shifts of one job: every env finishes it, each at another time."""
MANY = {"jobs": 16}
"""More jobs than the arms can do until the horizon."""


class Watch:
    """Notes in a log what reaches a batch, and how its shifts end."""

    def __init__(self, batch, log) -> None:
        self.batch, self.log = batch, log

    def __getattr__(self, name):
        return getattr(self.batch, name)

    def reset(self, *args, **kwargs):
        obs, info = self.batch.reset(*args, **kwargs)
        self.legal = obs["action_mask"].copy()
        return obs, info

    def step(self, actions):
        self.log.steps += 1
        self.log.claims += int((actions > 0).sum())
        self.log.illegal += int((np.take_along_axis(self.legal, actions[..., None], axis=-1) == 0).sum())
        told = self.batch.step(actions)
        self.legal = told[0]["action_mask"].copy()
        return told


def trained(workshop, seed: int, *, observation: str = "vector", algo: str = "MaskablePPO", extra: int = 0):
    import torch
    from sb3_contrib import MaskablePPO
    from stable_baselines3 import PPO

    from fleet.env.adapters.sb3 import ArmsVecEnv
    from fleet.env.vector import BatchEnv

    torch.set_num_threads(1)
    rows = ArmsVecEnv(Watch(BatchEnv(workshop.shifts.library(), ENVS), workshop.log), observation=observation)
    policy = "MlpPolicy" if observation == "vector" else "MultiInputPolicy"
    kind = {"MaskablePPO": MaskablePPO, "PPO": PPO}[algo]
    agent = kind(policy, rows, n_steps=32, batch_size=96, n_epochs=2, seed=seed, device="cpu")
    before = parameters(agent.policy)
    agent.learn(3 * 32 * ENVS * ARMS)
    trained.agent = agent
    return before, parameters(agent.policy)


@pytest.fixture(scope="module", params=["vector", "dict"])
def session(request, small_workshop):
    workshop = small_workshop(**MANY)
    return workshop.log, request.param, *trained(workshop, seed=0, observation=request.param), trained.agent


def test_it_trains_and_sends_no_illegal_action(session) -> None:
    log, _, before, after, agent = session
    assert log.steps == 3 * 32
    assert log.claims > 100
    assert log.illegal == 0
    assert all(np.isfinite(value).all() for value in after.values())
    assert all((before[name] != after[name]).any() for name in before)
    assert agent.num_timesteps == 3 * 32 * ENVS * ARMS


def test_it_counts_the_episodes(session) -> None:
    *_, agent = session
    told = list(agent.ep_info_buffer)
    assert len(told) == (3 * 32 // TICKS) * ENVS * ARMS
    assert {each["l"] for each in told} == {TICKS}


def test_a_seed_repeats_the_training_and_another_does_not(session, small_workshop) -> None:
    _, kind, _, after, _ = session
    _, again = trained(small_workshop(**MANY), seed=0, observation=kind)
    _, other = trained(small_workshop(**MANY), seed=1, observation=kind)
    for name in after:
        np.testing.assert_array_equal(again[name], after[name])
    assert any((other[name] != after[name]).any() for name in after)


def test_ppo_without_masks_trains_and_its_illegal_actions_are_counted(small_workshop) -> None:
    workshop = small_workshop()
    before, after = trained(workshop, seed=0, algo="PPO")
    assert workshop.log.illegal > 0
    assert any((before[name] != after[name]).any() for name in before)


@pytest.mark.parametrize("kind", ["vector", "dict"])
@pytest.mark.parametrize("shift", [{}, BRIEF], ids=["cut", "finished"])
def test_the_rows_are_the_arms_of_the_batch(small_batch, shift, kind) -> None:
    """The second way: the same claims given to a batch."""
    from fleet.env.adapters.sb3 import ArmsVecEnv

    rows, batch = ArmsVecEnv(small_batch(num_envs=ENVS, **shift), observation=kind), small_batch(num_envs=ENVS, **shift)
    assert list(rows.seed(5)) == [5] * ARMS + [6] * ARMS + [7] * ARMS + [8] * ARMS
    seen = rows.reset()
    obs = batch.joined(batch.reset(5)[0])
    rng = np.random.default_rng(5)
    returns, ends = np.zeros(ENVS), 0
    for _ in range(40):
        vector = seen if kind == "vector" else seen["observation"]
        for row in range(ENVS * ARMS):
            np.testing.assert_array_equal(vector[row], obs["observation"][row // ARMS, row % ARMS])
            legal = obs["action_mask"][row // ARMS, row % ARMS]
            np.testing.assert_array_equal(rows.env_method("action_masks", indices=[row])[0], legal == 1)
            if kind == "dict":
                np.testing.assert_array_equal(seen["action_mask"][row], legal)
        actions = rng.integers(0, 5, ENVS * ARMS)
        seen, reward, over, infos = rows.step(actions)
        parts, there, terminated, truncated, info = batch.step(actions.reshape(ENVS, ARMS))
        obs, ended = batch.joined(parts), batch.joined(info["final_obs"])
        np.testing.assert_array_equal(reward, np.float32(there).repeat(ARMS))
        np.testing.assert_array_equal(over, (terminated | truncated).repeat(ARMS))
        returns += there
        final = info["final_envs"].tolist()
        for row, told in enumerate(infos):
            env, arm = divmod(row, ARMS)
            assert bool(told) == (env in final)
            if told:
                last = {key: value[final.index(env), arm] for key, value in ended.items()}
                here = (
                    {"observation": told["terminal_observation"]} if kind == "vector" else told["terminal_observation"]
                )
                for key, value in here.items():
                    np.testing.assert_array_equal(value, last[key])
                assert told["TimeLimit.truncated"] == truncated[env]
                assert told["illegal"] == info["illegal"][env, arm]
                assert told["episode"]["r"] == pytest.approx(returns[env])
                ends += 1
        returns[final] = 0.0
    assert ends >= ENVS * ARMS


def test_wrappers_pass_masks_seed_and_statistics_on(small_batch) -> None:
    from sb3_contrib import MaskablePPO
    from sb3_contrib.common.maskable.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecNormalize

    from fleet.env.adapters.sb3 import ArmsVecEnv

    rows = VecNormalize(ArmsVecEnv(small_batch(num_envs=2)), norm_reward=False)
    agent = MaskablePPO("MlpPolicy", rows, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    agent.learn(2 * 16 * 2 * ARMS)
    returns, lengths = evaluate_policy(agent, rows, n_eval_episodes=12, return_episode_rewards=True)
    assert (len(returns), set(lengths)) == (12, {TICKS})


def test_a_dispatcher_of_gymnasium_trains_with_masks(small_workshop) -> None:
    from sb3_contrib import MaskablePPO

    from fleet.env.adapters.gymnasium_view import DispatcherEnv

    workshop = small_workshop()
    env = DispatcherEnv(workshop())
    agent = MaskablePPO("MultiInputPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu")
    agent.learn(128)
    assert (workshop.log.steps, workshop.log.illegal) == (128, 0)
    assert workshop.log.claims > 20


def test_what_cannot_be_is_said(small_batch) -> None:
    from fleet.env.adapters.sb3 import ArmsVecEnv

    with pytest.raises(ValueError, match="one of 'vector', 'dict'"):
        ArmsVecEnv(small_batch(), observation="flat")
    with pytest.raises(ValueError, match=r"ArmsVecEnv takes a batch made by thermofleet\.make_batch\(\) \(got 'x'\)"):
        ArmsVecEnv("x")
    with pytest.raises(ValueError, match="autoreset=True"):
        ArmsVecEnv(small_batch(autoreset=False))
    rows = ArmsVecEnv(small_batch())
    with pytest.raises(AttributeError, match="There is: action_masks"):
        rows.env_method("step")
    with pytest.raises(AttributeError, match="There are: action_masks"):
        rows.get_attr("state")
    with pytest.raises(AttributeError, match="cannot be set"):
        rows.set_attr("slots", 3)


def test_the_example_of_the_page_runs(example) -> None:
    told = example("Stable-Baselines3")
    assert told["model"].num_timesteps >= 2000
