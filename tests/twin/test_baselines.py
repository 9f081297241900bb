"""Rivals against closed forms and second methods; the reading of time against the twin's own."""

import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
from sklearn.covariance import LedoitWolf
from sklearn.neighbors import NearestNeighbors

from fleet.difficulty import Difficulty, difficulty_of_error
from fleet.motion import Phase
from fleet.motor import gen3_motors
from fleet.thermal import WINDING, drive_heat, gen3_network, steady_state, thermal_model
from twin.baselines.detectors import (
    FEATURES,
    isolation_forest,
    mahalanobis,
    mahalanobis_distance,
    nearest_neighbours,
    neighbour_distance,
    window_statistics,
)
from twin.baselines.reconstruction import ModelScorer, collapsed_config, cool_windows, pca, untrained_config
from twin.baselines.torque import TorqueRms, continuous_torque, torque_over_continuous, torque_over_known
from twin.vae.config import TwinConfig
from twin.vae.train import train
from twin.vae.window import cut_jobs

SEED = np.random.SeedSequence(5)
CONFIG = TwinConfig(window=20, rate_hz=12.5, stride=10, score_stride=20, max_windows=200)


@pytest.fixture(scope="module")
def cool(records):
    return cool_windows(records[:12], CONFIG, SEED)


@pytest.fixture(scope="module")
def jobs(make_plan, motion):
    rng = np.random.default_rng(11)
    return [make_plan(*(motion(rng, s) for s in (2.0, 5.0 + i, 1.0))) for i in range(4)]


@pytest.fixture(scope="module")
def fitted(cool, records):
    return [
        pca(cool, 3),
        nearest_neighbours(cool),
        mahalanobis(cool),
        isolation_forest(cool, SEED),
        torque_over_known(records[:12]),
    ]


@pytest.fixture(scope="module")
def born(records, small):
    """A twin with random weights: what is told of its scores here holds for any."""
    return train(records[:20], untrained_config(small), SEED, arm="arm_0")


def test_the_reading_of_a_jobs_time_is_the_twins(born, jobs):
    reading = cut_jobs(jobs, [3, 1, 20, 7], born.config)
    z = born.scaler.to_z(reading.windows)
    error = np.abs(z - born.scaler.to_z(born.reconstruct(reading.windows)))
    np.testing.assert_allclose(reading.mean(error), born.features(jobs, [3, 1, 20, 7]).errors, atol=2e-5)


def test_shares_of_time_sum_to_one_per_job(jobs):
    reading = cut_jobs(jobs, [1, 2, 3, 4], CONFIG)
    np.testing.assert_allclose(reading.mean(np.ones((*reading.weight.shape, 2))), 1.0)


def test_pca_of_k_dimensions_leaves_nothing_of_a_k_dimensional_motion(make_plan):
    rng = np.random.default_rng(0)
    shapes = np.sin(np.arange(20)[:, None] * 0.2 * np.arange(1, 4)) / 5  # [time, component]

    def record(load):
        samples = (shapes @ rng.normal(size=(3, 3 * 7)) * load).reshape(20, 3, 7)
        samples[:, 0] *= 0.1  # far from half a turn: an angle that wraps would leave the subspace
        return np.repeat(samples, 4, axis=0)  # exactly as it is after averaging to 12.5 Hz

    # 3 channels of 3 shapes and the mean: 9 dimensions per joint, and one less is too few.
    cool = cool_windows([record(1.0) for _ in range(60)], CONFIG, SEED)
    plans = [make_plan(record(1.0), record(3.0), record(1.0)) for _ in range(3)]
    assert pca(cool, 9).scores(plans, [1, 2, 3]).per_joint.max() < 1e-5
    assert pca(cool, 8).scores(plans, [1, 2, 3]).per_joint.min() > 1e-3


def test_pca_is_the_singular_value_decomposition(cool, make_plan, motion):
    profile = motion(np.random.default_rng(8), 1.6)  # one window of 20 samples at 12.5 Hz, alone in its plan
    none = np.zeros((0, 3, 7), np.float32)
    plan = make_plan(none, profile, none)
    known_windows = cool.z[:, :, 1].astype(float).reshape(len(cool.z), -1)
    mean = known_windows.mean(axis=0)
    leading = np.linalg.svd(known_windows - mean)[2][:3]
    asked = cool.scaler.to_z(cut_jobs([plan], [1], CONFIG).windows)[0, :, 1].astype(float).ravel()
    error = np.abs(asked - mean - (asked - mean) @ leading.T @ leading).reshape(20, 3).sum(axis=1).mean()
    assert pca(cool, 3).scores([plan], [1]).per_joint[0, 1] == pytest.approx(1 - np.exp(-error), rel=1e-6)


