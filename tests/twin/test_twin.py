import gc
import pickle
from dataclasses import replace

import numpy as np
import pytest

from fleet.difficulty import DifficultyModel
from fleet.motion import Phase
from twin.vae.config import TwinConfig
from twin.vae.measures import PARTS, Calibration, Features
from twin.vae.twin import Twin
from twin.vae.window import cut, resample

NOTHING = Phase(np.zeros((0, 3, 7), np.float32), np.zeros(0, np.float32))


def job_errors(twin, plan, repetitions=1):
    return twin.features([plan], [repetitions]).errors[0]


def phase_errors(twin, plan):
    """Errors of each phase as a job of its own, [phase, joint, channel]."""
    alone = [replace(plan, approach=NOTHING, cycle=phase, retreat=NOTHING) for phase in plan.phases]
    return twin.features(alone, [1, 1, 1]).errors


def test_the_twin_is_a_difficulty_model(twin, plan):
    model: DifficultyModel = twin
    difficulty = model.score(plan, 10)
    assert difficulty is not None
    assert difficulty.per_joint.shape == (7,)
    assert 0 <= difficulty.total < 7
    assert np.all(difficulty.per_joint >= 0)


def test_a_score_repeats_even_in_another_batch_or_process(twin, plan, make_plan, motion, rng):
    others = [make_plan(*(motion(rng, s) for s in (2.0, 6.0, 2.0))) for _ in range(9)]
    first = twin.score(plan, 3).per_joint
    fresh = pickle.loads(pickle.dumps(twin))
    fresh.features([*others, plan], [1] * 10)
    np.testing.assert_array_equal(first, twin.score(plan, 3).per_joint)
    np.testing.assert_allclose(first, fresh.score(plan, 3).per_joint, rtol=1e-6)


@pytest.mark.parametrize("joint", [1, 3, 5])
def test_more_torque_than_known_raises_the_score_of_that_joint_alone(twin, plan, joint):
    def heavier(phase: Phase) -> Phase:
        profile = phase.profile.copy()
        profile[:, 2, joint] *= 3
        return Phase(profile, phase.payload_kg)

    known = twin.score(plan, 10).per_joint
    loaded_plan = replace(plan, **{name: heavier(getattr(plan, name)) for name in ("approach", "cycle", "retreat")})
    rise = twin.score(loaded_plan, 10).per_joint - known
    assert rise[joint] > 0.05
    assert np.all(np.abs(np.delete(rise, joint)) < 1e-6)
    loaded_shares, known_shares = (twin.measure(each, 10).shares for each in (loaded_plan, plan))
    assert loaded_shares[joint, 2] > known_shares[joint, 2]


def test_errors_far_beyond_training_stay_below_one(twin, plan):
    far = replace(plan, cycle=Phase(plan.cycle.profile * 1000, plan.cycle.payload_kg))
    d = twin.score(far, 10).per_joint
    assert np.all(d < 1)
    assert d.sum() < 7


def test_many_repetitions_approach_the_cycle_alone(twin, plan):
    cycle = phase_errors(twin, plan)[1]
    gaps = [np.abs(job_errors(twin, plan, n) - cycle).max() for n in (1, 10, 100, 10_000)]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[-1] < 1e-3


def test_the_job_error_is_the_mean_over_its_time(twin, plan):
    per_phase = phase_errors(twin, plan)
    times = np.array([3.0, 4 * 10.0, 2.5])
    want = (times[:, None, None] * per_phase).sum(0) / times.sum()
    np.testing.assert_allclose(job_errors(twin, plan, 4), want)


def test_the_phase_error_is_the_plain_mean_of_the_reconstruction_error(twin, make_plan, motion, rng):
    whole_windows_s = 8 * twin.config.window / 12.5
    plan = make_plan(motion(rng, 4.0), motion(rng, whole_windows_s), motion(rng, 4.0))
    windows = cut(resample(plan.cycle.profile, 50.0, 12.5), twin.config.window, twin.config.window)
    away = np.abs(windows - twin.reconstruct(windows)) / twin.scaler.std
    np.testing.assert_allclose(phase_errors(twin, plan)[1], away.mean(axis=(0, 1)), rtol=1e-4)


def test_shares_sum_to_one(twin, plan):
    shares = twin.measure(plan, 2).shares
    assert shares.shape == (7, 3)
    assert np.all(shares >= 0)
    assert shares.sum() == pytest.approx(1.0)


def test_an_empty_phase_weighs_nothing(twin, plan):
    still = replace(plan, approach=NOTHING, retreat=NOTHING)
    np.testing.assert_allclose(job_errors(twin, still, 1), job_errors(twin, still, 9), rtol=1e-12)
    with pytest.raises(ValueError, match="no motion"):
        twin.score(replace(still, cycle=NOTHING), 1)


