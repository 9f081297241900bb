"""A twin: its readings, what is kept in a checkpoint, and what training is worth."""

import gc
import json
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file
from sklearn.metrics import roc_auc_score

from fleet.errors import CheckpointError
from fleet.motion import Phase
from scenarios.prepare.twins import open_twin, save_twins
from tests.profiles import examples
from tests.twin.test_verdict import heavier
from twin.baselines import untrained_config
from twin.vae.config import TwinConfig
from twin.vae.inference import Networks
from twin.vae.measures import PARTS, Calibration, Features
from twin.vae.model import build, weights_of
from twin.vae.train import train
from twin.vae.twin import CARD, WEIGHTS, Twin, load, save
from twin.vae.window import cut, resample


@pytest.fixture
def folder(twin, tmp_path):
    save(twin, tmp_path / "arm_0")
    return tmp_path / "arm_0"


def file(name, change):
    def damage(folder):
        content = (folder / name).read_bytes()
        (folder / name).unlink() if change is None else (folder / name).write_bytes(change(content))

    return damage


def card(change):
    def damage(content):
        told = json.loads(content)
        change(told)
        return json.dumps(told).encode()

    return file(CARD, damage)


def tensors(change):
    def damage(folder):
        found = load_file(folder / WEIGHTS)
        change(found)
        save_file(found, folder / WEIGHTS)

    return damage


MU = "joint_3.mu.weight"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        *((file(name, None), f"{name} is missing") for name in (CARD, WEIGHTS)),
        *((file(name, lambda content: content[:-40]), name) for name in (CARD, WEIGHTS)),
        (tensors(lambda found: found.pop(MU)), r"missing tensor 'joint_3\.mu\.weight'"),
        (
            tensors(lambda found: found.update({MU: found[MU][:1].copy()})),
            r"weight' is float32 \[1, 16\], not float32 \[",
        ),
        (tensors(lambda found: found[MU].__setitem__((0, 0), found[MU][0, 0] + 1e-6)), "changed since it was saved"),
        (card(lambda told: told.update(format=99, surprise=1)), "format 99 is not supported, only 3"),
        (card(lambda told: told["mean"][2].__setitem__(1, 0.5)), "changed since it was saved"),
        (card(lambda told: told.update(arm="arm_9")), "changed since it was saved"),
        (card(lambda told: told["config"].update(score_stride=6)), "changed since it was saved"),
        (card(lambda told: told["config"].update(hidden=8)), "not float32"),
        (card(lambda told: told["config"].update(hidden=-8)), r"hidden must be 1 to 1024 \(got -8\)"),
        (card(lambda told: told["std"].pop()), "must each have 7 joints"),
        (card(lambda told: told["fits"].pop()), r"needs 7 network\(s\) and fits \(got 7 and 6\)"),
        (card(lambda told: told["config"].update(scope="arm")), "missing tensor"),
        (card(lambda told: told["config"].update(kind="ae")), "unknown tensors"),
        (card(lambda told: told["std"][0].pop()), "Expected `array` of length 3"),
        (card(lambda told: told.pop("seed")), "seed"),
        (card(lambda told: told.update(more=1)), "more"),
    ],
)
def test_a_damaged_checkpoint_is_refused_and_its_damage_named(folder, damage, words):
    damage(folder)
    with pytest.raises(CheckpointError, match=words):
        load(folder)


def test_a_file_in_place_of_a_folder_and_a_folder_in_place_of_a_file_are_refused(folder):
    with pytest.raises(CheckpointError, match=r"No twin in .*twin\.json: twin\.json is missing"):
        load(folder / CARD)
    for name, words in (
        (WEIGHTS, rf"{WEIGHTS} cannot be read: "),
        (CARD, r"twin\.json cannot be read: Is a directory"),
    ):
        (folder / name).unlink()
        (folder / name).mkdir()
        with pytest.raises(CheckpointError, match=words):
            load(folder)


def test_another_number_of_joints_is_refused(folder):
    with pytest.raises(CheckpointError, match="the twin has 7 joints, the arm has 6"):
        load(folder, joints=6)


