"""Learned prices and weights of pairs: they begin as `bid_price`, and treat arms and jobs as sets."""

from dataclasses import replace

import numpy as np
import pytest

from agents.learned.evolution import Evolution, EvolutionConfig
from agents.pairs import (
    PAIR_FEATURES,
    PAIRS,
    PAIRS_CARD,
    PARAMETERS,
    LearnedPrices,
    Prices,
    features_of,
    load_pairs,
    rates_of,
    save_pairs,
)
from agents.policy import on_arrays, without_empty
from agents.prices import BidPrice, Bids
from fleet.errors import CheckpointError
from fleet.observation import LazyObservation, Observation
from scenarios.policy_loader import policy_of, scope_of
from tests.agents.observations import NAMES, drawn, of_arms


def trained(rng: np.random.Generator) -> np.ndarray:
    return 0.1 * rng.standard_normal(PARAMETERS)


def changed(name: str, value: float) -> LearnedPrices:
    """The policy with one parameter other than 0."""
    parameters = np.zeros(PARAMETERS)
    parameters[Prices._fields.index(name)] = value
    return LearnedPrices(parameters)


def shift(rng: np.random.Generator) -> list[dict[str, Observation]]:
    """Random instants of a shift, 200 s apart."""
    return [of_arms(replace(drawn(rng), left_s=np.full(5, 5000.0 - 200.0 * k))) for k in range(6)]


def test_before_any_training_it_is_bid_price() -> None:
    rng, claims = np.random.default_rng(0), 0
    for _ in range(10):
        rule, learned = BidPrice(), LearnedPrices(np.zeros(PARAMETERS))
        for seen in shift(rng):
            actions = learned.act(seen)
            assert actions == rule.act(seen)
            claims += sum(action > 0 for action in actions.values())
    assert claims > 30


def test_claims_follow_arms_and_slots_in_any_order() -> None:
    rng, names, claims = np.random.default_rng(6), [f"arm{a}" for a in range(5)], 0
    parameters = trained(rng)
    for _ in range(10):
        policy, other = LearnedPrices(parameters), LearnedPrices(parameters)
        order = rng.permutation(5)
        for seen in shift(rng):
            expected = policy.act(seen)
            assert other.act({names[a]: seen[names[a]] for a in order}) == {names[a]: expected[names[a]] for a in order}
            claims += sum(action > 0 for action in expected.values())
    assert claims > 30


def test_envs_of_a_batch_do_not_affect_each_other_nor_their_parameters() -> None:
    rng = np.random.default_rng(2)
    shifts, parameters = [shift(rng) for _ in range(3)], [trained(rng) for _ in range(3)]
    together = on_arrays({e: LearnedPrices(each) for e, each in enumerate(parameters)}, tuple(shifts[0][0]))
    assert together is not None
    alone = [LearnedPrices(each) for each in parameters]
    for each in zip(*shifts, strict=True):
        names = (name for name in NAMES if name != "peers")
        stacked = {name: np.stack([[getattr(a, name) for a in seen.values()] for seen in each]) for name in names}
        found = together(np.arange(3), LazyObservation(stacked.__getitem__))
        assert found.tolist() == [list(policy.act(seen).values()) for policy, seen in zip(alone, each, strict=True)]


def test_a_learned_price_of_an_arms_time_is_a_multiple_of_the_rules() -> None:
    assert changed("time", np.log(2.0)).price_share == pytest.approx(2.0 * BidPrice.price_share)
    assert changed("most", np.log(0.5)).most_of_rate == pytest.approx(0.5 * BidPrice.most_of_rate)


def test_with_a_margin_hotter_peaks_are_worth_the_same() -> None:
    """Where the time above the warning limit costs nothing, only the distance of the peak to the error limit counts."""
    seen = drawn(np.random.default_rng(4))
    seen = replace(seen, peak_c=np.maximum(seen.peak_c, 50.0))

    def worths(seen: Observation, margin: float) -> np.ndarray:
        policy = changed("minute", -40.0)
        policy.parameters[Prices._fields.index("margin")] = margin
        return LearnedPrices.worths([policy], LazyObservation(lambda name: getattr(seen, name)[None]))

    expected = worths(seen, 0.0)
    np.testing.assert_allclose(worths(replace(seen, peak_c=seen.peak_c + 4.0), 0.4), expected)
    assert (worths(seen, 0.4) != expected).any()


