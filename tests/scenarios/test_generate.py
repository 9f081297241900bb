"""What is handed out, against limits and heat by other ways; what is not, against reasons made on purpose."""

from dataclasses import replace

import numpy as np
import pytest

import scenarios.motion.generate as module
from fleet.heat.thermal import NODES, WINDING
from fleet.job import Place, Work
from fleet.motion import RATE_HZ, Phase
from fleet.robot import GEN3
from scenarios.motion.generate import GenerationError, Verification, generate, perform
from twin.vae.generate import vary


@pytest.fixture(scope="module")
def asked(subject):
    return Verification.nominal(subject.arm.robot, 23.0)


@pytest.fixture(scope="module")
def made(subject, asked):
    return generate(subject.twin, subject.arm, subject.jobs, s=1.0, count=6, seed=1, verification=asked)


def test_everything_handed_out_is_cool_and_executable(subject, made, asked):
    assert len(made.motions) == 6
    assert made.draws == 6 + sum(made.rejected.values())
    for motion in made.motions:
        assert motion.predicted_c.max() <= asked.cool_c - asked.margin_k
        assert motion.error_rad < asked.tracking_rad
        whole = np.concatenate([phase.profile for phase in motion.plan.phases]).astype(float)
        q, qd, tau = whole.transpose(1, 0, 2)
        np.testing.assert_allclose(q[[0, -1]], np.tile(subject.arm.robot.home_q(), (2, 1)), atol=1e-3)
        assert np.abs(qd).max(axis=0) == pytest.approx(np.abs(np.diff(q, axis=0) * RATE_HZ).max(axis=0), rel=0.05)
        assert np.all(np.abs(qd) <= np.array(GEN3.velocity) * 1.0001)
        assert np.all(np.abs(np.diff(qd, axis=0)) * RATE_HZ <= np.array(GEN3.acceleration) * 1.01)
        assert np.all(np.abs(tau) < np.array(GEN3.torque_clip))
        assert motion.source in subject.jobs
        assert motion.plan.cycle.payload_kg.max() == motion.source.cycle.payload_kg.max()


@pytest.mark.slow
def test_half_an_hour_in_mujoco_is_as_warm_as_said(subject, made):
    """Second method: every cycle performed, instead of one measured and its heat repeated."""
    motion = made.motions[0]
    cycle = motion.plan.cycle
    times = int(1800 / cycle.duration_s)
    long = replace(motion.plan, cycle=Phase(np.tile(cycle.profile, (times, 1, 1)), np.tile(cycle.payload_kg, times)))
    done = perform(subject.arm, long, start_c=np.full(NODES, 23.0), ambient_c=23.0, tick_s=10.0)
    np.testing.assert_allclose(done.temp_c.max(axis=0), motion.peak_c, atol=0.3)
    assert motion.peak_c.max() > 25.0


@pytest.mark.slow
def test_nearly_all_stay_below_forty_degrees_by_the_true_motors(subject, asked):
    motions = [
        motion
        for seed in range(3)
        for motion in generate(
            subject.twin, subject.arm, subject.jobs, s=1.0, count=20, seed=seed, verification=asked
        ).motions
    ]
    assert len(motions) == 60
    assert np.mean([motion.peak_c.max() < 40.0 for motion in motions]) >= 0.95


def test_the_seed_repeats_and_more_begin_with_the_same(subject, asked, made):
    fewer = generate(subject.twin, subject.arm, subject.jobs, s=1.0, count=2, seed=1, verification=asked)
    for one, other in zip(fewer.motions, made.motions, strict=False):
        np.testing.assert_array_equal(one.plan.cycle.profile, other.plan.cycle.profile)
    elsewhere = generate(subject.twin, subject.arm, subject.jobs, s=1.0, count=1, seed=2, verification=asked)
    assert elsewhere.motions[0].distance_rad != made.motions[0].distance_rad


@pytest.mark.parametrize(
    ("changes", "reason"), [({"cool_c": 24.5}, "heat"), ({"tracking_rad": 1e-9, "cool_c": 90.0}, "tracking")]
)
def test_what_fails_is_rejected_with_its_reason(subject, asked, changes, reason):
    strict = replace(asked, **changes)
    with pytest.raises(GenerationError, match=rf"None of 20 motions of arm 'arm' passed \({reason} 20\)"):
        generate(subject.twin, subject.arm, subject.jobs, count=1, verification=strict)


@pytest.mark.parametrize(("joint", "offset", "reason"), [(3, 6.0, "joint limit"), (1, 2.0, "collision")])
def test_motion_beyond_a_stop_or_through_the_floor_is_rejected(subject, asked, monkeypatch, joint, offset, reason):
    def astray(*args):
        good = vary(*args)
        cycle = replace(good.phases[1], q=good.phases[1].q.copy())
        cycle.q[:, joint] += offset - (cycle.q[:, joint].max() if reason == "collision" else 0.0)
        return replace(good, phases=(good.phases[0], cycle, good.phases[2]))

    monkeypatch.setattr(module, "vary", astray)
    with pytest.raises(GenerationError, match=rf"passed \({reason} 20\)"):
        generate(subject.twin, subject.arm, subject.jobs[:1], count=1, verification=asked)


def test_predicted_heat_is_that_of_the_nominal_law_and_the_peak_that_of_the_arm(subject, asked, made):
    own = replace(asked, motors=subject.arm.motors, thermal=subject.arm.thermal)
    again = generate(subject.twin, subject.arm, subject.jobs, s=1.0, count=1, seed=1, verification=own)
    np.testing.assert_allclose(again.motions[0].predicted_c, again.motions[0].peak_c)
    assert not np.allclose(made.motions[0].predicted_c, made.motions[0].peak_c, atol=0.01)
    assert np.all(made.motions[0].peak_c[WINDING] > 23.0)


def test_nonsense_is_refused(subject, asked):
    with pytest.raises(ValueError, match=r"s must be a number >= 0"):
        generate(subject.twin, subject.arm, subject.jobs, s=-1.0, verification=asked)
    with pytest.raises(ValueError, match=r"must be >= 1 \(got 0\)"):
        generate(subject.twin, subject.arm, subject.jobs, count=0, verification=asked)
    with pytest.raises(ValueError, match=r"needs a source motion, not a press, for arm 'arm'"):
        generate(subject.twin, subject.arm, [], verification=asked)
    press = Work(kind="press", places=(Place(name="seal", position_m=(0.4, 0.0, 0.2)),), force_n=20.0)
    with pytest.raises(ValueError, match=r"not a press"):
        generate(subject.twin, subject.arm, [replace(subject.jobs[0], work=press)], verification=asked)
