"""How much data a twin needs, beside an LSTM regressor of temperature that is trained on as many jobs.

The twin sees cool jobs without labels. The regressor needs the temperature that each job leads to; one is trained on
the same cool jobs, one on jobs of any heat, which a plant can only collect by overheating its arm.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import msgspec
import numpy as np

from fleet.motion import RATE_HZ
from scenarios.evaluate.statistics import mean_by_group
from scenarios.json_rows import Row, Rows
from scenarios.prepare.cool_motion import records
from scenarios.progress import Count, Progress, quiet
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.detection_metrics import detection
from scenarios.studies.ranking import LABELS, RANKING
from scenarios.studies.setup import Study
from scenarios.studies.sweep.configurations import BASE
from scenarios.studies.sweep.subjects import Subject, arm_of, carrier_of
from twin.baselines.temperature import train_regressor
from twin.vae.train import train
from twin.vae.training_key import RECIPE
from twin.vae.window import windows_of

Array = np.ndarray

JOBS = (3, 5, 10, 20, 40, 80, 160)
STEPS = 120
"""Steps of the optimiser for every amount of data, as many as the quick size takes with all windows."""
TWIN, LSTM_COOL, LSTM_ANY = "twin", "LSTM, same cool jobs", "LSTM, jobs of any heat"
MODELS = (TWIN, LSTM_COOL, LSTM_ANY)
KNEE = 0.02
"""The knee is the least data whose measure is within this of that with most."""


def parsimony(
    subjects: Sequence[Subject], rows: Rows, *, compute: bool = True, progress: Progress = quiet
) -> list[Row]:
    """Append the missing rows, one for each subject, number of jobs and model; return all of them.

    Args:
        compute: Whether to compute missing rows; else those in the file are returned.

    Raises:
        FleetError: all test jobs of a subject are critical, or none is.
    """
    if compute:
        rows.check_writable()
    wanted: list[str] = []
    for done, subject in enumerate(subjects):
        progress("computing data parsimony", Count(done, len(subjects)))
        keys = {(model, jobs): _key(model, jobs, subject) for jobs in JOBS for model in MODELS}
        wanted += keys.values()
        if not compute or all(key in rows for key in keys.values()):
            continue
        study, hot = subject.study(), subject.any_motion()
        for (model, jobs), key in keys.items():
            if key not in rows:
                card = {"model": model, "jobs": jobs, "subject": subject.name}
                rows.append(key, card | _row(model, jobs, subject, study, hot))
    progress("computing data parsimony", 1.0)
    return rows.some(wanted)


def _key(model: str, jobs: int, subject: Subject) -> str:
    basis = [RECIPE, STEPS, msgspec.to_builtins(BASE), asdict(subject.sizes)]
    return f"{model}/{jobs}/{subject.name}/{hashlib.sha256(msgspec.json.encode(basis)).hexdigest()[:12]}"


def _row(model: str, jobs: int, subject: Subject, study: Study, hot: Study) -> Row:
    """Quality of d of the carrying joint, or of its predicted rise, and the minutes of motion in training."""
    carrier = carrier_of(study)
    sample = (hot if model == LSTM_ANY else study).train
    plans, known = sample.plans[:jobs], records(sample.plans[:jobs])
    test, reference = jobs_of(study.test, study.horizon_s), jobs_of(study.reference, study.horizon_s)
    if model == TWIN:
        windows = min(BASE.max_windows, len(windows_of(known, BASE)))
        config = replace(BASE, epochs=max(1, round(STEPS / -(-windows // BASE.batch))))
        twin = train(records(subject.seen(plans, carrier)), config, subject.entropy, arm=subject.name)
        scores = [
            twin.features(subject.seen(each.plans, carrier), each.repetitions).difficulty[:, carrier]
            for each in (test, reference)
        ]
    else:
        times = jobs_of(sample, study.horizon_s).repetitions[:jobs]
        seed = int(subject.entropy.generate_state(1)[0])
        rise_k = sample.peak_c[:jobs] - study.ambient_c
        regressor = train_regressor(plans, times, rise_k, BASE, seed, steps=STEPS)
        scores = [regressor.predict(each.plans, each.repetitions)[:, carrier] for each in (test, reference)]
    peak_c = test.peak_c[:, carrier]
    found = detection(scores[0], peak_c, reference=scores[1], novel=np.zeros(0), limit_c=study.warning_c)
    minutes = sum(map(len, known)) / RATE_HZ / 60
    return {"minutes": round(minutes, 2), **{measure: round(getattr(found, measure), 4) for measure in RANKING}}


HEADS = ("model", "jobs", "minutes of motion", "AUROC", "AUPRC", "Spearman", "knee of")


def summary(rows: Sequence[Row]) -> list[list[str]]:
    """A line for each model and number of jobs: means over the arms ± the 95 % margin, and the knees."""
    lines = []
    for model in MODELS:
        by_jobs = {jobs: [row for row in rows if (row["model"], row["jobs"]) == (model, jobs)] for jobs in JOBS}
        present = {jobs: some for jobs, some in by_jobs.items() if some}
        knees = {measure: knee({jobs: _mean(some, measure) for jobs, some in present.items()}) for measure in RANKING}
        for jobs, some in present.items():
            found = [mean_by_group((arm_of(row["subject"]), row[measure]) for row in some) for measure in RANKING]
            cells = [f"{each.mean:.3f}" + f" ± {each.margin:.3f}" * (not each.note) for each in found]
            reached = ", ".join(LABELS[measure] for measure in RANKING if knees[measure] == jobs)
            lines.append([model, str(jobs), f"{_mean(some, 'minutes'):.1f}", *cells, reached])
    return lines


def knee(quality: Mapping[int, float]) -> int:
    """The least number of jobs from which on the quality stays within `KNEE` of that with most jobs."""
    wanted = quality[max(quality)] - KNEE
    short = [jobs for jobs, value in quality.items() if value < wanted]
    return min(jobs for jobs in quality if jobs > max(short, default=0))


def _mean(rows: Sequence[Row], measure: str) -> float:
    return float(np.mean([row[measure] for row in rows]))