def test_numbers_of_a_pair_are_bounded_and_those_of_its_job_and_arm() -> None:
    """Of one job for two arms, at 2 and 1 a minute: both can do it, and the second does it in twice the time."""
    one = drawn(np.random.default_rng(1))
    seen = without_empty(LazyObservation(lambda name: getattr(one, name)[None]))
    worth, duration_s = np.zeros((1, 5, 12)), np.full((1, 5, 12), 60.0)
    worth[0, :2, 0], duration_s[0, 1, 0] = 2.0, 120.0
    bids = Bids(worth, duration_s)
    rate, scale = rates_of(bids)
    numbers = features_of(seen, bids, np.zeros((1, 5, 12)), rate / scale)
    assert numbers.shape == (1, 5, 12, PAIR_FEATURES)
    assert np.abs(numbers).max() <= 4.0
    assert (numbers[0, 2:] == 0).all()
    # The logarithm of the time relative to the fastest arm; the advantage over the best and the mean of the others, in
    # units of the mean rate, 1.5 a minute; and the share of arms that can do it.
    np.testing.assert_allclose(numbers[0, :2, 0, 12], [0.0, np.log(2.0)])
    np.testing.assert_allclose(numbers[0, :2, 0, 13], np.array([1.0, -1.0]) / 1.5)
    np.testing.assert_allclose(numbers[0, :2, 0, 15], np.array([1.0, -1.0]) / 1.5)
    np.testing.assert_allclose(numbers[0, :2, 0, 16], 0.4)


def test_a_folder_of_parameters_is_a_central_policy(tmp_path) -> None:
    parameters = trained(np.random.default_rng(4))
    save_pairs(parameters, tmp_path / "pairs", note="x")
    assert scope_of(str(tmp_path / "pairs")) == "central"
    observations = of_arms(drawn(np.random.default_rng(5)))
    expected = LearnedPrices(parameters.astype(np.float32)).act(observations)
    assert policy_of(str(tmp_path / "pairs")).act(observations) == expected
    np.save(tmp_path / "pairs" / PAIRS, parameters[:-1])
    with pytest.raises(CheckpointError, match=f"must be {PARAMETERS} finite numbers"):
        load_pairs(tmp_path / "pairs")


def test_the_search_finds_a_known_optimum_and_goes_on_where_it_was(tmp_path) -> None:
    target = np.linspace(-1.0, 1.0, 10)
    search = Evolution(np.zeros(10), EvolutionConfig(samples=16, learning_rate=0.2, seed=7))

    def step(search: Evolution) -> None:
        samples = search.ask()
        np.testing.assert_allclose(samples[:8] + samples[8:], np.tile(2.0 * search.mean, (8, 1)))
        search.tell(-((samples - target) ** 2).sum(axis=1))

    for _ in range(60):
        step(search)
    search.save(tmp_path / "state.npz", best=3.0)
    again = Evolution(np.zeros(10), search.config)
    assert again.load(tmp_path / "state.npz") == {"best": 3.0}
    for each in (search, again):
        for _ in range(60):
            step(each)
    np.testing.assert_allclose(search.average, target, atol=0.1)
    np.testing.assert_array_equal(search.mean, again.mean)
    (tmp_path / "state.npz").write_bytes(b"rubbish")
    with pytest.raises(CheckpointError, match="cannot be resumed"):
        again.load(tmp_path / "state.npz")


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"PK\x03\x04 rubbish"),
        lambda path: np.save(path, np.zeros(PARAMETERS, complex)),
        lambda path: np.save(path, np.full(PARAMETERS, "x")),
        lambda path: np.save(path, np.full(PARAMETERS, np.nan, np.float32)),
        lambda path: np.save(path, np.full(PARAMETERS, 1e30, np.float32)),
        lambda path: path.with_name(PAIRS_CARD).write_text("[" * 100_000),
    ],
    ids=["empty", "zip", "complex", "text", "nan", "huge", "nested"],
)
def test_a_damaged_folder_is_refused_in_a_sentence(tmp_path, damage) -> None:
    save_pairs(np.zeros(PARAMETERS), tmp_path)
    damage(tmp_path / PAIRS)
    with pytest.raises(CheckpointError):
        load_pairs(tmp_path)