@pytest.mark.parametrize("change", [{}, {"layers": 2, "latent": 3}, {"scope": "arm"}, {"kind": "ae"}])
def test_every_kind_of_twin_comes_back(records, small, tmp_path, plan, change):
    config = replace(small, **change, epochs=1, allow_collapse=True)
    other = train(records[:3], config, np.random.SeedSequence(0), arm="b")
    save(other, tmp_path)
    back = load(tmp_path)
    assert (back.version, back.arm, back.data_hash, back.seed) == (other.version, "b", other.data_hash, other.seed)
    assert (back.config, back.fits) == (other.config, other.fits)
    np.testing.assert_array_equal(back.score(plan, 2).per_joint, other.score(plan, 2).per_joint)


def test_saving_leaves_two_files_and_loading_no_trace_in_the_random_state(twin, folder):
    save(twin, folder)
    assert sorted(path.name for path in folder.iterdir()) == [CARD, WEIGHTS]
    before = torch.random.get_rng_state()
    load(folder)
    assert torch.equal(before, torch.random.get_rng_state())


configs = st.builds(
    TwinConfig,
    kind=st.sampled_from(["vae", "ae"]),
    latent=st.integers(1, 5),
    hidden=st.integers(1, 40),
    layers=st.integers(1, 3),
    window=st.integers(2, 60),
    stride=st.just(1),
    score_stride=st.just(1),
)


def several(count, config, channels=3):
    return [build(config, seed, channels=channels) for seed in range(count)]


def drawn(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@examples(30)
@pytest.mark.parametrize("jit_off", ["0", "1"], ids=["compiled", "in NumPy"])
@given(config=configs, count=st.integers(1, 7), joints=st.integers(1, 3), batch=st.integers(1, 28))
def test_windows_of_an_arm_go_through_each_network_alone(config, count, joints, batch, jit_off):
    """`joints` of each network: 1 with a network per joint, all of the arm with one network."""
    nets, z = several(count, config, 3 * joints), drawn(batch, batch, config.window, count * joints, 3)
    apart = torch.from_numpy(z).reshape(batch, config.window, count, 3 * joints)
    with torch.inference_mode():
        outputs = [net(apart[:, :, n], torch.zeros(batch, config.latent)) for n, net in enumerate(nets)]
    want = np.stack([x_hat.numpy() for x_hat, _, _ in outputs], axis=2).reshape(z.shape)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_DISABLE_JIT", jit_off)
        networks = Networks([weights_of(net) for net in nets])
    got = networks.reconstruct(z)[0]
    assert (got.shape, got.dtype) == (z.shape, np.float32)
    np.testing.assert_allclose(got, want, atol=2e-6)
    mu, sigma = networks.posterior(z)
    np.testing.assert_allclose(mu, np.stack([each.numpy() for _, each, _ in outputs], axis=1), atol=2e-6)
    variance = np.stack([each.exp().numpy() for _, _, each in outputs], axis=1)
    np.testing.assert_allclose(sigma, np.sqrt(variance), rtol=1e-5)
    np.testing.assert_allclose(networks.decode(mu, config.window), want, atol=2e-6)


def test_many_windows_in_several_passes_are_each_window_alone():
    networks, z = Networks([weights_of(net) for net in several(2, TwinConfig(hidden=8))]), drawn(2, 600, 20, 2, 3)
    together = networks.reconstruct(z)[0]
    for i in (0, 63, 64, 599):
        np.testing.assert_allclose(together[i], networks.reconstruct(z[i : i + 1])[0][0], atol=2e-6)


def test_a_pickled_twin_scores_the_same(twin, plan):
    fresh = pickle.loads(pickle.dumps(twin))
    size = len(pickle.dumps(fresh))
    score = fresh.score(plan, 3).per_joint
    assert len(pickle.dumps(fresh)) == size
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fresh)).score(plan, 3).per_joint, score)


