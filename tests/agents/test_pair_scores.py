"""Learned scores of pairs of arm and job: they begin as `wsept`, and treat arms and jobs as sets."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.heat import Wsept
from agents.learned.evolution import Evolution, EvolutionConfig
from agents.pairs import PAIRS, PAIRS_CARD, PARAMETERS, PEAK_SD_K, PairPolicy, Worth, load_pairs, save_pairs, scores
from fleet.errors import CheckpointError
from fleet.observation import FIELDS, LONG_S, LazyObservation, Observation
from scenarios.policy_loader import policy_of, scope_of
from tests.agents.observations import drawn, of_arms

ROOT = Path(__file__).parents[2]


def batched(seen: Observation) -> Observation:
    """With an axis of one env."""
    return LazyObservation(lambda name: getattr(seen, name)[None])


def trained(rng: np.random.Generator) -> np.ndarray:
    return 0.1 * rng.standard_normal(PARAMETERS)


class WithoutDueDates(Wsept):
    """`wsept` with the deviation of peaks that learned parameters are relative to, and without due dates."""

    peak_sd_k = PEAK_SD_K
    margin_k = 0.0

    def index(self, seen: Observation) -> np.ndarray:
        worth = self.worth(seen)
        return np.where(worth > 0, worth / np.maximum(seen.duration_s, 1.0), -np.inf)


def test_before_any_training_it_is_wsept_without_due_dates() -> None:
    rng = np.random.default_rng(0)
    claims = 0
    for _ in range(30):
        observations = of_arms(drawn(rng))
        actions = PairPolicy(np.zeros(PARAMETERS)).act(observations)
        assert actions == WithoutDueDates().act(observations)
        claims += sum(action > 0 for action in actions.values())
    assert claims > 30


def test_scores_follow_arms_and_slots_in_any_order() -> None:
    rng = np.random.default_rng(6)
    seen, parameters = drawn(rng), trained(rng)[None]
    expected = scores(batched(seen), parameters)[0]
    assert np.isfinite(expected).sum() > 5
    arms, slots = rng.permutation(5), rng.permutation(6)
    options = (2 * slots[:, None] + np.arange(2)).ravel()
    order: dict[tuple[str, ...], np.ndarray] = {("slot",): slots, ("option",): options}
    moved = {
        field.name: getattr(seen, field.name)[arms][:, order[field.axes]]
        if field.axes in order
        else getattr(seen, field.name)[arms]
        for field in FIELDS
        if "member" not in field.axes
    }
    mask = seen.action_mask[arms][:, [0, *(1 + options), -1]]
    found = scores(batched(replace(seen, **moved, action_mask=mask)), parameters)[0]
    np.testing.assert_allclose(found, expected[arms][:, options], rtol=1e-9)


def test_envs_of_a_batch_do_not_affect_each_other() -> None:
    rng = np.random.default_rng(2)
    several = [drawn(rng) for _ in range(3)]
    parameters = np.stack([trained(rng) for _ in range(3)])
    together = LazyObservation(lambda name: np.stack([getattr(each, name) for each in several]))
    found = scores(together, parameters)
    for e, seen in enumerate(several):
        alone = scores(batched(seen), parameters[e : e + 1])
        np.testing.assert_allclose(found[e], alone[0], rtol=1e-9)


def test_a_learned_price_of_the_end_counts_for_jobs_that_end_after_the_shift() -> None:
    """With full price, half of the value of a job that ends just with the shift, and nothing of a later one."""
    seen = drawn(np.random.default_rng(3))
    seen = replace(seen, duration_s=np.full((5, 12), 300.0), peak_c=np.full((5, 12), 20.0))
    free, parameters = np.zeros((1, PARAMETERS)), np.zeros((1, PARAMETERS))
    parameters[0, Worth._fields.index("end")] = 1.0

    def share(left_s: float) -> np.ndarray:
        moment = batched(replace(seen, left_s=np.full(5, left_s)))
        worth, worth_free = (np.maximum(scores(moment, each), 0.0) for each in (parameters, free))
        return worth[worth_free > 0] / worth_free[worth_free > 0]

    for left_s, expected in ((LONG_S, 1.0), (300.0, 0.5), (0.0, 0.0)):
        np.testing.assert_allclose(share(left_s), expected, atol=1e-6)


def test_with_a_margin_hotter_peaks_are_worth_the_same() -> None:
    """Where the time above the warning limit costs nothing, only the distance of the peak to the error limit counts."""
    seen = drawn(np.random.default_rng(4))
    seen = replace(seen, peak_c=np.maximum(seen.peak_c, 50.0))
    parameters = np.zeros((1, PARAMETERS))
    parameters[0, Worth._fields.index("minute")] = -40.0
    expected = scores(batched(seen), parameters)
    parameters[0, Worth._fields.index("margin")] = 0.4
    np.testing.assert_allclose(scores(batched(replace(seen, peak_c=seen.peak_c + 4.0)), parameters), expected)
    assert (scores(batched(seen), parameters) != expected).any()


def test_a_folder_of_parameters_is_a_central_policy(tmp_path) -> None:
    parameters = trained(np.random.default_rng(4))
    save_pairs(parameters, tmp_path / "pairs", note="x")
    assert scope_of(str(tmp_path / "pairs")) == "central"
    observations = of_arms(drawn(np.random.default_rng(5)))
    expected = PairPolicy(parameters.astype(np.float32)).act(observations)
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


def test_the_shipped_weights_are_those_of_a_stored_training():
    shipped, stored = ROOT / "agents" / "weights", ROOT / "docs" / "results" / "learned"
    assert any(
        all((folder / name).read_bytes() == (shipped / name).read_bytes() for name in (PAIRS, PAIRS_CARD))
        for folder in stored.iterdir()
    )
