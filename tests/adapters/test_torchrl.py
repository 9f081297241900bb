"""TorchRL takes the batch: specs, masks, seeds, resets and ends, against the batch itself."""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import PettingZooWrapper, RewardSum, TransformedEnv, check_env_specs
from torchrl.modules import MaskedCategorical

from fleet.engine.batch import TERMS
from fleet.env.adapters.torchrl import TorchRLEnv
from fleet.env.allocation_v2 import parallel_env
from fleet.env.vector import BatchEnv

ARMS, TICKS = 3, 15


@pytest.fixture(scope="module")
def make(small_batch):
    """Makes environments of small shifts: `make(envs, seed, state=…, infos=…, jobs=…)`."""

    def make(envs: int = 5, seed: int | None = 3, *, joined=True, state=False, infos=False, **shift) -> TorchRLEnv:
        return TorchRLEnv(batch(envs, **shift), seed=seed, joined=joined, state=state, infos=infos)

    def batch(envs: int, *, autoreset: bool = False, **shift) -> BatchEnv:
        return small_batch(num_envs=envs, autoreset=autoreset, **shift)

    make.batch = batch
    return make


BRIEF = {"jobs": 1, "ambient_c": 20.0, "ticks": 30}
"""Shifts of one job: every row finishes it, each at another time."""


def rolled(env: TorchRLEnv, steps: int, seed: int = 0) -> TensorDict:
    torch.manual_seed(seed)
    return env.rollout(steps, break_when_any_done=False)


def same(one: TensorDict, two: TensorDict) -> bool:
    return bool((one == two).all())


@pytest.mark.parametrize(
    ("envs", "switches"), [(1, {"infos": True}), (4, {}), (4, {"joined": False, "state": True})], ids=str
)
def test_torchrl_finds_the_specs_kept(make, envs, switches) -> None:
    check_env_specs(make(envs, **switches))
    check_env_specs(make(envs, **switches), break_when_any_done=False)


def test_the_parts_of_an_observation_joined_are_its_vectors(make) -> None:
    whole, parts = rolled(make(4), 30), rolled(make(4, joined=False), 30)
    shared = parts["shared"].unsqueeze(-2).expand(4, 30, ARMS, -1)
    assert torch.equal(torch.cat([shared, parts["arms", "own"]], dim=-1), whole["arms", "observation"])
    assert torch.equal(parts["arms", "action"], whole["arms", "action"])


@pytest.mark.parametrize("shift", [{"hard_due": 0.0, "ambient_c": 58.0}, BRIEF], ids=["cut", "brief"])
def test_a_rollout_is_the_batch_stepped_by_hand(make, shift) -> None:
    """The second way: a batch that begins new shifts by itself, given the same claims."""
    frames = rolled(make(6, seed=11, state=True, infos=True, **shift), 70)
    batch = make.batch(6, autoreset=True, **shift)
    obs = batch.joined(batch.reset(seed=11)[0])
    for at in range(70):
        now, after = frames[:, at], frames["next"][:, at]
        np.testing.assert_array_equal(now["arms", "observation"], obs["observation"])
        np.testing.assert_array_equal(now["arms", "action_mask"], obs["action_mask"] == 1)
        np.testing.assert_array_equal(now["state"], obs["observation"].reshape(6, -1))
        parts, reward, terminated, truncated, info = batch.step(now["arms", "action"].numpy())
        obs = batch.joined(parts)
        last = {key: value.copy() for key, value in obs.items()}
        for key, value in batch.joined(info["final_obs"]).items():
            last[key][info["final_envs"]] = value
        np.testing.assert_array_equal(after["arms", "observation"], last["observation"])
        np.testing.assert_array_equal(after["arms", "action_mask"], last["action_mask"] == 1)
        np.testing.assert_array_equal(after["arms", "reward"], np.float32(reward)[:, None, None].repeat(ARMS, axis=1))
        np.testing.assert_array_equal(after["terminated"][:, 0], terminated)
        np.testing.assert_array_equal(after["truncated"][:, 0], truncated)
        np.testing.assert_array_equal(after["done"][:, 0], terminated | truncated)
        for name in ("faults", "illegal", "peak_c", "above_warning_s"):
            np.testing.assert_array_equal(after["arms", "info", name][..., 0], np.float32(info[name]))
        for name in ("jobs_done", "elapsed_s"):
            np.testing.assert_array_equal(after["info", name][:, 0], info[name])
        each = np.repeat(info["elapsed_s"][:, None], ARMS, axis=1)
        np.testing.assert_array_equal(after["arms", "elapsed_s"][..., 0], each)
    terms = sum(frames["next", "info", f"reward_{term}"] for term in TERMS)
    np.testing.assert_allclose(terms, frames["next", "arms", "reward"][:, :, 0], rtol=1e-5, atol=1e-5)
    assert (frames["arms", "action"] > 0).sum() > 20
    assert frames["next", "arms", "info", "illegal"].max() == 0
    assert frames["next", "done"].sum() >= 6
    assert bool(frames["next", "terminated"].any()) == (shift is BRIEF)
    assert bool(frames["next", "truncated"].any()) == (shift is not BRIEF)
    assert frames["next", "info", "jobs_done"].max() > 0
    assert bool((frames["next", "arms", "info", "above_warning_s"] > 0).any()) == (shift is not BRIEF)


