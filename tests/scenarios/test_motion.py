"""Generated motion and files of motion, against limits and heat by other ways."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

import scenarios.motion.generate as generation
from fleet.arm.model import ArmModel
from fleet.arm.random_motions import plan_motion, random_jobs
from fleet.errors import FleetError
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, gen3_network, thermal_model
from fleet.job import Place, Work
from fleet.motion import RATE_HZ, Phase
from fleet.robot import GEN3, Robot
from scenarios.motion.generate import GenerationError, bare_arm, generate, perform
from scenarios.motion.recover import Candidate, Nearby, Recovery, Search, save_generated, save_recovery
from scenarios.prepare.twins import cold_peaks
from twin.logs.reader import read
from twin.vae.generate import vary


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

    monkeypatch.setattr(generation, "vary", astray)
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


@pytest.fixture
def found(subject, asked):
    time_s, warm_c = np.arange(0.0, 6.0, 2.0), np.append([50.0, 51.0], np.full(5, 50.0))
    warm = np.linspace(50.0, 53.0, 3)[:, None] + np.zeros(7)
    model = ArmModel(subject.arm.robot)
    return Recovery(
        search=Search(subject.twin, model, asked, Nearby(), np.zeros(7), 3.0, warm_c, warm_c, hold_s=600.0),
        found=Candidate(np.full(7, 0.1), "latent", tool_m=0.2, error=1.0),
        passed_over={"collision": 3},
        best_error={"latent": 1.0},
        time_s=time_s,
        without_c=warm,
        with_c=warm[::-1] - 3.0,
        error_rad=1e-4,
    )


def test_motion_is_read_back_with_its_units(made, tmp_path):
    save_generated(made, tmp_path / "out")
    card = json.loads((tmp_path / "out" / "generated.json").read_text(encoding="utf-8"))
    assert card["handed_out"] == len(card["motions"]) == 6
    assert card["rejected"] == made.rejected
    for entry, motion in zip(card["motions"], made.motions, strict=True):
        table = pq.read_table(tmp_path / "out" / entry["file"])
        whole = np.concatenate([phase.profile for phase in motion.plan.phases])
        (recording,) = read(tmp_path / "out" / entry["file"], measured=False)  # a log, as `twin score` reads it
        assert recording.name.endswith(f"/{made.arm}")
        for channel, name in enumerate(("q", "qd", "tau")):
            columns = np.stack([table[f"{name}_{j + 1}"].to_numpy() for j in range(7)], axis=1)
            np.testing.assert_allclose(columns, whole[:, channel], rtol=1e-6)
        np.testing.assert_allclose(np.diff(table["time_s"].to_numpy()), 1 / RATE_HZ)
        phases = table["phase"].to_pylist()
        assert phases.count("cycle") == len(motion.plan.cycle.profile)
        assert entry["distance_rad"] == motion.distance_rad


def test_a_recovery_is_read_back(found, tmp_path):
    save_recovery(found, tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "recovery.parquet")
    np.testing.assert_array_equal(table["time_s"], [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(table["with_2_c"], [50.0, 48.5, 47.0])
    np.testing.assert_array_equal(table["without_7_c"], [50.0, 51.5, 53.0])
    card = json.loads((tmp_path / "out" / "recovery.json").read_text(encoding="utf-8"))
    assert card["hottest_joint"] == 2
    assert card["cooled_k"] == 3.0
    assert card["spared_k"] == 6.0


def test_only_its_like_is_replaced_and_only_when_asked(found, made, tmp_path):
    save_recovery(found, tmp_path / "out")
    with pytest.raises(FleetError, match="holds a finished recovery"):
        save_recovery(found, tmp_path / "out")
    with pytest.raises(FleetError, match="holds other files"):
        save_generated(made, tmp_path / "out", overwrite=True)
    save_recovery(found, tmp_path / "out", overwrite=True)


ROBOT = Robot(name="arm", tool_kg=0.9)
ARM = bare_arm(ROBOT, gen3_motors(), thermal_model(gen3_network()))
MODEL = ArmModel(ROBOT)
STIFFNESS = np.array([2000.0] * 4 + [500.0] * 3)
"""Of the servos, N·m/rad (fleet/arm/assets/gen3.xml)."""

COLD_C = np.full(NODES, 23.0)
REACHING = np.array([0.3, 0.8, np.pi, -1.2, 0.0, 0.9, 1.57])


def hold(seconds=8.0, payload_kg=0.0):
    return plan_motion(MODEL, REACHING[None], dwell_s=seconds, payload_kg=payload_kg, speed=0.6)


def test_what_is_measured_is_what_was_planned():
    plan = random_jobs(ROBOT, 1, np.random.default_rng(4))[0]
    done = perform(ARM, plan, start_c=COLD_C, ambient_c=23.0)
    assert done.error_rad < 1e-3
    assert not done.clipped
    measured = done.as_plan()
    for phase, planned in zip(measured.phases, plan.phases, strict=True):
        np.testing.assert_allclose(phase.profile[:, 0], planned.profile[:, 0], atol=1e-3)
        np.testing.assert_array_equal(phase.payload_kg, planned.payload_kg)


def test_an_arm_sags_by_the_torque_it_does_not_know_of_over_its_stiffness():
    plan = hold()
    hidden_kg = 0.4
    loaded = replace(plan, cycle=Phase(plan.cycle.profile, np.full_like(plan.cycle.payload_kg, hidden_kg)))
    done = perform(ARM, loaded, start_c=COLD_C, ambient_c=23.0)
    settled = round((plan.approach.duration_s + 6.0) * RATE_HZ)
    sag = done.profile[settled, 0] - done.planned[settled, 0]
    missing = MODEL.gravity_torque(REACHING, hidden_kg) - MODEL.gravity_torque(REACHING)
    np.testing.assert_allclose(sag, -missing / STIFFNESS, atol=2e-4)
    assert done.error_rad > 1e-3


def test_more_than_a_servo_has_is_seen():
    plan = hold()
    crushed = replace(plan, cycle=Phase(plan.cycle.profile, np.full_like(plan.cycle.payload_kg, 40.0)))
    assert perform(ARM, crushed, start_c=COLD_C, ambient_c=23.0).clipped


def test_motors_heat_as_the_law_says_of_the_planned_torque():
    plan = hold(120.0, payload_kg=3.0)
    done = perform(ARM, plan, start_c=COLD_C, ambient_c=23.0, tick_s=2.0)
    np.testing.assert_array_equal(done.temp_c[0], COLD_C[:7])
    np.testing.assert_allclose(np.diff(done.time_s), 2.0)
    arrived = round(plan.approach.duration_s / 2.0)
    (held,) = cold_peaks([plan], ARM.motors, ARM.thermal, ambient_c=23.0, horizon_s=120.0)
    np.testing.assert_allclose(done.temp_c[arrived + 60], held, atol=0.4)
    assert held[1] - 23.0 > 10.0


def test_no_limit_stops_an_arm_that_is_watched():
    hot_c = np.full(NODES, 90.0)
    done = perform(ARM, hold(3.0), start_c=hot_c, ambient_c=23.0)
    assert done.error_rad < 1e-3
    assert done.temp_c[-1].max() == pytest.approx(90.0, abs=2.0)
