"""`thermofleet twin verdict`, held-out recordings, and the studies of verdicts: by hand and by made-up windows."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.evaluate.statistics import interval
from scenarios.prepare.twin_folder import train_log
from scenarios.studies.verdict.log_questions import QUESTIONS, Windows, answers, judged_windows
from scenarios.studies.verdict.readings import ALPHA, JOINTS, MEASURES, SIZES, TOTALS, Errors, summary
from scenarios.studies.verdict.sides import share_of
from twin.logs.recording import Recording
from twin.training_data import cool_stretches
from twin.vae.config import TwinConfig
from twin.vae.measures import PARTS, Calibration, Features, moments
from twin.vae.training_key import hash_records
from twin.verdict.log_features import log_features

RATE_HZ = 2.0
TINY = TwinConfig(
    hidden=4, epochs=3, max_windows=100, restarts=1, rate_hz=RATE_HZ, record_hz=RATE_HZ, allow_collapse=True
)


def logged(name: str, *, load: float = 1.0, celsius: float = 31.0, seed: int = 0, seconds: float = 80.0) -> Recording:
    """Seven joints that swing at 2 Hz, joint 2 at one temperature."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds, 1 / RATE_HZ)
    omega, shift = rng.uniform(0.1, 0.6, 7), rng.uniform(0, 6, 7)
    q = 0.5 * np.sin(np.outer(time_s, omega) + shift)
    tau = load * 10 * np.cos(q) + rng.normal(0, 0.2, q.shape)
    temp_c = np.full(q.shape, 30.0)
    temp_c[:, 1] = celsius
    return Recording(name=name, time_s=time_s, q=q, qd=np.gradient(q, time_s, axis=0), tau=tau, temp_c=temp_c)


COOL = [logged(f"cool_{i}", seed=i) for i in range(14)]
WARM = logged("warm", celsius=45.0, seed=90)


