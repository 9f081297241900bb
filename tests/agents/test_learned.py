"""The learned policy: what it must not depend on, that it learns, and that it is kept."""

import json
from dataclasses import replace
from itertools import islice
from math import exp

import numpy as np
import pytest
import torch
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from agents.learned.config import NetworkSize
from agents.learned.policy import (
    CARD,
    WEIGHTS,
    Actor,
    Critic,
    LearnedPolicy,
    draw,
    load_policy,
    masked,
    save_policy,
    sets_of,
)
from agents.learned.ppo import Chooser, PpoConfig, Trainer, advantages, imitate
from fleet.engine.batch import Shift
from fleet.env.adapters.torchrl import TorchRLEnv
from fleet.env.vector import BatchEnv, Library
from fleet.errors import CheckpointError
from fleet.observation import FIELDS, Layout, Observation
from fleet.seeding import key_of


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def random_observation(layout: Layout, rng: np.random.Generator, rows: int) -> np.ndarray:
    low, high = layout.bounds
    values = rng.uniform(np.maximum(low, -300.0), np.minimum(high, 300.0), (rows, layout.size))
    parts = layout.read(values, values[:, :0])
    for field in FIELDS:
        if field.unit == "1" and (field.low, field.high) == (0, 1):
            part = getattr(parts, field.name)
            part[...] = np.round(part)
    return values.astype(np.float32)


def reordered(layout: Layout, vectors: np.ndarray, slots: np.ndarray, members: np.ndarray) -> np.ndarray:
    """The same knowledge with slots and members in another order."""
    seen = layout.read(vectors.copy(), vectors[:, :0])
    named = {}
    for field in FIELDS:
        part = getattr(seen, field.name)
        for axis, order in (("slot", slots), ("option", slots), ("member", members)):
            if axis in field.axes and part.size:
                part = np.take(part, order, axis=1 + field.axes.index(axis))
        named[field.name] = part
    return layout.pack(Observation(**named, peers=seen.peers, action_mask=vectors[:, :0]))


@pytest.mark.parametrize(("arms", "slots"), [(1, 1), (2, 3), (4, 8), (9, 5)])
def test_logits_move_with_the_slots_and_do_not_know_the_order_of_members(arms, slots) -> None:
    rng, layout = np.random.default_rng(arms), Layout(arms, slots)
    torch.manual_seed(0)
    actor, critic = Actor().double(), Critic().double()
    vectors = random_observation(layout, rng, 6)
    slot_order, member_order = rng.permutation(slots), rng.permutation(arms)
    other = reordered(layout, vectors, slot_order, member_order)
    one, two = (actor(layout, torch.from_numpy(v).double()) for v in (vectors, other))
    torch.testing.assert_close(two[:, [0, -1]], one[:, [0, -1]])
    torch.testing.assert_close(two[:, 1:-1], one[:, 1:-1][:, slot_order.copy()])
    assert slots == 1 or one[:, 1:-1].std() > 0
    fleet = torch.from_numpy(vectors).double()[None]
    torch.testing.assert_close(critic(layout, fleet.flip(1)), critic(layout, fleet).flip(1))


def test_no_feature_is_wild() -> None:
    layout = Layout(4, 8)
    low, high = layout.bounds
    for vectors in (low, high, random_observation(layout, np.random.default_rng(0), 200)):
        for part in sets_of(layout, torch.from_numpy(np.atleast_2d(vectors))):
            assert torch.isfinite(part).all()


def test_what_is_illegal_has_no_probability() -> None:
    mask = torch.tensor([[1, 0, 1], [1, 0, 0]])
    chance = torch.softmax(masked(torch.tensor([[0.0, 9.0, 1.0], [0.0, 9.0, 1.0]]), mask), dim=-1)
    assert chance[:, 1].tolist() == [0.0, 0.0]
    assert chance[1].tolist() == [1.0, 0.0, 0.0]


def test_draws_are_those_of_the_softmax() -> None:
    logits = np.log([0.5, 0.3, 0.2, 1e-12])
    drawn = draw(np.broadcast_to(logits, (20_000, 4)), np.random.default_rng(0))
    np.testing.assert_allclose(np.bincount(drawn, minlength=4) / 20_000, [0.5, 0.3, 0.2, 0.0], atol=0.012)


def unequal(small) -> Library:
    """Two arms and more jobs than they can do: every fourth is worth ten of the others."""
    content = [small.work(place) for place in ("a", "b", "c", "d")]
    same = small.ByPayload(1.0)
    arms = [small.arm(i, content, times=small.Times(1.0, 25.0, 1.0), model=same) for i in range(2)]
    jobs = [
        small.job(f"j{i:02d}", content[i % 4], repetitions=1, release_s=10.0 * i, value=1.0 if i % 4 == 1 else 0.1)
        for i in range(40)
    ]
    world, _ = small.shop([jobs], arms=arms, ticks=30, slots=4)

    def draw(seed: np.random.SeedSequence) -> Shift:
        return replace(world.shifts[0], noise_key=key_of(seed))

    return Library(world.arms, world.slots, world.tables, draw)


