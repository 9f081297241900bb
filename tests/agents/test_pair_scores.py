"""Learned scores of pairs of arm and job: they begin as `wsept`, and treat arms and jobs as sets."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.heat import Wsept
from agents.learned.evolution import Evolution, EvolutionConfig
from agents.pairs import PAIRS, PAIRS_CARD, PARAMETERS, PairPolicy, Worth, load_pairs, save_pairs, scores
from fleet.errors import CheckpointError
from fleet.observation import FIELDS, LONG_S, Layout, LazyObservation, Observation
from scenarios.policy_loader import policy_of, scope_of

LAYOUT = Layout(5, 6, plans=2)
ROOT = Path(__file__).parents[2]


def drawn(rng: np.random.Generator) -> Observation:
    """What five arms might know: three free, one at work, one stopped; the jobs of all slots are offered."""
    blank = LAYOUT.read(np.zeros((5, LAYOUT.size), np.float32), np.zeros((5, LAYOUT.actions), np.int8))
    jobs = {
        "group": np.tile(np.arange(1.0, 7.0), (5, 1)),
        "due_in_s": np.tile(rng.uniform(-240.0, 1500.0, 6), (5, 1)),
        "value": np.tile(rng.uniform(0.5, 4.0, 6), (5, 1)),
        "age_s": np.tile(rng.uniform(0.0, 900.0, 6), (5, 1)),
        "payload_kg": np.tile(rng.uniform(0.0, 4.0, 6), (5, 1)),
        "expires": np.tile(rng.integers(2, size=6), (5, 1)),
    }
    options = {
        "duration_s": rng.uniform(60.0, 900.0, (5, 12)),
        "peak_c": rng.uniform(40.0, 80.0, (5, 12)) * (rng.random((5, 12)) < 0.8),
        "difficulty": rng.uniform(0.0, 1.0, (5, 12)),
        "p_saturation": rng.random((5, 12)),
    }
    temp_c = rng.uniform(30.0, 50.0, (5, 7))
    free, working = np.array([1, 1, 1, 0, 0]), np.array([0, 0, 0, 1, 0])
    mask = (rng.random((5, LAYOUT.actions)) < 0.8) & (free[:, None] > 0)
    mask[:, 0], mask[:, -1] = True, False
    arms = {
        "temp_c": temp_c,
        "headroom_k": 60.0 - temp_c.max(axis=1),
        "error_headroom_k": 67.0 - temp_c.max(axis=1),
        "working": working,
        "faulted": 1 - free - working,
        "busy_s": 60.0 * working,
        "left_s": np.full(5, rng.uniform(100.0, 5000.0)),
    }
    return replace(blank, **jobs, **options, **arms, action_mask=mask.astype(np.int8))


def of_arms(seen: Observation) -> dict[str, Observation]:
    """The observation of each arm."""
    names = [*(field.name for field in FIELDS), "peers", "action_mask"]
    return {f"arm{a}": Observation(**{name: getattr(seen, name)[a] for name in names}) for a in range(5)}


def batched(seen: Observation) -> Observation:
    """With an axis of one env."""
    return LazyObservation(lambda name: getattr(seen, name)[None])


def trained(rng: np.random.Generator) -> np.ndarray:
    return 0.1 * rng.standard_normal(PARAMETERS)


def test_before_any_training_it_is_wsept() -> None:
    rng = np.random.default_rng(0)
    claims = 0
    for _ in range(30):
        observations = of_arms(drawn(rng))
        actions = PairPolicy(np.zeros(PARAMETERS)).act(observations)
        assert actions == Wsept().act(observations)
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