def test_a_saved_twin_scores_without_torch(twin, plan, tmp_path):
    save(twin, tmp_path)
    (tmp_path / "plan.pickle").write_bytes(pickle.dumps(plan))
    source = (
        "import pathlib, pickle, sys; from twin.vae.twin import load; folder = pathlib.Path(sys.argv[1]); "
        "score = load(folder).score(pickle.loads((folder / 'plan.pickle').read_bytes()), 3); "
        "print(score.total, 'torch' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", source, tmp_path], capture_output=True, text=True, check=True)
    total, torch_is_there = said.stdout.split()
    assert float(total) == pytest.approx(twin.score(plan, 3).total, rel=1e-5)
    assert torch_is_there == "False"


NOTHING = Phase(np.zeros((0, 3, 7), np.float32), np.zeros(0, np.float32))


def job_errors(twin, plan, repetitions=1):
    return twin.features([plan], [repetitions]).errors[0]


def phase_errors(twin, plan):
    """Errors of each phase as a job of its own, [phase, joint, channel]."""
    alone = [replace(plan, approach=NOTHING, cycle=phase, retreat=NOTHING) for phase in plan.phases]
    return twin.features(alone, [1, 1, 1]).errors


def test_more_torque_than_known_raises_the_score_of_that_joint_alone(twin, plan):
    loaded = heavier(plan, 3, 3.0)
    rise = twin.score(loaded, 10).per_joint - twin.score(plan, 10).per_joint
    assert rise[3] > 0.05
    assert np.all(np.abs(np.delete(rise, 3)) < 1e-6)
    assert twin.measure(loaded, 10).shares[3, 2] > twin.measure(plan, 10).shares[3, 2]


def test_the_job_error_is_the_mean_over_its_time(twin, plan):
    per_phase = phase_errors(twin, plan)
    times = np.array([3.0, 4 * 10.0, 2.5])
    want = (times[:, None, None] * per_phase).sum(0) / times.sum()
    np.testing.assert_allclose(job_errors(twin, plan, 4), want)


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
    jobs = dict(enumerate([*plans, plans[0]], start=1))
    together = twin.features(list(jobs.values()), list(jobs)).errors
    fresh = pickle.loads(pickle.dumps(twin))
    alone = np.stack([job_errors(fresh, plan, times) for times, plan in jobs.items()])
    assert together.shape == (5, 7, 3)
    np.testing.assert_allclose(together, alone, rtol=1e-6)
    assert twin.features([], []).errors.shape == (0, 7, 3)


def test_jobs_that_cannot_be_scored_are_refused(twin, plan):
    short = replace(plan, cycle=Phase(plan.cycle.profile[:, :, :6], plan.cycle.payload_kg))
    for refused, repetitions, words in (
        (plan, 0, "at least one repetition"),
        (short, 1, "has 7 joints, Cycle of arm 'arm' 6"),
    ):
        with pytest.raises(ValueError, match=words):
            twin.score(refused, repetitions)
    for value in (np.nan, np.inf):
        plan.cycle.profile[3, 1, 2] = value
        with pytest.raises(ValueError, match="Cycle of arm 'arm' is not finite: qd of joint 3 at sample 3"):
            twin.score(plan, 1)


def test_window_errors_are_the_mean_distance_to_what_the_posterior_mean_decodes_to(twin, plan):
    windows = cut(resample(plan.cycle.profile, 50.0, 12.5), twin.config.window, 6)
    away = np.abs(windows - twin.reconstruct(windows)) / twin.scaler.std
    np.testing.assert_allclose(twin.window_features(windows).errors, away.mean(axis=1), rtol=1e-4)
    mu, sigma = twin.posterior(windows)
    assert mu.shape == sigma.shape == (len(windows), 7, 2)
    assert np.all((sigma > 0) & (sigma < 1.5))
    np.testing.assert_allclose(twin.decode(mu), twin.reconstruct(windows), rtol=1e-5, atol=1e-5)
    assert twin.window_errors(windows[:0]).shape == (0, 7, 3)
    assert twin.decode(twin.posterior(windows[:0])[0]).shape == twin.reconstruct(windows[:0]).shape == (0, 12, 7, 3)
    with pytest.raises(ValueError, match=r"Latents must be \[batch, 7, 2\]"):
        twin.decode(mu[:, :, :1])