def trainer(small, **changes) -> Trainer:
    library = unequal(small)

    def make_env(envs: int, seed: int) -> TorchRLEnv:
        return TorchRLEnv(BatchEnv(library, envs, seed=seed, autoreset=False, decisions=config.decisions))

    config = PpoConfig(**{"envs": 8, "steps": 30, "minibatch": 128, **changes})
    return Trainer([(make_env, BatchEnv(library, 1).layout)], config)


def test_advantages_of_unequal_steps_in_closed_form() -> None:
    """Three steps of 60, 3600 and 10 s; the second one ends an episode, the rollout is cut after the third."""
    elapsed_s = torch.tensor([60.0, 3600.0, 10.0], dtype=torch.float64)
    reward, value, after = (
        torch.tensor(v, dtype=torch.float64) for v in ([1.0, -2.0, 4.0], [3.0, 5.0, 7.0], [5.0, 9.0, 2.0])
    )
    done = torch.tensor([False, True, False])
    steps = [each[None, :, None] for each in (elapsed_s, reward, value, after, done)]
    advantage, target = (a[0, :, 0].tolist() for a in advantages(*steps, discount_s=7200.0, trace_s=600.0))
    last = 4.0 + exp(-10 / 7200) * 2.0 - 7.0
    second = -2.0 - 5.0  # no value after the end
    first = 1.0 + exp(-60 / 7200) * 5.0 - 3.0 + exp(-60 / 7200 - 60 / 600) * second
    assert advantage == pytest.approx([first, second, last], rel=1e-12)
    assert target == pytest.approx([first + 3.0, second + 5.0, last + 7.0], rel=1e-12)


def test_advantages_of_equal_steps_are_those_of_constant_discounts() -> None:
    torch.manual_seed(1)
    shape = (5, 40, 3)
    reward, value, after = (torch.randn(shape, dtype=torch.float64) for _ in range(3))
    done = (torch.rand(shape[:2]) < 0.1)[..., None].expand(shape)
    own = advantages(
        torch.full(shape, 10.0, dtype=torch.float64), reward, value, after, done, discount_s=1000.0, trace_s=500.0
    )
    plain = vec_generalized_advantage_estimate(exp(-0.01), exp(-0.02), value, after, reward, done, done)
    torch.testing.assert_close(own, plain)


def weights(of: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in of.actor.state_dict().items()}


@pytest.mark.parametrize("decisions", ["interval", pytest.param("events", marks=pytest.mark.slow)])
@pytest.mark.parametrize("algorithm", [pytest.param("mappo", marks=pytest.mark.slow), "ippo"])
def test_it_learns_what_is_worth_more(small, algorithm, decisions) -> None:
    learner = trainer(small, algorithm=algorithm, decisions=decisions, learning_rate=3e-3, seed=1)
    told = list(islice(learner.iterate(), 15))
    rewards = [each.reward for each in told]
    if decisions == "interval":
        assert {each.hours for each in told} == {8 * 30 * 10 / 3600}
    assert np.mean(rewards[-3:]) > 1.1 * np.mean(rewards[:3])


def test_the_same_seed_learns_the_same_and_another_does_not(small) -> None:
    runs = [trainer(small, seed=seed) for seed in (1, 1, 2)]
    for each in runs:
        list(islice(each.iterate(), 2))
    one, again, other = (weights(each) for each in runs)
    assert all(torch.equal(one[name], again[name]) for name in one)
    assert not all(torch.equal(one[name], other[name]) for name in one)


def test_a_training_goes_on_where_it_was(small, tmp_path) -> None:
    first = trainer(small)
    list(islice(first.iterate(), 2))
    later = trainer(small)
    first.save(tmp_path / "state", best=2.5)
    assert later.load(tmp_path / "state") == {"best": 2.5}
    assert later.done == 2
    assert all(torch.equal(weights(first)[name], value) for name, value in weights(later).items())
    assert next(later.iterate()).number == 3


def observations(layout: Layout, headroom_k: list[float], masks: list[list[int]]) -> dict[str, Observation]:
    vectors = random_observation(layout, np.random.default_rng(1), len(masks))
    layout.read(vectors, vectors[:, :0]).headroom_k[:] = headroom_k
    return {f"arm_{a}": layout.read(vectors[a], np.array(mask, np.int8)) for a, mask in enumerate(masks)}


