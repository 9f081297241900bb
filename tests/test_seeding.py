"""Counter-based random numbers: moments, independence, and reproducibility."""

import numpy as np
import pytest
from scipy import stats

from fleet.seeding import LEVELS, child, exchange_seed, key_of, random_normal, random_uniform, random_word, shift_seeds

COUNTS = np.arange(600_000, dtype=np.uint64)


def key(seed: int) -> np.uint64:
    return np.uint64(key_of(np.random.SeedSequence(seed)))


def test_words_are_those_of_splitmix64() -> None:
    """Java's SplittableRandom and Vigna's splitmix64.c: outputs 1 to 5 for the seed 1234567."""
    expected = [
        6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821,
    ]  # fmt: skip
    assert random_word(np.uint64(1234567), np.arange(1, 6, dtype=np.uint64)).tolist() == expected


def test_uniform_values_are_uniform_and_independent() -> None:
    values = random_uniform(key(5), COUNTS)
    assert 0.0 <= values.min() <= values.max() < 1.0
    assert stats.kstest(values, "uniform").pvalue > 0.001
    assert np.abs(np.corrcoef(values.reshape(-1, 3).T) - np.eye(3)).max() < 0.01
    assert abs(np.corrcoef(values, random_uniform(key(6), COUNTS))[0, 1]) < 0.006


def test_normal_values_are_standard_normal_and_independent() -> None:
    values = random_normal(key(5), COUNTS)
    assert abs(values.mean()) < 4 / np.sqrt(len(values))
    assert values.var() == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(values)))
    assert stats.skew(values) == pytest.approx(0.0, abs=4 * np.sqrt(6 / len(values)))
    assert np.mean(np.abs(values) < 1.0) == pytest.approx(0.6827, abs=0.003)
    assert np.mean(np.abs(values) > 3.0) == pytest.approx(0.0027, abs=0.0004)
    assert np.abs(np.corrcoef(values.reshape(-1, 3).T) - np.eye(3)).max() < 0.01
    assert len(np.unique(values)) > 0.9 * len(values) > 100 * LEVELS


def test_a_value_depends_on_its_key_and_its_count_alone() -> None:
    every, other = random_normal(key(5), COUNTS), random_normal(key(6), COUNTS)
    assert random_normal(key(5), COUNTS[::-7]).tolist() == every[::-7].tolist()
    assert random_normal(key(5), COUNTS[[77, 0]]).tolist() == every[[77, 0]].tolist()
    assert np.mean(np.isclose(every, other)) < 0.001


def test_child_seeds_differ_and_leave_no_trace() -> None:
    seed = np.random.SeedSequence(9)
    jobs, sensors = shift_seeds(seed)
    keys = [key_of(each) for each in (seed, jobs, sensors, exchange_seed(sensors), child(seed, 0, 1))]
    assert len(set(keys)) == 5
    assert seed.n_children_spawned == 0
    assert key_of(exchange_seed(sensors)) == key_of(child(seed, 1, 0))
    assert [key_of(each) for each in shift_seeds(seed)] == [key_of(jobs), key_of(sensors)]