def test_mahalanobis_is_the_closed_form():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(80, 4)) @ rng.normal(size=(4, 4))
    fit = LedoitWolf().fit(x)
    away = rng.normal(size=(5, 4)) - x.mean(axis=0)
    by_hand = [np.sqrt(a @ np.linalg.inv(fit.covariance_) @ a) for a in away]
    np.testing.assert_allclose(mahalanobis_distance(fit, away + x.mean(axis=0)), by_hand)


def test_neighbours_are_brute_force():
    rng = np.random.default_rng(2)
    x, asked = rng.normal(size=(50, 3)), rng.normal(size=(6, 3))
    all_distances = np.sort(np.linalg.norm(asked[:, None] - x, axis=-1), axis=1)
    np.testing.assert_allclose(
        neighbour_distance(NearestNeighbors(n_neighbors=4).fit(x), asked), all_distances[:, :4].mean(axis=1)
    )


def test_features_of_a_window_by_hand():
    window = np.zeros((1, 4, 2, 3))
    window[0, :, 1, 2] = [3.0, -1.0, 1.0, 1.0]
    found = dict(zip(FEATURES, window_statistics(window)[0, 1], strict=True))
    assert found["mean_tau"] == 1.0
    assert found["std_tau"] == pytest.approx(np.sqrt(2.0))
    assert found["rms_tau"] == pytest.approx(np.sqrt(3.0))
    assert (found["min_tau"], found["max_tau"]) == (-1.0, 3.0)
    assert found["step_tau"] == pytest.approx((4 + 2 + 0) / 3)
    assert len(FEATURES) == 18
    assert all(value == 0 for name, value in found.items() if not name.endswith("tau"))


def test_rms_torque_by_hand(make_plan):
    def at(seconds, torque):
        profile = np.zeros((round(50 * seconds), 3, 7), np.float32)
        profile[:, 2] = torque
        return profile

    plan = make_plan(at(1.0, 2.0), at(2.0, -4.0), at(1.0, 0.0))
    # 3 cycles: 1 s at 2, 6 s at 4, 1 s at 0.
    rms = np.sqrt((4.0 + 6 * 16.0) / 8)
    nominal = np.array([10.0, 5.0, 10, 10, 10, 10, 10])
    scores = TorqueRms("by hand", nominal).scores([plan], [3])
    np.testing.assert_allclose(scores.per_joint[0], rms / nominal)
    assert scores.total[0] == pytest.approx(rms / 5.0)


def test_the_continuous_torque_holds_the_limit():
    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    torque_nm = continuous_torque(motors, thermal, limit_c=60.0, ambient_c=25.0)
    for joint in range(7):
        current_sq = np.zeros(7)
        current_sq[joint] = (torque_nm[joint] / motors.eta[joint] / motors.torque_per_amp[joint]) ** 2
        temp_c = steady_state(thermal, current_sq, np.zeros(7), motors, 25.0)
        assert temp_c is not None
        assert temp_c[WINDING][joint] == pytest.approx(60.0, abs=1e-6)
        heat = drive_heat(temp_c, current_sq, np.zeros(7), motors)
        np.testing.assert_allclose(thermal.step(temp_c, heat, 25.0, 3600.0), temp_c, atol=1e-6)
    # A warmer room leaves less.
    assert np.all(continuous_torque(motors, thermal, limit_c=60.0, ambient_c=35.0) < torque_nm)
    assert np.all(torque_over_continuous(motors, thermal, limit_c=60.0, ambient_c=25.0).nominal_nm == torque_nm)
    with pytest.raises(ValueError, match="without any load"):
        continuous_torque(motors, thermal, limit_c=25.0, ambient_c=25.0)


def test_more_torque_raises_every_rival(fitted, jobs):
    def heavy(phase):
        profile = phase.profile.copy()
        profile[:, 2, 1] *= 3
        return Phase(profile, phase.payload_kg)

    loaded = [replace(p, **{n: heavy(getattr(p, n)) for n in ("approach", "cycle", "retreat")}) for p in jobs]
    for scorer in fitted:
        before, after = (scorer.scores(plans, [5] * 4) for plans in (jobs, loaded))
        assert np.all(after.per_joint[:, 1] > before.per_joint[:, 1]), scorer.name
        np.testing.assert_array_equal(np.delete(after.per_joint, 1, axis=1), np.delete(before.per_joint, 1, axis=1))