def test_a_policy_is_kept_whole(tmp_path) -> None:
    torch.manual_seed(3)
    size, layout = NetworkSize(arm=8, option=8, pair=4), Layout(3, 5)
    actor = Actor(size)
    save_policy(actor, size, tmp_path / "p", scenario="x")
    seen = observations(layout, [9.0] * 3, [[1] * 6 + [0], [1] + [0] * 6, [1] * 6 + [0]])
    kept, fresh = load_policy(tmp_path / "p"), LearnedPolicy(actor)
    for policy in (kept, fresh):
        policy.reset(np.random.default_rng(0))
    assert [kept.act(seen) for _ in range(20)] == [fresh.act(seen) for _ in range(20)]
    assert kept.act(seen)["arm_1"] == 0
    before = kept._rng.bit_generator.state
    assert kept.act({"arm_1": seen["arm_1"]}) == {"arm_1": 0}
    assert kept._rng.bit_generator.state == before
    assert json.loads((tmp_path / "p" / CARD).read_text())["scenario"] == "x"
    assert len({path.stat().st_mode for path in (tmp_path / "p").iterdir()}) == 1  # who may read one may read all


def test_an_arm_gives_a_job_back_only_above_its_warning_limit() -> None:
    torch.manual_seed(0)
    actor, layout, back = Actor(), Layout(3, 2), 3
    actor.other[-1].load_state_dict(
        {"weight": torch.zeros(2, NetworkSize().option), "bias": torch.tensor([0.0, 50.0])}  # prefers to give back
    )
    at_work = [1, 0, 0, 1]
    seen = observations(layout, [-0.1, 0.1, -0.1], [at_work, at_work, [1, 0, 0, 0]])
    assert LearnedPolicy(actor).act(seen) == {"arm_0": back, "arm_1": 0, "arm_2": 0}
    vectors = np.stack([layout.pack(each) for each in seen.values()])
    mask = torch.from_numpy(np.stack([each.action_mask for each in seen.values()]))
    chance = torch.softmax(masked(Chooser(actor, layout)(torch.from_numpy(vectors), mask), mask), dim=-1)
    np.testing.assert_allclose(chance[:, back].detach(), [1.0, 0.0, 0.0], atol=1e-6)


def test_what_is_no_policy_is_said(tmp_path) -> None:
    with pytest.raises(CheckpointError, match="No trained policy in"):
        load_policy(tmp_path)
    size = NetworkSize(arm=8, option=8, pair=4)
    save_policy(Actor(size), size, tmp_path)
    (tmp_path / WEIGHTS).write_bytes(b"rubbish")
    with pytest.raises(CheckpointError, match=WEIGHTS):
        load_policy(tmp_path)
    save_policy(Actor(), size, tmp_path)
    with pytest.raises(CheckpointError, match="size mismatch"):
        load_policy(tmp_path)
    for wrong in (float("nan"), float("inf"), -1e30):
        actor = Actor()
        with torch.no_grad():
            next(actor.parameters()).flatten()[3] = wrong
        save_policy(actor, NetworkSize(), tmp_path)
        with pytest.raises(CheckpointError, match="not finite, or beyond"):
            load_policy(tmp_path)
    for text, reason in (
        ("{", "truncated"),
        ('{"format": 5, "size": {}}', "format 5 is not supported, only 6. Make it again"),
        ("[]", "Expected `object`"),
    ):
        (tmp_path / CARD).write_text(text)
        with pytest.raises(CheckpointError, match=reason):
            load_policy(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "dqn"}, "No algorithm 'dqn'. Allowed: ippo, mappo"),
        ({"envs": 0}, "envs must be 1 to 65536"),
        ({"learning_rate": 0.0}, "learning_rate must be > 0"),
        ({"discount_s": 0.5}, r"discount_s must be 1 to 10000000 \(got 0\.5\)"),
        ({"trace_s": float("nan")}, "trace_s must be 1 to"),
        ({"decisions": "event"}, "No kind of step 'event'; did you mean 'events'"),
    ],
)
def test_a_wrong_configuration_is_refused(changes, message) -> None:
    with pytest.raises(ValueError, match=message):
        PpoConfig(**changes)


def test_a_warm_start_learns_the_rule_it_is_shown() -> None:
    rng, layout = np.random.default_rng(0), Layout(3, 4)

    def shown(rows: int):
        vectors = random_observation(layout, rng, rows)
        mask = np.ones((rows, 6), np.int8)
        mask[:, -1] = 0
        mask[::7, 1:] = 0  # no choice: not to be learned from
        payload = layout.read(vectors, mask).payload_kg
        return vectors, mask, np.where(mask[:, 1], payload.argmax(axis=-1) + 1, 0)

    torch.manual_seed(0)
    actor = Actor()
    told = imitate(actor, layout, [shown(600) for _ in range(12)], np.random.default_rng(1))
    assert told[-1] < 0.5 * told[0]
    vectors, mask, actions = shown(400)
    with torch.inference_mode():
        best = masked(actor(layout, torch.from_numpy(vectors)), torch.from_numpy(mask)).argmax(dim=-1).numpy()
    assert (best == actions)[mask[:, 1] > 0].mean() > 0.8
