"""`thermofleet twin score --verdict`, and held-out recordings."""

import json

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.prepare.twins import train_log
from tests.logs import COOL, RATE_HZ, TINY, WARM, csv_of, logged
from twin.logs.recording import cool_stretches
from twin.vae.config import hash_records
from twin.verdict import log_features


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
    cool = cool_stretches(rest, RATE_HZ, cool_c=40.0, joints=(0, 1, 2, 3))
    assert twin.data_hash == hash_records([stretch.profile for stretch in cool])
    assert train_log([*COOL[:5], WARM], TINY, 3, cool_c=40.0).calibration is None  # a third of 5 are too few
    for seed, says in ((1.5, "seed must be an integer"), (-1, "seed must be 0 to")):
        with pytest.raises(FleetError, match=says):
            train_log(COOL, TINY, seed, cool_c=40.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Logs as files, of which the last is heavy."""
    where = tmp_path_factory.mktemp("verdict")
    (where / "logs").mkdir()
    for r in [*COOL, logged("heavy", load=3.0, seed=91)]:
        place = where / ("heavy.csv" if r.name == "heavy" else f"logs/{r.name}.csv")
        place.write_text(csv_of(r, ".6f"), encoding="utf-8")
    return where


def test_logs_get_a_verdict_and_a_map(thermofleet, folder, tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)  # no terminal: the table is as wide as it needs
    size = ("--hidden", 8, "--epochs", 10, "--max-windows", 150, "--restarts", 1, "--allow-collapse")
    twins, drawn = tmp_path / "twins", tmp_path / "map.png"
    said = thermofleet("twin", "train", "--log", folder / "logs", *size, "--hold-out", 0.5, "--out", twins, "--json")
    assert json.loads(said.out)["twins"][0]["calibrated_on"] == 7
    said = thermofleet("twin", "train", "--log", folder / "logs", *size, "--hold-out", 0.2, "--out", tmp_path / "few")
    assert "(--hold-out): 0 (this share of the cool recordings is less than 4), no verdicts" in said.out
    asked = ("twin", "score", twins, "--verdict", "--log")
    said = thermofleet(*asked, folder / "heavy.csv", "--alpha", 0.125, "--json", "--map", drawn)
    (row,) = json.loads(said.out)["rows"]
    assert (row["verdict"], row["p_load"], row["recording"]) == ("anomalous", 0.125, "heavy")
    assert (row["anomalous_share"], row["p_novelty"] <= 1.0) == (1.0, True)
    assert row["latent"] > 0
    assert drawn.read_bytes().startswith(b"\x89PNG")
    said = thermofleet(*asked, folder / "logs", "--alpha", 0.125, "--json", "--reading", "d")
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
        assert thermofleet(*asked, folder / "heavy.csv", *extra).refused(sentence)
