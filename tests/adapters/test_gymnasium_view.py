"""Gymnasium takes the environment as one dispatcher, alone and in many shifts at once."""

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from fleet.env.adapters.gymnasium_view import DispatcherEnv, DispatcherVectorEnv

ARMS, TICKS = 3, 15
BRIEF = {"jobs": 1, "ambient_c": 20.0, "ticks": 30}
"""Shifts of one job: every env finishes it, each at another time."""


@pytest.fixture
def alone(small_workshop):
    return lambda **shift: DispatcherEnv(small_workshop(**shift)())


@pytest.fixture
def many(small_batch):
    return lambda envs=4, *, autoreset=True, **shift: DispatcherVectorEnv(
        small_batch(num_envs=envs, autoreset=autoreset, **shift)
    )


def test_gymnasium_finds_the_contract_kept(alone) -> None:
    check_env(alone(), skip_render_check=True)


@pytest.mark.parametrize("shift", [{}, BRIEF], ids=["cut", "finished"])
def test_the_dispatcher_is_the_environment_itself(small_workshop, alone, shift) -> None:
    """The second way: the same claims given to the environment, arm by arm."""
    env, plain = alone(**shift), small_workshop(**shift)()
    seen, info = env.reset(seed=4)
    there, _ = plain.reset(seed=4)
    env.action_space.seed(4)
    over = False
    while not over:
        for a, arm in enumerate(plain.possible_agents):
            np.testing.assert_array_equal(seen["observation"][a], there[arm]["observation"])
            np.testing.assert_array_equal(seen["action_mask"][a], there[arm]["action_mask"])
            np.testing.assert_array_equal(info["action_mask"][a], there[arm]["action_mask"])
        np.testing.assert_array_equal(env.action_masks(), seen["action_mask"].reshape(-1) == 1)
        action = env.action_space.sample(mask=info["action_mask"])
        seen, reward, terminated, truncated, info = env.step(action)
        there, rewards, ends, cuts, infos = plain.step(dict(zip(plain.possible_agents, action.tolist(), strict=True)))
        assert (reward, terminated, truncated) == (rewards["arm_0"], ends["arm_0"], cuts["arm_0"])
        for key in infos["arm_0"]:
            np.testing.assert_array_equal(info[key], [infos[arm][key] for arm in plain.possible_agents])
        over = terminated or truncated
    assert (terminated, truncated) == (shift is BRIEF, shift is not BRIEF)


@pytest.mark.parametrize("action", [0, [0, 0], np.zeros((3, 1), int)], ids=str)
def test_an_action_of_another_shape_says_what_is_wanted(alone, action) -> None:
    env = alone()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="one integer for each of 3 arms"):
        env.step(action)


@pytest.mark.parametrize("shift", [{}, BRIEF], ids=["cut", "finished"])
def test_a_row_of_many_is_the_dispatcher_alone(many, alone, shift) -> None:
    vector, rows = many(4, **shift), [alone(**shift) for _ in range(4)]
    seen, info = vector.reset(seed=7)
    first = [env.reset(seed=7 + e)[0] for e, env in enumerate(rows)]
    ends = 0
    for _ in range(40):
        for key, values in seen.items():
            np.testing.assert_array_equal(values, [each[key] for each in first])
        np.testing.assert_array_equal(info["action_mask"], seen["action_mask"])
        assert vector.observation_space.contains(seen)
        actions = vector.legal_sample()
        assert vector.action_space.contains(actions)
        seen, reward, terminated, truncated, info = vector.step(actions)
        for e, env in enumerate(rows):
            first[e], own, finished, cut, _ = env.step(actions[e])
            assert reward[e] == pytest.approx(own, rel=1e-6)
            assert (terminated[e], truncated[e]) == (finished, cut)
            if finished or cut:
                for key, values in info["final_obs"].items():
                    np.testing.assert_array_equal(values[e], first[e][key])
                first[e] = env.reset()[0]
                ends += 1
        np.testing.assert_array_equal(info.get("_final_obs", np.zeros(4, bool)), terminated | truncated)
    assert ends >= 4
    assert info["illegal"].max() == 0


def test_what_it_cannot_take_is_refused(small_batch, small_workshop) -> None:
    with pytest.raises(ValueError, match=r"DispatcherEnv takes an environment made by thermofleet\.make_env\(\)"):
        DispatcherEnv(small_batch())
    with pytest.raises(ValueError, match=r"DispatcherVectorEnv takes a batch made by thermofleet\.make_batch\(\)"):
        DispatcherVectorEnv(small_workshop()())


def test_nothing_is_legal_before_a_reset(many) -> None:
    with pytest.raises(RuntimeError, match=r"Call reset\(\) before legal_sample\(\)"):
        many().legal_sample()


def test_gymnasium_counts_the_episodes(many) -> None:
    """The mode of resetting is believed by Gymnasium's own statistics."""
    vector = RecordEpisodeStatistics(many(4))
    assert vector.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    vector.reset(seed=0)
    total = np.zeros(4)
    for _ in range(TICKS):
        _, reward, _, truncated, info = vector.step(vector.unwrapped.legal_sample())
        total += reward
    assert truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total)
    np.testing.assert_array_equal(info["episode"]["l"], TICKS)
    assert set(info["final_info"]) < set(info)


def test_without_autoreset_a_mask_says_who_begins_anew(many) -> None:
    vector = many(3, autoreset=False, **BRIEF)
    assert vector.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    seen, _ = vector.reset(seed=0)
    over = np.zeros(3, bool)
    while not over.any():
        seen, _, terminated, truncated, info = vector.step(vector.legal_sample())
        over = terminated | truncated
    assert "final_obs" not in info
    assert not over.all()
    with pytest.raises(RuntimeError, match="call reset"):
        vector.step(vector.legal_sample())
    again, _ = vector.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(again["observation"][~over], seen["observation"][~over])
    left_s = vector.batch.layout.read(again["observation"], again["action_mask"]).left_s
    np.testing.assert_array_equal(left_s[over], 10.0 * BRIEF.get("ticks", TICKS))


def test_a_seed_repeats_also_the_drawn_answers_and_another_does_not(many) -> None:
    def shift(seed: int) -> np.ndarray:
        vector = many(3)
        vector.reset(seed=seed)
        return np.stack([vector.step(vector.legal_sample())[0]["observation"] for _ in range(20)])

    one, two, other = shift(0), shift(0), shift(1)
    assert (one == two).all()
    assert (one != other).any()


def test_every_legal_answer_is_drawn_as_often(many) -> None:
    vector = many(1)
    vector.reset(seed=0)
    mask = np.array([[1, 0, 1, 1, 0], [1] * 5, [1, 0, 0, 0, 0]], np.int8)
    vector._mask = mask[None]
    drawn = np.stack([vector.legal_sample()[0] for _ in range(4000)])
    counts = np.stack([np.bincount(drawn[:, arm], minlength=5) for arm in range(ARMS)])
    shares = mask / mask.sum(axis=1, keepdims=True)
    spread = np.sqrt(4000 * shares * (1 - shares))  # binomial
    assert (np.abs(counts - 4000 * shares) <= 4.0 * spread).all()


def test_the_example_of_the_page_runs(example) -> None:
    told = example("Gymnasium")
    assert told["observation"]["observation"].shape[:2] == (16, ARMS)
    assert (told["info"]["illegal"] == 0).all()
