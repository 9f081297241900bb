"""Files of generated motion and of a recovery: what is read back, and nothing at all when writing fails."""

import json

import numpy as np
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest

import scenarios.motion.recover as module
from fleet.errors import FleetError
from fleet.motion import RATE_HZ
from scenarios.motion.generate import Verification, generate
from scenarios.motion.recover import Recovery, save_generated, save_recovery


@pytest.fixture(scope="module")
def made(subject):
    asked = Verification.nominal(subject.arm.robot, 23.0)
    return generate(subject.twin, subject.arm, subject.jobs, s=0.5, count=2, verification=asked)


@pytest.fixture
def found():
    time_s = np.arange(0.0, 6.0, 2.0)
    warm = np.linspace(50.0, 53.0, 3)[:, None] + np.zeros(7)
    return Recovery(
        arm="arm",
        twin_version="abc",
        payload_kg=3.0,
        q_before=np.zeros(7),
        q_after=np.full(7, 0.1),
        origin="latent",
        hottest=1,
        difficulty_before=np.full(7, 0.9),
        difficulty_after=np.full(7, 0.4),
        tool_m=0.2,
        passed_over={"collision": 3},
        best_error={"latent": 1.0},
        time_s=time_s,
        without_c=warm,
        with_c=warm[::-1] - 3.0,
        error_rad=1e-4,
    )


@pytest.mark.parametrize("format", ["parquet", "csv"])
def test_motion_is_read_back_with_its_units(made, tmp_path, format):
    save_generated(made, tmp_path / "out", format=format)
    card = json.loads((tmp_path / "out" / "generated.json").read_text(encoding="utf-8"))
    assert card["handed_out"] == len(card["motions"]) == 2
    assert card["rejected"] == made.rejected
    for entry, motion in zip(card["motions"], made.motions, strict=True):
        path = tmp_path / "out" / entry["file"]
        table = pq.read_table(path) if format == "parquet" else pc.read_csv(path)
        whole = np.concatenate([phase.profile for phase in motion.plan.phases])
        for channel, pattern in enumerate(("q_{}_rad", "qd_{}_rad_s", "tau_{}_nm")):
            columns = np.stack([table[pattern.format(j + 1)].to_numpy() for j in range(7)], axis=1)
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


def test_a_failed_write_leaves_nothing(found, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "_write_card", full)
    with pytest.raises(OSError, match="No space left"):
        save_recovery(found, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_only_its_like_is_replaced_and_only_when_asked(found, made, tmp_path):
    save_recovery(found, tmp_path / "out")
    with pytest.raises(FleetError, match="holds a finished recovery"):
        save_recovery(found, tmp_path / "out")
    with pytest.raises(FleetError, match="holds other files"):
        save_generated(made, tmp_path / "out", overwrite=True)
    save_recovery(found, tmp_path / "out", format="csv", overwrite=True)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["recovery.csv", "recovery.json"]