def test_what_is_sent_against_the_mask_waits_and_is_counted(make) -> None:
    env = make(2, infos=True)
    seen = env.reset()
    seen["arms", "action_mask"][..., 1:] = True
    seen["arms", "action"] = torch.full(
        (2, ARMS), env.layout.actions - 2
    )  # only the first two slots can hold a job so early
    assert (env.step(seen)["next", "arms", "info", "illegal"] == 1).all()


def test_a_seed_repeats_the_shifts_and_another_does_not(make) -> None:
    first = rolled(make(4, seed=0), 40)
    assert same(first, rolled(make(4, seed=0), 40))
    assert not same(first, rolled(make(4, seed=1), 40))
    env = make(4, seed=5)
    rolled(env, 7)
    assert env.set_seed(0) != 0
    assert same(first, rolled(env, 40))
    assert not same(first, rolled(env, 40))  # the next shifts, not the same again
    assert env.set_seed(0, static_seed=True) == 0
    assert same(first, rolled(env, 40))


def test_without_a_seed_the_batch_keeps_its_own_and_none_is_another_each_time(make) -> None:
    unseeded = TorchRLEnv(make.batch(2, seed=9)).reset()
    assert same(unseeded, make(2, seed=9).reset())
    env = make(2)
    env.set_seed(None)
    one = env.reset()
    env.set_seed(None)
    assert not same(one, env.reset())