def test_what_does_not_belong_to_a_twin_is_refused(twin, plan):
    for windows in (np.zeros((2, 9, 7, 3)), np.full((2, TwinConfig().window, 7, 3), np.nan)):
        with pytest.raises(ValueError, match="Windows must be"):
            twin.posterior(windows)
    with pytest.raises(ValueError, match="Each job needs its repetitions: 1 plans, 2 repetitions"):
        twin.features([plan], [1, 2])
    with pytest.raises(ValueError, match=r"scope 'arm' for 7 joints needs 1 network"):
        Twin(replace(twin.config, scope="arm"), twin.scaler, twin.nets, arm="a", data_hash="", seed="0", fits=twin.fits)
    with pytest.raises(ValueError, match="calibration is for 6 joints, the twin has 7"):
        replace(twin, calibration=Calibration(Features(np.zeros((4, 6, PARTS))), np.zeros(4, int)))


RATE_HZ, WINDOW, GRAVITY_NM, OMEGA = 12.5, 25, 20.0, 2 * np.pi / 3
CONFIG = TwinConfig(
    hidden=16, window=WINDOW, stride=WINDOW, score_stride=WINDOW, rate_hz=RATE_HZ, record_hz=RATE_HZ, epochs=80,
    batch=64, restarts=1, learning_rate=1e-2, allow_collapse=True,
)  # fmt: skip


def swings(rng: np.random.Generator, count: int, *, mixed_up: bool = False) -> np.ndarray:
    """Windows [batch, time, 1, channel] of one joint that swings by a random amplitude and phase under gravity.

    Mixed up, each has the torque of another one.
    """
    angle = OMEGA * np.arange(WINDOW) / RATE_HZ + rng.uniform(0, 2 * np.pi, (count, 1))
    size = rng.uniform(0.2, 1.0, (count, 1))
    q, qd = size * np.sin(angle), size * OMEGA * np.cos(angle)
    tau = np.roll(GRAVITY_NM * np.sin(q + 0.3), int(mixed_up), axis=0) + rng.normal(0, 0.1, q.shape)
    return np.stack([q, qd, tau], axis=-1)[:, :, None]


def twin_of(windows: np.ndarray, config: TwinConfig, seed: int) -> Twin:
    records = list(windows.transpose(0, 1, 3, 2))
    return train(records, config, np.random.SeedSequence(seed), arm="swing")


def test_a_twin_of_several_is_chosen_by_the_name_of_its_arm_as_it_is_written(twin, tmp_path):
    twins = [replace(twin, arm=arm) for arm in ("Halle 1", "Öl 50%")]
    save_twins(twins, tmp_path, "by hand")
    for each in twins:
        assert open_twin(tmp_path, each.arm).arm == each.arm
    with pytest.raises(CheckpointError, match="holds 2 twins; choose one with --arm: Öl 50%, Halle 1"):
        open_twin(tmp_path)
    with pytest.raises(CheckpointError, match=r"No twin of arm 'Halle' in .*; did you mean 'Halle 1'"):
        open_twin(tmp_path, "Halle")


@pytest.mark.ci_slow
def test_training_is_worth_something() -> None:
    seed, rng = 0, np.random.default_rng(0)
    cool, mix_up = swings(rng, 300), swings(rng, 300, mixed_up=True)
    new, anomalous = swings(rng, 200), swings(rng, 200, mixed_up=True)
    twins = {
        "trained": twin_of(cool, CONFIG, seed),
        "untrained": twin_of(cool, untrained_config(CONFIG), seed),
        "shuffled": twin_of(mix_up, CONFIG, seed),
    }
    auroc, error = {}, {}
    for name, twin in twins.items():
        of_new, of_anomalous = (twin.window_features(w).errors.sum(axis=(1, 2)) for w in (new, anomalous))
        auroc[name] = roc_auc_score(np.repeat([0, 1], 200), np.concatenate([of_new, of_anomalous]))
        error[name] = of_new.mean()
    assert auroc["trained"] > 0.8
    assert auroc["trained"] > auroc["untrained"] + 0.2
    assert auroc["trained"] > auroc["shuffled"] + 0.2
    assert error["trained"] < 0.5 * error["untrained"]
