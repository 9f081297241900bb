"""Simpler scores against closed forms and second methods; the reading of time against the twin's own."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper.quality import collapsed_config
from fleet.motion import Phase
from twin.baselines import TorqueRms, torque_over_known, untrained_config
from twin.vae.config import TwinConfig
from twin.vae.train import train
from twin.vae.window import cut_jobs

SEED = np.random.SeedSequence(5)
CONFIG = TwinConfig(window=20, rate_hz=12.5, stride=10, score_stride=20, max_windows=200)


@pytest.fixture(scope="module")
def jobs(make_plan, motion):
    rng = np.random.default_rng(11)
    return [make_plan(*(motion(rng, s) for s in (2.0, 5.0 + i, 1.0))) for i in range(4)]


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


def test_more_torque_raises_the_score_of_its_joint_alone(records, jobs):
    def heavy(phase):
        profile = phase.profile.copy()
        profile[:, 2, 1] *= 3
        return Phase(profile, phase.payload_kg)

    scorer = torque_over_known(records[:12])
    loaded = [replace(p, **{n: heavy(getattr(p, n)) for n in ("approach", "cycle", "retreat")}) for p in jobs]
    before, after = (scorer.scores(plans, [5] * 4) for plans in (jobs, loaded))
    assert np.all(after.per_joint[:, 1] > before.per_joint[:, 1])
    np.testing.assert_array_equal(np.delete(after.per_joint, 1, axis=1), np.delete(before.per_joint, 1, axis=1))
    np.testing.assert_array_equal(after.total, after.per_joint.max(axis=1))


def test_scores_follow_their_jobs_and_repeat(records, jobs):
    order, scorer = [2, 0, 3, 1], torque_over_known(records[:12])
    first = scorer.scores(jobs, [1, 2, 3, 4])
    moved = pickle.loads(pickle.dumps(scorer)).scores([jobs[i] for i in order], [i + 1 for i in order])
    np.testing.assert_allclose(first.per_joint[order], moved.per_joint, rtol=1e-6)
    np.testing.assert_allclose(first.total[order], moved.total, rtol=1e-6)


def test_the_mean_of_squares_collapses_the_latent_and_no_training_learns_nothing(records, small, born):
    shoulder = [record[..., 1:3] for record in records[:20]]
    dead = train(shoulder, collapsed_config(replace(small, epochs=15)), SEED, arm="arm_0")
    assert max(fit.kl for fit in dead.fits) < 0.05
    assert min(fit.mean_squared_error for fit in born.fits) > 0.9
    assert max(fit.mean_squared_error for fit in born.fits) < 1.2


def test_what_cannot_be_scored_says_so(records, jobs, make_plan, motion, rng):
    nothing = make_plan(*(np.zeros((0, 3, 7), np.float32) for _ in range(3)))
    three = make_plan(*(motion(rng, 2.0)[..., :3] for _ in range(3)))
    scorer = torque_over_known(records[:12])
    for plans, times, said in (
        ([], [], "no job"),
        (jobs[:1], [0], "at least one repetition"),
        (jobs[:2], [1], "2 plans, 1 repetitions"),
        ([nothing], [1], "no motion"),
        ([three], [1], "7 joints, a plan has 3"),
    ):
        with pytest.raises(ValueError, match=said):
            scorer.scores(plans, times)
    with pytest.raises(ValueError, match="at least one record"):
        torque_over_known([])
    with pytest.raises(ValueError, match="torque > 0"):
        TorqueRms("broken", np.zeros(7))