def test_a_twin_of_logs_is_calibrated_on_whole_recordings_that_it_was_not_trained_on() -> None:
    """Second method: of some recordings left out, the hash of the training data tells which."""
    twin = train_log([*COOL, WARM], TINY, 3, cool_c=40.0, hold_out=0.5)
    assert twin.calibration is not None
    known = twin.calibration.reference.packed
    assert len(known) == 7
    own = {r.name: log_features(twin, r).packed for r in COOL}
    held_out = [name for name, packed in own.items() if any(np.allclose(packed, each) for each in known)]
    assert len(held_out) == 7
    rest = [r for r in COOL if r.name not in held_out]
    cool = cool_stretches(rest, RATE_HZ, cool_c=40.0, horizon_s=np.inf, joints=(0, 1, 2, 3))
    assert twin.data_hash == hash_records([stretch.profile for stretch in cool])
    assert train_log([*COOL[:5], WARM], TINY, 3, cool_c=40.0).calibration is None  # a third of 5 are too few


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Logs as files, of which the last is heavy."""
    where = tmp_path_factory.mktemp("verdict")
    (where / "logs").mkdir()
    for r in [*COOL, logged("heavy", load=3.0, seed=91)]:
        assert r.temp_c is not None
        columns = {"time_s": r.time_s[:, None], "q": r.q, "qd": r.qd, "tau": r.tau, "temp_c": r.temp_c}
        head = ["time_s", *(f"{name}_{j}" for name in list(columns)[1:] for j in range(1, 8))]
        rows = "\n".join(",".join(f"{v:.6f}" for v in row) for row in np.hstack(list(columns.values())))
        place = where / ("heavy.csv" if r.name == "heavy" else f"logs/{r.name}.csv")
        place.write_text(",".join(head) + "\n" + rows + "\n", encoding="utf-8")
    return where


def test_logs_get_a_verdict_and_a_map(thermofleet, folder, tmp_path) -> None:
    size = ("--hidden", 8, "--epochs", 10, "--max-windows", 150, "--restarts", 1, "--allow-collapse")
    twins, drawn = tmp_path / "twins", tmp_path / "map.png"
    said = thermofleet("twin", "train", "--log", folder / "logs", *size, "--hold-out", 0.5, "--out", twins, "--json")
    assert json.loads(said.out)["twins"][0]["calibrated_on"] == 7
    asked = ("twin", "verdict", twins, "--log")
    said = thermofleet(*asked, folder / "heavy.csv", "--alpha", 0.125, "--format", "json", "--map", drawn)
    (row,) = json.loads(said.out)["rows"]
    assert (row["verdict"], row["p_value"], row["recording"]) == ("anomalous", 0.125, "heavy")
    assert row["latent"] > 0
    assert drawn.read_bytes().startswith(b"\x89PNG")
    said = thermofleet(*asked, folder / "logs", "--alpha", 0.125, "--format", "json", "--reading", "d")
    verdicts = [row["verdict"] for row in json.loads(said.out)["rows"]]
    assert len(verdicts) == 14
    assert verdicts.count("uncritical") >= 7
    said = thermofleet(*asked, folder / "logs", "--alpha", 0.125)
    assert "uncritical" in said.out
    assert "…" not in said.out
    for extra, sentence in (
        ((), "A false-alarm rate of 0.05 needs 19 held-out cool jobs of each kind or more"),
        (("--alpha", 0.2, "--reading", "lod"), "No reading 'lod'; did you mean 'load'?"),
        (("--alpha", 0.2, "--map", tmp_path / "map.svg"), "--map must end in .png"),
    ):
        said = thermofleet(*asked, folder / "heavy.csv", *extra)
        assert said.code == 2
        assert sentence in " ".join(said.err.split())


def windows_of(file: list[str], d: list[float], rms: list[float], temp_c: list[float]) -> Windows:
    scores = {"d": np.array(d), "load": np.array(d), "latent": np.array(d), "rms_torque": np.array(rms)}
    temps = np.array(temp_c)
    return Windows(
        file=np.array(file), fold=np.zeros(len(file), int), scores=scores, temp_c=temps, end_c=temps, peak_next_c=temps
    )


def test_a_lead_over_rms_torque_has_an_interval_over_files() -> None:
    """d ranks every window rightly, RMS torque is constant: AUROC 1 and ½, whichever files are drawn."""
    file = [name for name in "abcdef" for _ in range(4)]
    temp_c = [45.0 if name in "abc" else 30.0 for name in file]
    found = answers(windows_of(file, temp_c, [1.0] * len(file), temp_c))
    assert list(found) == list(QUESTIONS)[:1]  # nothing passes 40 °C from below, nothing gains 1 K
    (answer,) = found.values()
    assert (answer.windows, answer.events, answer.files, answer.files_with) == (24, 12, 6, 3)
    means = answer.auroc["d"].mean, answer.auroc["rms_torque"].mean, answer.lead["d"].mean
    assert means == (1.0, 0.5, 0.5)
    assert answer.lead["d"].note.startswith("no variation in ")
    # One file with the event: no interval over files.
    alone = [45.0 if name == "a" else 30.0 for name in file]
    assert answers(windows_of(file, alone, alone, alone)) == {}


def test_every_file_is_judged_once_by_a_twin_that_does_not_know_it(tmp_path) -> None:
    recordings = [*COOL, WARM, replace(WARM, name="warm_2")]
    windows = judged_windows(recordings, 0, config=replace(TINY, epochs=1), folder=tmp_path)
    assert set(windows.file) == {r.name for r in recordings}
    for name in np.unique(windows.file):
        assert len(np.unique(windows.fold[windows.file == name])) == 1
    assert len(np.unique(windows.fold)) == 5
    assert all(np.isfinite(score).all() for score in windows.scores.values())
    with pytest.raises(FleetError, match="needs 10 logs that stay below 40 °C on joint 2"):
        judged_windows(COOL[:9], 0, config=TINY, folder=tmp_path)


def test_readings_rank_more_error_higher_and_tell_jobs_apart() -> None:
    rng = np.random.default_rng(4)
    known = Features(rng.gamma(2.0, 0.2, (40, 7, PARTS + moments(2))))
    calibration = Calibration(known, np.zeros(40, int))
    less = known.packed[:10]
    more = less.copy()
    more[..., :PARTS] *= 1.7
    weight = rng.dirichlet(np.ones(7)) * 7
    for name, reading in {**TOTALS, **JOINTS}.items():
        low, high = (reading(Errors(Features(packed), calibration, weight)) for packed in (less, more))
        assert np.all(high >= low), name
        if not name.startswith("latent"):
            assert np.any(high > low), name


@pytest.mark.parametrize(
    ("text", "wrong"),
    [("hello", "no result of `twin readings`"), ("{}", "no result of"), (None, "readings of other settings")],
)
def test_readings_replace_no_file_of_something_else(thermofleet, tmp_path, text, wrong) -> None:
    file = tmp_path / "readings.json"
    quick = TwinConfig.quick()
    basis = {"sizes": SIZES, "epochs": quick.epochs + 1, "max_windows": quick.max_windows, "window": quick.window}
    card = {**basis, "hidden": quick.hidden, "latent": quick.latent, "beta": quick.beta, "alpha": ALPHA, "arms": {}}
    file.write_text(json.dumps(card) if text is None else text, encoding="utf-8")
    before = file.read_bytes()
    said = thermofleet("twin", "readings", "quickstart", "--out", file)
    assert said.code == 2
    assert wrong in said.err
    assert file.read_bytes() == before


def test_shares_have_their_intervals() -> None:
    share, low, high = share_of(np.repeat([True, False], [9, 1]))
    # Wilson's interval of 9 of 10, Agresti & Coull, The American Statistician 52 (1998): centre (9 + 1.92) / 13.84.
    assert share == 0.9
    assert (low + high) / 2 == pytest.approx((9 + 1.96**2 / 2) / (10 + 1.96**2), abs=1e-3)


def test_readings_are_means_over_arms_not_over_their_seeds() -> None:
    values = {"s/a/0": 1.0, "s/a/1": 3.0, "s/b/0": 5.0, "s/b/1": None, "s/c/0": 6.0, "s/c/1": 6.0}
    arms = {name: {"any": {"d": dict.fromkeys(MEASURES) | {"auroc": value}}} for name, value in values.items()}
    ((reading, found),) = summary({"arms": arms}, "any")
    assert reading == "d"
    assert found["auroc"] == interval([2.0, 5.0, 6.0])
    assert np.isnan(found["hits"].mean)
