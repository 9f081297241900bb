"""Quality by amount of data, and the regressor beside the twin."""

import numpy as np
import pytest

from scenarios.json_rows import Rows
from scenarios.load import load
from scenarios.studies.sweep import parsimony as study
from scenarios.studies.sweep.subjects import Sizes, Subject
from twin.baselines.temperature import train_regressor
from twin.vae.config import TwinConfig


@pytest.mark.parametrize(
    ("quality", "jobs"),
    [
        ({5: 0.70, 10: 0.895, 20: 0.90, 40: 0.91}, 10),
        ({5: 0.95, 10: 0.85, 20: 0.94, 40: 0.95}, 20),  # by chance as good before: not yet the knee
        ({5: 0.5}, 5),
    ],
)
def test_the_knee_is_where_more_data_stops_to_help(quality, jobs):
    assert study.knee(quality) == jobs


def test_the_regressor_learns_heat_from_torque(make_heat_jobs):
    """The rise of joint 2 is its mean squared torque: a rule that the network can find, and a mean cannot."""
    plans, rise_k = make_heat_jobs(200)
    model = train_regressor(plans[:160], [1] * 160, rise_k[:160], TwinConfig(), 0, steps=150)
    error = model.predict(plans[160:], [1] * 40) - rise_k[160:]
    assert np.sqrt((error[:, 1] ** 2).mean()) < 0.6 * rise_k[160:, 1].std()
    with pytest.raises(ValueError, match="40 plans, 3 rows"):
        train_regressor(plans[:40], [1] * 40, rise_k[:3], TwinConfig(), 0, steps=1)


def test_rows_of_each_model_and_amount(monkeypatch, tmp_path):
    monkeypatch.setattr(study, "JOBS", (3, 6))
    monkeypatch.setattr(study, "STEPS", 3)
    subject = Subject(load("heat_wave"), 0, 1, Sizes(train=6, reference=25, test=60), carrier_only=True)
    rows = study.parsimony([subject], Rows(tmp_path / "rows.jsonl"))
    assert [(row["model"], row["jobs"]) for row in rows] == [(m, n) for n in (3, 6) for m in study.MODELS]
    assert all(0.0 <= row["auroc"] <= 1.0 for row in rows)
    assert rows[0]["minutes"] < rows[3]["minutes"]
    assert len(study.summary(rows)) == 6
    assert study.parsimony([subject], Rows(tmp_path / "rows.jsonl")) == rows


@pytest.fixture
def make_heat_jobs():
    from fleet.job import Place, Work
    from fleet.motion import Phase, Plan

    work = Work(kind="hold", places=(Place(name="bench", position_m=(0.4, 0.0, 0.3)),))
    empty = Phase(np.zeros((0, 3, 7), np.float32), np.zeros(0, np.float32))

    def make(count: int):
        rng = np.random.default_rng(0)
        plans, rises = [], []
        for _ in range(count):
            time = np.arange(400)[:, None] / 50.0
            size = rng.uniform(1.0, 20.0)
            tau = size * np.sin(2 * np.pi * (0.25 * time + rng.uniform(size=7)))
            profile = np.stack([0 * tau, 0 * tau, tau], axis=1).astype(np.float32)
            plans.append(Plan("arm", work, 0, 1.0, empty, Phase(profile, np.zeros(400, np.float32)), empty))
            rises.append(0.2 * (tau**2).mean(axis=0))
        return plans, np.array(rises)

    return make