def test_plans_are_remembered_only_while_they_live(twin, make_plan, motion, rng):
    fresh = pickle.loads(pickle.dumps(twin))
    plan = make_plan(*(motion(rng, 2.0) for _ in range(3)))
    fresh.score(plan, 1)
    assert len(fresh._scored) == 1
    del plan
    gc.collect()
    assert len(fresh._scored) == 0


def test_plans_in_one_call_keep_their_order(twin, make_plan, motion, rng):
    plans = [make_plan(*(motion(rng, s) for s in (1.0, 5.0, 1.5))) for _ in range(4)]
    together = twin.features([*plans, plans[0]], [1] * 5).errors
    fresh = pickle.loads(pickle.dumps(twin))
    alone = np.stack([job_errors(fresh, plan) for plan in [*plans, plans[0]]])
    assert together.shape == (5, 7, 3)
    np.testing.assert_allclose(together, alone, rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_plan_that_is_not_finite_is_refused(twin, plan, value):
    plan.cycle.profile[3, 1, 2] = value
    with pytest.raises(ValueError, match="Cycle of arm 'arm' is not finite: qd of joint 3 at sample 3"):
        twin.score(plan, 1)


def test_a_job_without_repetitions_is_refused(twin, plan):
    with pytest.raises(ValueError, match="at least one repetition"):
        twin.score(plan, 0)


def test_a_plan_of_another_arm_is_refused(twin, plan):
    short = replace(plan, cycle=Phase(plan.cycle.profile[:, :, :6], plan.cycle.payload_kg))
    with pytest.raises(ValueError, match="has 7 joints, Cycle of arm 'arm' 6"):
        twin.score(short, 1)


def test_known_motion_fills_the_latent_like_the_prior(twin, records):
    windows = np.concatenate(
        [cut(resample(record, 50.0, 12.5), twin.config.window, twin.config.window) for record in records]
    )
    z = twin.posterior(windows)[0]
    assert z.shape == (len(windows), 7, 2)
    active = z.var(axis=0) > 0.01
    assert active.any(axis=1).all()
    assert np.abs(z.mean(axis=0)).max() < 0.6
    assert z.std(axis=0).max() < 1.5


@pytest.mark.parametrize("bad", [np.zeros((2, 9, 7, 3)), np.full((2, TwinConfig().window, 7, 3), np.nan)])
def test_windows_that_do_not_fit_are_refused(twin, bad):
    with pytest.raises(ValueError, match="Windows must be"):
        twin.posterior(bad)[0]


def test_many_jobs_score_as_each_alone(twin, make_plan, motion, rng):
    plans = [make_plan(*(motion(rng, s) for s in (1.0, 5.0, 1.5))) for _ in range(3)]
    together = twin.features(plans, [1, 5, 9]).errors
    for plan, n, errors in zip(plans, [1, 5, 9], together, strict=True):
        np.testing.assert_array_equal(errors, job_errors(twin, plan, n))
    assert twin.features([], []).errors.shape == (0, 7, 3)


def test_window_errors_are_the_mean_distance_to_the_reconstruction(twin, plan):
    windows = cut(resample(plan.cycle.profile, 50.0, 12.5), twin.config.window, 6)
    away = np.abs(windows - twin.reconstruct(windows)) / twin.scaler.std
    np.testing.assert_allclose(twin.window_features(windows).errors, away.mean(axis=1), rtol=1e-4)


def test_decoding_the_posterior_mean_is_the_reconstruction(twin, plan):
    windows = cut(resample(plan.cycle.profile, 50.0, 12.5), twin.config.window, 6)
    mu, sigma = twin.posterior(windows)
    assert mu.shape == sigma.shape == (len(windows), 7, 2)
    assert np.all((sigma > 0) & (sigma < 1.5))
    np.testing.assert_allclose(twin.decode(mu), twin.reconstruct(windows), rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match=r"Latents must be \[batch, 7, 2\]"):
        twin.decode(mu[:, :, :1])


def test_every_plan_needs_its_repetitions(twin, plan):
    with pytest.raises(ValueError, match="Each job needs its repetitions: 1 plans, 2 repetitions"):
        twin.features([plan], [1, 2])


def test_a_twin_needs_its_networks(twin):
    with pytest.raises(ValueError, match=r"scope 'arm' for 7 joints needs 1 network"):
        Twin(
            replace(twin.config, scope="arm"),
            twin.scaler,
            twin.nets,
            arm="a",
            data_hash="",
            seed="0",
            fits=twin.fits,
        )


def test_a_calibration_of_another_arm_is_refused(twin):
    with pytest.raises(ValueError, match="calibration is for 6 joints, the twin has 7"):
        replace(twin, calibration=Calibration(Features(np.zeros((4, 6, PARTS))), np.zeros(4, int)))