def test_scores_follow_their_jobs_and_repeat(fitted, jobs):
    order = [2, 0, 3, 1]
    for scorer in fitted:
        first = scorer.scores(jobs, [1, 2, 3, 4])
        moved = pickle.loads(pickle.dumps(scorer)).scores([jobs[i] for i in order], [i + 1 for i in order])
        np.testing.assert_allclose(first.per_joint[order], moved.per_joint, rtol=1e-6, err_msg=scorer.name)
        np.testing.assert_allclose(first.total[order], moved.total, rtol=1e-6)


def test_the_seed_alone_decides(records, make_plan, motion):
    elbow = [record[..., 3:4] for record in records[:12]]
    plan = make_plan(*(motion(np.random.default_rng(3), 3.0)[..., 3:4] for _ in range(3)))

    def scores(seed):
        learned = cool_windows(elbow, replace(CONFIG, max_windows=50), np.random.SeedSequence(seed))
        return isolation_forest(learned, np.random.SeedSequence(seed)).scores([plan], [1]).total

    np.testing.assert_array_equal(scores(1), scores(1))
    assert not np.array_equal(scores(1), scores(2))


def test_a_sum_over_joints_except_for_the_torque_rule(fitted, jobs):
    *by_window, torque = fitted
    for scorer in by_window:
        scores = scorer.scores(jobs, [2] * 4)
        np.testing.assert_allclose(scores.total, scores.per_joint.sum(axis=1))
    scores = torque.scores(jobs, [2] * 4)
    np.testing.assert_array_equal(scores.total, scores.per_joint.max(axis=1))


def test_the_mean_of_squares_collapses_the_latent_and_no_training_learns_nothing(records, small, born):
    shoulder = [record[..., 1:3] for record in records[:20]]
    dead = train(shoulder, collapsed_config(replace(small, epochs=15)), SEED, arm="arm_0")
    assert max(fit.kl for fit in dead.fits) < 0.05
    assert min(fit.mean_squared_error for fit in born.fits) > 0.9
    assert max(fit.mean_squared_error for fit in born.fits) < 1.2


@dataclass(frozen=True)
class Silent:
    version: str = "silent"

    def score(self, plan, repetitions):
        return Difficulty(np.full(7, 0.5)) if repetitions == 1 else None


def test_a_difficulty_model_scores_like_the_rest(born, jobs):
    scores = ModelScorer("VAE", born).scores(jobs, [1, 2, 3, 4])
    errors = born.features(jobs, [1, 2, 3, 4]).errors.sum(axis=-1)
    np.testing.assert_allclose(scores.per_joint, difficulty_of_error(errors))
    np.testing.assert_allclose(scores.total, scores.per_joint.sum(axis=1))
    worst = ModelScorer("VAE", born, worst=True).scores(jobs, [1, 2, 3, 4])
    np.testing.assert_array_equal(worst.total, scores.per_joint.max(axis=1))
    with pytest.raises(ValueError, match="'silent' has no score for job 2"):
        ModelScorer("silent", Silent()).scores(jobs, [1, 1, 2, 1])


def test_what_cannot_be_scored_says_so(fitted, cool, jobs, make_plan, motion, rng):
    nothing = make_plan(*(np.zeros((0, 3, 7), np.float32) for _ in range(3)))
    three = make_plan(*(motion(rng, 2.0)[..., :3] for _ in range(3)))
    for scorer in fitted:
        for plans, times, said in (
            ([], [], "no job"),
            (jobs[:1], [0], "at least one repetition"),
            (jobs[:2], [1], "2 plans, 1 repetitions"),
            ([nothing], [1], "no motion"),
            ([three], [1], "7 joints, a plan has 3"),
        ):
            with pytest.raises(ValueError, match=said):
                scorer.scores(plans, times)
    with pytest.raises(ValueError, match="needs 1 to 60 components"):
        pca(cool, 61)
    with pytest.raises(ValueError, match="as many training windows"):
        nearest_neighbours(cool, 10_000)
    with pytest.raises(ValueError, match="at least one record"):
        torque_over_known([])
    with pytest.raises(ValueError, match="torque > 0"):
        TorqueRms("broken", np.zeros(7))
    with pytest.raises(ValueError, match="Windows must be"):
        window_statistics(np.zeros((1, 1, 7, 3)))