def test_a_partial_reset_leaves_the_others_alone(make) -> None:
    env = make(3)
    seen = env.reset()
    for _ in range(4):
        seen = env.step_mdp(env.step(env.rand_action(seen)))
    before = seen.clone()
    seen["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(seen)
    assert same(after[0].exclude("_reset", "arms"), before[0].exclude("_reset", "arms"))
    for key in ("observation", "action_mask"):
        assert (after["arms", key][[0, 2]] == before["arms", key][[0, 2]]).all()
    layout = env.batch.layout
    left_s = layout.read(after["arms", "observation"].numpy(), after["arms", "action_mask"].numpy()).left_s[:, 0]
    np.testing.assert_allclose(left_s, 10.0 * (TICKS - np.array([4, 0, 4])))


def test_a_rollout_until_all_are_done_waits_for_the_last(make) -> None:
    env = make(8, infos=True, **BRIEF)
    torch.manual_seed(0)
    frames = env.rollout(100, break_when_any_done=False, break_when_all_done=True)
    done = frames["next", "done"][..., 0]
    assert done[:, -1].all()
    assert not done[:, -2].all()
    ended = done.int().argmax(dim=1)
    assert len(set(ended.tolist())) > 1
    for row, at in enumerate(ended.tolist()):
        for later in range(at, frames.shape[1]):
            assert same(frames["next"][row, later], frames["next"][row, at])
    assert not env.rollout(3)["next", "done"].any()


def test_only_what_is_done_may_be_left_out_of_a_step(make) -> None:
    env = make(2)
    seen = env.rand_action(env.reset())
    seen["_step"] = torch.tensor([[True], [False]])
    with pytest.raises(ValueError, match="only leave out envs that are done"):
        env.step(seen)


def test_a_step_after_the_end_says_what_to_call(make) -> None:
    env = make(2)
    last = env.rollout(TICKS)[:, -1]
    assert last["next", "truncated"].all()
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(env.rand_action(env.step_mdp(last)))


def test_a_batch_that_resets_by_itself_and_what_is_no_batch_are_refused(make) -> None:
    with pytest.raises(ValueError, match="autoreset=False"):
        TorchRLEnv(make.batch(2, autoreset=True))
    with pytest.raises(ValueError, match=r"TorchRLEnv takes a batch made by thermofleet\.make_batch\(\) \(got "):
        TorchRLEnv("quickstart")  # pyright: ignore[reportArgumentType]
    wrong: Any = ({"seed": -1}, r"seed must be an integer from 0 to"), ({"joined": "x"}, "joined must be True or False")
    for options, says in wrong:
        with pytest.raises(ValueError, match=says):
            TorchRLEnv(make.batch(2), **options)


def masked(frames: TensorDict) -> TensorDict:
    logits = torch.zeros(frames["arms", "action_mask"].shape)
    frames["arms", "action"] = MaskedCategorical(logits=logits, mask=frames["arms", "action_mask"]).sample()
    return frames


@pytest.mark.parametrize("compact", [False, True])
def test_a_collector_with_a_masked_policy_sends_no_illegal_action(make, compact) -> None:
    torch.manual_seed(0)
    returns = RewardSum(in_keys=[("arms", "reward")], out_keys=[("arms", "episode_reward")])
    env = TransformedEnv(make(8, infos=True), returns)
    collector = Collector(env, masked, frames_per_batch=8 * TICKS, total_frames=8 * TICKS * 3, compact_obs=compact)
    batches = [frames.clone() for frames in collector]
    collector.shutdown()
    for frames in batches:
        assert frames["next", "truncated"].sum() == 8
        assert frames["arms", "action_mask"].gather(-1, frames["arms", "action"][..., None]).all()
        assert frames["arms", "info", "illegal"].max() == 0
        if not compact:  # it leaves out of "next" what the next frame has
            total = frames["next", "arms", "reward"].sum(dim=1)
            torch.testing.assert_close(frames["next", "arms", "episode_reward"][:, -1], total)
    assert not same(batches[0], batches[1])


def test_all_arms_are_one_group_and_it_closes_once(make) -> None:
    env = make()
    assert env.group_map == {"arms": ["arm_0", "arm_1", "arm_2"]}
    env.close()
    assert env.is_closed


def test_the_example_of_the_page_discounts_by_elapsed_time(example) -> None:
    """The second way: the advantages by hand, from the last step to the first."""
    told = example("TorchRL")
    frames, each = told["frames"], told["frames"]["next", "arms"]
    assert frames["arms", "action_mask"].gather(-1, frames["arms", "action"][..., None]).all()
    assert len(each["elapsed_s"].unique()) > 3
    gamma = torch.exp(-each["elapsed_s"].double() / 7200)
    critic = told["critic"]
    value, after = (critic(part.clone())["arms", "state_value"].detach() for part in (frames, frames["next"]))
    terminated, done = (frames["next", end][..., None].double() for end in ("terminated", "done"))
    advantage = torch.zeros(16, ARMS, 1, dtype=torch.float64)
    for at in reversed(range(frames.shape[1])):
        now = (slice(None), at)
        td = each["reward"][now] + gamma[now] * (1 - terminated[now]) * after[now] - value[now]
        advantage = td + 0.95 * gamma[now] * (1 - done[now]) * advantage
        torch.testing.assert_close(frames["advantage"][now].double(), advantage, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("mask_in", ["obs", "info"])
def test_torchrls_own_wrapper_takes_the_single_env(small, mask_in) -> None:
    env = parallel_env(small.Shifts(arms=ARMS, ticks=TICKS), mask_in=mask_in)
    with pytest.warns(UserWarning, match="PettingZoo in TorchRL"):
        wrapped = PettingZooWrapper(env)
    frames = wrapped.rollout(5)
    assert frames["next", "arm", "action_mask"].any(-1).all()
    vector = ("observation", "observation") if mask_in == "obs" else ("observation",)
    assert frames[("next", "arm", *vector)].shape[-1] == env.layout.size
