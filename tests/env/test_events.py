"""Steps that last until an arm may claim a job, against steps of one decision interval."""

import numpy as np
import pytest

from agents.registry import RULES, make_policy
from fleet.bus.exchange.memory import MemoryExchange
from fleet.engine.state import State
from fleet.env.allocation_v1 import parallel_env
from fleet.env.vector import BatchEnv
from fleet.telemetry import WORKING

SEED = 7


def first_legal(mask) -> np.ndarray:
    """Claim the first slot that may be claimed, else wait: int [...] of masks [..., action]."""
    claims = np.asarray(mask)[..., 1:-1]
    return np.where(claims.any(axis=-1), claims.argmax(axis=-1) + 1, 0)


def played(env, seed=SEED):
    """Play an episode; return its state, its rewards and the seconds of each step."""
    observations, _ = env.reset(seed=seed)
    rewards, seconds = [], []
    while env.agents:
        actions = {arm: int(first_legal(seen["action_mask"])) for arm, seen in observations.items()}
        observations, reward, _, _, infos = env.step(actions)
        rewards.append(next(iter(reward.values())))
        seconds.append(next(iter(infos.values()))["elapsed_s"])
    return env.truth, rewards, seconds


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_episode_ends_the_same_in_fewer_steps(small, seed) -> None:
    shifts = small.Shifts(ticks=80)
    every, all_rewards, intervals = played(parallel_env(shifts), seed)
    some, rewards, seconds = played(parallel_env(shifts, decisions="events"), seed)
    for name in State._fields:
        if name != "last_award":  # of the last step
            np.testing.assert_array_equal(getattr(some, name), getattr(every, name), err_msg=name)
    assert sum(rewards) == pytest.approx(sum(all_rewards), rel=1e-12)
    assert sum(seconds) == sum(intervals)
    assert len(seconds) < len(intervals) / 2
    assert set(intervals) == {10.0}


@pytest.mark.parametrize("name", [name for name, rule in RULES.items() if not rule.plans])
def test_a_policy_plays_the_same_shift_with_both_lengths_of_steps(small, name) -> None:
    """Also one that reads which claims lost, which is known at once and not only at the next choice."""
    ends = []
    for decisions in ("interval", "events"):
        env, policy = parallel_env(small.Shifts(ticks=80, crowding=0.5), decisions=decisions), make_policy(name)
        for seed in range(3):
            env.reset(seed=seed)
            policy.reset(np.random.default_rng(seed))
            while env.agents:
                env.step(policy.act(env.knowledge()))
            ends.append(env.truth.finished_s)
    np.testing.assert_array_equal(ends[:3], ends[3:])


def test_a_step_ends_as_soon_as_an_arm_may_claim_a_job(small) -> None:
    env = parallel_env(small.Shifts(ticks=80), decisions="events")
    observations, _ = env.reset(seed=SEED)
    while env.agents:
        actions = {arm: int(first_legal(seen["action_mask"])) for arm, seen in observations.items()}
        observations, _, over, cut, _ = env.step(actions)
        ended = any((*over.values(), *cut.values()))
        may_claim = any(seen["action_mask"][1:-1].any() for seen in observations.values())
        at_work = env.truth.mode[0] == WORKING
        warned = (env.truth.temp_c[0, :, :7].max(axis=1) >= env.world.limits.warning_c) & at_work
        assert ended or may_claim or warned.any()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_steps_as_the_single_environment(small, threads) -> None:
    shifts, envs = small.Shifts(ticks=60), 5
    batch = BatchEnv(shifts.library(), envs, seed=SEED, autoreset=False, decisions="events", threads=threads)
    obs, _ = batch.reset()
    rewards, seconds = np.zeros(envs), np.zeros(envs)
    running = np.ones(envs, bool)
    final = {}
    while running.any():
        obs, reward, over, cut, info = batch.step(first_legal(obs["action_mask"]))
        rewards[running] += reward[running]
        seconds[running] += info["elapsed_s"][running]
        ended = over | cut
        state = batch.state
        final |= {e: (state.finished_s[e], state.temp_c[e]) for e in np.flatnonzero(ended & running).tolist()}
        running &= ~ended
        if running.any():
            obs, _ = batch.reset(rows=ended)
    for e in range(envs):
        truth, single, spans = played(parallel_env(shifts, decisions="events"), SEED + e)
        jobs = truth.finished_s.shape[1]
        np.testing.assert_array_equal(final[e][0][:jobs], truth.finished_s[0])
        np.testing.assert_array_equal(final[e][1], truth.temp_c[0])
        assert rewards[e] == pytest.approx(sum(single), rel=1e-12)
        assert seconds[e] == sum(spans)


def test_bad_choices_are_refused(small) -> None:
    shifts = small.Shifts()
    for given in ("event", None, 1):
        with pytest.raises(ValueError, match="decisions must be one of 'interval', 'events'"):
            parallel_env(shifts, decisions=given)
        with pytest.raises(ValueError, match="decisions must be one of 'interval', 'events'"):
            BatchEnv(shifts.library(), 2, decisions=given)
    library = shifts.library()
    with pytest.raises(ValueError, match="takes no exchanges"):
        BatchEnv(library, 1, decisions="events", exchanges=[MemoryExchange(library.arms)])
