"""Studies of a twin over its life: reference values by hand, and what must never enter a training."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper.drift import (
    D_CAL,
    NEVER,
    P_VALUE,
    THERMAL,
    WATCHED,
    WEAR,
    Cusum,
    DriftSize,
    cool_jobs,
    delay_days,
    drift_tables,
    with_cooling,
    work_days,
)
from benchmarks.paper.features import (
    cross_validated,
    job_inputs,
    moments,
    over_time,
    synthetic_motion,
    with_wear,
    worn_jobs,
)
from benchmarks.paper.subjects import SHORT, make_study, sensed, with_steps
from benchmarks.paper.transfer import (
    FURTHER,
    NOTHING,
    RESCALED,
    continue_training,
    data_ratio,
    equal_quality,
    transfer_tables,
)
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import gen3_network, thermal_model
from scenarios.motion.generate import Verification
from scenarios.prepare.twins import records
from twin.vae.config import TwinConfig
from twin.vae.train import train
from twin.vae.window import cut_jobs, windows_of

TINY = replace(SHORT, hidden=4, epochs=2)
SMALL = DriftSize(days=24, onset=8, reference=4, full=8, jobs=3, window=6, period=6, least=4, train=8, pool=8, steps=4,
                  further_steps=2, config=TINY)  # fmt: skip


@pytest.fixture(scope="module")
def study():
    return make_study(np.random.SeedSequence(3), train=8, reference=16, test=24, novel=8)


@pytest.fixture(scope="module")
def twin(study):
    return train(records(study.train.plans), TINY, np.random.SeedSequence(0), arm="arm")


def test_sensed_torque_is_the_current_times_the_nominal_constant(study):
    motors = with_wear(gen3_motors(), 0.5)
    plan = study.train.plans[0]
    q, qd, tau = sensed([plan], motors)[0].cycle.profile.transpose(1, 0, 2).astype(float)
    own = gen3_motors(wear=0.5)
    planned = plan.cycle.profile[:, 2].astype(float)
    friction = own.coulomb_nm * np.tanh(qd / own.v0_rad_s) + own.viscous_nms_per_rad * qd
    current_a = (planned / own.eta + friction) / own.torque_per_amp
    np.testing.assert_allclose(tau, current_a * own.torque_per_amp * own.eta, atol=1e-4)
    np.testing.assert_array_equal(q, plan.cycle.profile[:, 0])


def test_fewest_jobs_of_equal_quality_are_interpolated_over_their_logarithm():
    jobs = np.array([5, 10, 20])
    assert equal_quality(jobs, np.array([0.3, 0.2, 0.1]), 0.3) == 5
    assert equal_quality(jobs, np.array([0.3, 0.2, 0.1]), 0.15) == pytest.approx(np.sqrt(10 * 20))
    assert equal_quality(jobs, np.array([0.3, 0.2, 0.1]), 0.05) == 40


def test_further_training_starts_from_the_given_weights(twin, study):
    plans = study.reference.plans[:4]
    parts = records(plans)
    still = replace(TINY, epochs=1, learning_rate=1e-12)
    same = continue_training(twin, parts, still, np.random.SeedSequence(1), arm="other")
    for name, tensor in twin.tensors().items():
        np.testing.assert_allclose(same.tensors()[name], tensor, atol=1e-9)
    assert same.arm == "other"
    assert (same.scaler.mean != twin.scaler.mean).any()
    longer = with_steps(replace(TINY, learning_rate=3e-3), parts, 60)
    further = continue_training(twin, parts, longer, np.random.SeedSequence(1), arm="other")
    windows = windows_of(parts, TINY)
    assert further.window_errors(windows).mean() < same.window_errors(windows).mean()
    with pytest.raises(ValueError, match="hidden"):
        continue_training(twin, parts, replace(TINY, hidden=5), np.random.SeedSequence(1), arm="other")
    with pytest.raises(ValueError, match="7 joints, the records have 2"):
        continue_training(twin, [part[..., :2] for part in parts], still, np.random.SeedSequence(1), arm="other")


def test_a_regression_sees_no_job_that_it_is_judged_on():
    rng = np.random.default_rng(0)
    y = rng.normal(size=200)
    inputs = {"knows": y[:, None] + rng.normal(0, 0.1, (200, 1)), "noise": rng.normal(size=(200, 20))}
    found = {row["inputs"]: row for row in cross_validated(inputs, {"y": y}, (200,), seed=1)}
    assert found["knows"]["r2"] == pytest.approx(0.99, abs=0.01)
    assert found["knows"]["rmse"] == pytest.approx(0.1, abs=0.02)
    assert found["noise"]["r2"] < 0.05


def test_worn_jobs_are_hotter_and_their_targets_belong_to_them(study):
    jobs, targets = worn_jobs(study, np.random.default_rng(0))
    rise, payload_kg, wear = targets.values()
    fresh = study.test.peak_c.max(axis=1) - study.ambient_c
    assert (rise > fresh - 0.1).all()  # friction that holds a sinking arm saves a little current
    assert (rise - fresh).mean() > 0.5
    assert np.corrcoef((rise - fresh) / fresh, wear)[0, 1] > 0.3
    assert payload_kg.tolist() == [plan.work.payload_kg for plan in jobs.plans]


def test_a_cusum_alarms_after_a_step_and_starts_anew():
    reference = [1.0, -1.0] * 5
    step = 1.5 * float(np.std(reference, ddof=1))  # the sum grows by 1.5 - 0.5 a day
    watch = Cusum(reference=10, slack=0.5, threshold=5.25)
    assert not any(watch.add(value) for value in reference * 3)
    assert [watch.add(value) for value in [step] * 12].index(True) == 5
    watch.restart()
    assert not any(watch.add(value) for value in [step] * 10)
    assert not watch.add(float("nan"))


def test_weaker_cooling_scales_what_leads_to_ambient_alone():
    network = gen3_network()
    weaker = thermal_model(with_cooling(network, 0.5))
    nominal = thermal_model(network)
    np.testing.assert_allclose(weaker.to_ambient, 0.5 * nominal.to_ambient)
    np.testing.assert_allclose(
        weaker.laplacian - np.diag(weaker.to_ambient), nominal.laplacian - np.diag(nominal.to_ambient)
    )


def test_only_jobs_that_stayed_cool_over_the_horizon_are_learned_from(study):
    days = work_days(study, WEAR, SMALL, np.random.default_rng(1))
    hottest = np.array([day.peak_c.max() for day in days])
    assert hottest.max() > study.cool_c  # there is something to keep out
    recent = cool_jobs(days, study.cool_c)
    assert recent
    assert all(day.peak_c[i].max() <= study.cool_c for day, i in recent)
    chosen = {(id(day), i) for day, i in recent}
    assert not any(day.peak_c[i].max() <= study.cool_c for day in days for i in range(6) if (id(day), i) not in chosen)


def test_synthetic_motion_is_predicted_to_stay_cool(twin, study):
    nominal = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)
    rng = np.random.default_rng(0)
    made = synthetic_motion(twin, study, study.train.plans[:3], nominal, 0.5, rng)
    plans = [next(made) for _ in range(2)]
    assert all(nominal.peak_c(plan).max() <= study.cool_c - nominal.margin_k for plan in plans)


def transferred(seed: int, further: tuple[float, float]) -> dict:
    errors = {NOTHING: (0.6, 0.5), RESCALED: (0.55, 0.52), FURTHER: further}
    rows = [
        {"start": start, "jobs": jobs, "cpu_s": 1.0, "error": error, "auroc": None}
        for start, pair in errors.items()
        for jobs, error in zip((5, 40), pair, strict=True)
    ]
    return {"target": "tool", "seed": seed, "unchanged_error": 0.7, "trained": rows}


def test_the_share_of_data_is_that_of_equal_error():
    assert data_ratio(transferred(1, (0.5, 0.4)), FURTHER) == 5 / 40
    assert data_ratio(transferred(1, (0.55, 0.45)), FURTHER) == pytest.approx(np.sqrt(5 * 40) / 40)
    assert data_ratio(transferred(1, (0.5, 0.4)), RESCALED) == 2.0
    saved = transfer_tables([transferred(1, (0.5, 0.4))])["transfer_savings"].rows[0]
    assert saved[3] == "0.12"
    assert saved[5] == "unknown → unknown"


def test_delays_and_false_alarms_are_counted_from_the_onset():
    times = {"days": 40, "onset": 20, "reference": 10, "window": 14, "policy": NEVER, "retrainings": [], "seed": 1}
    none = {name: [] for name in WATCHED}
    lives = [
        {**times, "kind": "none", "alarms": none | {THERMAL: [15, 30]}, "peak_rms_k": 1.0, "cool_flagged": 0.05},
        {
            **times,
            "kind": WEAR,
            "alarms": none | {THERMAL: [15, 26], P_VALUE: [23]},
            "peak_rms_k": 2.0,
            "cool_flagged": 0.1,
        },
    ]
    rows = {row[0]: tuple(row[1:]) for row in drift_tables(lives)["drift_delays"].rows}
    assert rows[WEAR] == ("– (0 of 1)", "3 (1 of 1)", "6 (1 of 1)")
    assert rows["false alarms per 100 days"] == ("0.00", "0.00", "7.50")  # 3 alarms in 30 + 10 watched days
    assert delay_days(lives[1]) == 3
    assert delay_days(lives[1], (D_CAL,)) == np.inf


def test_aggregation_by_hand(small):
    work = small.work()
    plan = small.arm(0, [work], times=small.Times(approach=4.0, cycle=8.0, retreat=4.0)).plans[work][0]
    reading = cut_jobs([plan, plan], [1, 3], TwinConfig().changed(window=50))  # windows of 4 s: 1 + 2 + 1
    found = over_time(reading, np.array([0.0, 1.0, 3.0, 4.0] * 2)[:, None])
    np.testing.assert_allclose(found[0], [2.0, np.sqrt((4 + 1 + 1 + 4) / 4)])
    np.testing.assert_allclose(found[1], [(0 + 3 * 1 + 3 * 3 + 4) / 8, np.sqrt((4 + 3 * 1 + 3 * 1 + 4) / 8)])


def test_moments_by_hand():
    windows = np.zeros((1, 2, 1, 3))
    windows[0, :, 0, 2] = [1.0, 7.0]
    np.testing.assert_allclose(moments(windows)[0, 0], [0, 0, 4.0, 0, 0, 3.0, 0, 0, 5.0])


def test_inputs_follow_their_jobs(study, twin):
    jobs = study.test
    order = np.random.default_rng(0).permutation(len(jobs.plans))
    moved = replace(jobs, plans=tuple(jobs.plans[i] for i in order), peak_c=jobs.peak_c[order])
    first, again = job_inputs(twin, jobs), job_inputs(twin, moved)
    assert first["latent"].shape == (24, 7 * 2 * 2)
    assert first["raw"].shape == (24, 7 * 9 * 2)
    assert first["both"].shape == (24, 7 * 22)
    for name, values in first.items():
        np.testing.assert_allclose(values[order], again[name], rtol=1e-4, atol=1e-5)
