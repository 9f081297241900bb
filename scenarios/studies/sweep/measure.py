"""Train every configuration on every subject, side by side, and measure how its difficulty ranks jobs."""

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import msgspec
import numpy as np

from scenarios.json_rows import Row, Rows
from scenarios.prepare.cool_motion import records
from scenarios.progress import Count, Progress, quiet
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.detection_metrics import detection
from scenarios.studies.ranking import RANKING, Jobs
from scenarios.studies.setup import Study
from scenarios.studies.sweep.configurations import Configuration
from scenarios.studies.sweep.subjects import Subject, carrier_of
from twin.vae.config import TwinConfig
from twin.vae.train import Motion, train_all
from twin.vae.training_key import RECIPE
from twin.vae.twin import Twin

Array = np.ndarray

LABELS = {"hot_60": "60 °C", "hot_40": "40 °C", "no_band": "60 °C, without jobs of 40 to 60 °C"}
"""Which peak makes a job hot, by the names in a row; the others are cool, but `no_band` drops those in between."""
SCORES = ("carrier", "weighted", "sum", "sum_of_means")
"""d of the carrying joint, for its own peak; for the hottest joint Σ w_k d_k, Σ d_k, and Σ d_k with |error| averaged
over the channels instead of summed."""


def sweep(
    subjects: Sequence[Subject],
    configurations: Mapping[str, Configuration],
    rows: Rows,
    *,
    compute: bool = True,
    progress: Progress = quiet,
) -> list[Row]:
    """Append the missing rows to the file; return those of all these configurations and subjects.

    Args:
        compute: Whether to compute missing rows; else those in the file are returned.

    Raises:
        FleetError: all jobs of a subject are critical, or none is.
        Diverged: a training ended without finite weights.
    """
    if compute:
        rows.check_writable()
    studies: dict[str, Study] = {}
    wanted: list[str] = []
    for done, (name, configuration) in enumerate(configurations.items()):
        progress("sweeping", Count(done, len(configurations)))
        keys = {key_of(name, configuration.config, subject): subject for subject in subjects}
        missing = {key: subject for key, subject in keys.items() if key not in rows and compute}
        wanted += keys
        for subject in missing.values():
            if subject.name not in studies:
                studies[subject.name] = subject.study()
        if not missing:
            continue
        motions = [_motion(subject, studies[subject.name], configuration) for subject in missing.values()]
        start_s = time.process_time()
        twins = train_all(motions, configuration.config)
        cpu_s = (time.process_time() - start_s) / len(twins)
        for (key, subject), twin in zip(missing.items(), twins, strict=True):
            row: Row = {
                "configuration": name,
                "subject": subject.name,
                **measures(twin, subject, studies[subject.name]),
            }
            rows.append(key, row | {"epochs": configuration.config.epochs, "cpu_s": round(cpu_s, 2)})
    progress("sweeping", 1.0)
    return rows.some(wanted)


def key_of(name: str, config: TwinConfig, subject: Subject) -> str:
    """Key of a row: equal keys mean equal results."""
    basis = [RECIPE, msgspec.to_builtins(config), asdict(subject.sizes), subject.carrier_only]
    return f"{name}/{subject.name}/{hashlib.sha256(msgspec.json.encode(basis)).hexdigest()[:12]}"


def _motion(subject: Subject, study: Study, configuration: Configuration) -> Motion:
    source = study if configuration.data == "cool" else subject.any_motion()
    plans = subject.seen(source.train.plans, carrier_of(study))
    return Motion(arm=subject.name, records=records(plans), seed=subject.entropy)


def measures(twin: Twin, subject: Subject, study: Study) -> Row:
    """How the twin's scores rank the test jobs: [label][score][measure]; and how the training went, carrier first."""
    carrier = carrier_of(study)
    test, reference = jobs_of(study.test, study.horizon_s), jobs_of(study.reference, study.horizon_s)
    of_test, of_reference = (_scores(twin, subject, jobs, carrier) for jobs in (test, reference))
    own, hottest = test.peak_c[:, carrier], test.peak_c.max(axis=1)
    row: Row = {"carrier": carrier + 1}
    for label in LABELS:
        row[label] = {}
        for score in of_test:
            peak_c = own if score == "carrier" else hottest
            limit_c = study.cool_c if label == "hot_40" else study.warning_c
            kept = (peak_c < study.cool_c) | (peak_c >= study.warning_c) if label == "no_band" else peak_c == peak_c
            found = detection(
                of_test[score][kept],
                peak_c[kept],
                reference=of_reference[score],
                novel=np.zeros(0),
                limit_c=limit_c,
            )
            row[label][score] = {measure: round(getattr(found, measure), 4) for measure in (*RANKING, "caught")}
    fits = [twin.fits[min(carrier, len(twin.fits) - 1)], *twin.fits]
    row["kl"], row["active_units"], row["mse"] = (
        [round(getattr(fit, name), 3) for fit in fits] for name in ("kl", "active_units", "mean_squared_error")
    )
    return row


def _scores(twin: Twin, subject: Subject, jobs: Jobs, carrier: int) -> dict[str, Array]:
    """By the names of `SCORES`."""
    features = twin.features(subject.seen(jobs.plans, carrier), jobs.repetitions)
    if subject.carrier_only:
        return {"carrier": features.difficulty[:, carrier]}
    means = 1.0 - np.exp(-features.errors.mean(axis=-1))
    d = features.difficulty
    values = d[:, carrier], d @ twin.joint_weight, d.sum(axis=1), means.sum(axis=1)
    return dict(zip(SCORES, values, strict=True))
