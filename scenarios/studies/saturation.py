"""How far P(saturation) and its alarm can be trusted, of the learned twin and of thermal networks.

All are fitted on labelled past jobs of one studied arm and judged on others. `python -m scenarios.studies.saturation
FOLDER 1 2 3` prints the figures of these seeds; trained twins are cached in the folder.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_auc_score

from scenarios.prepare.simulated_history import PastJobs, experience, past_jobs
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.ranking import spread
from scenarios.studies.setup import Study, make_study
from scenarios.studies.simulated_logs import AIR_SD_K, own_logs
from twin.saturation.alarm import ConformalAlarm
from twin.saturation.fit import Experience, fit_saturation
from twin.saturation.model import EVIDENCE, METHODS
from twin.saturation.reliability import Reliability, brier, reliability
from twin.thermal.identify import identify
from twin.thermal.thermal_twin import RcTwin
from twin.vae.measures import score_of
from twin.vae.model import TwinConfig
from twin.vae.twin import Twin

Array = np.ndarray

LABELLED = 200
"""Past jobs that a model is fitted on."""
WATCHED = 200
"""Further past jobs; those without saturation set the alarm."""
HELD_OUT = 800
"""Past jobs that nothing is fitted on."""
NOVEL = 200
"""Light novel motions."""
EXPLORATION = 80
"""Light motions among the twin's 200 training jobs."""
LOGS = 6
"""Recordings of half an hour from which the thermal network of the arm is identified."""
ALPHA = 0.05
UNLABELLED = ("sum", "joint_2", "load_max", "excess")
"""Scores of the twin alone, which know neither duration nor temperature."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """Quality of one way to predict P(saturation), on held-out jobs."""

    name: str
    """Evidence and method of the learned twin, `rc nominal` or `rc identified`."""
    auroc: float
    brier: float
    table: Reliability
    """With the expected calibration error."""
    peak_error_k: float | None = None
    """Root mean square of predicted minus true peak of the hottest motor; None where no peak is predicted."""


@dataclass(frozen=True, kw_only=True)
class Alarm:
    """Quality of an alarm on one score, set on jobs without saturation."""

    score: str
    """`p_` and the evidence, or a score of the twin alone."""
    false_alarms: float
    """Share of held-out jobs without saturation."""
    expected: tuple[float, float]
    """Range of that share for nine calibrations of ten."""
    false_novel: float
    """Share of light novel motions."""
    caught: float
    """Share of held-out jobs with saturation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PastWork:
    """Past jobs of a studied arm; the natural ones split into those to fit on, to set alarms, and to judge on."""

    study: Study
    seed: int
    jobs: PastJobs
    fit: Array
    """Indices of jobs, int [job], as are the following."""
    watched: Array
    held_out: Array
    novel: Array

    @property
    def share_passed(self) -> float:
        """Share of the held-out jobs with saturation."""
        return float(self.jobs.passed[self.held_out].mean())


def past_work(study: Study, *, seed: int, labelled: int = LABELLED, watched: int = WATCHED) -> PastWork:
    """Past jobs made of the study's test jobs and novel motions.

    Raises:
        ValueError: no test jobs are left to judge on.
    """
    natural = len(study.test)
    if natural <= labelled + watched:
        raise ValueError(f"This takes more than {labelled} + {watched} test jobs (got {natural}).")
    # In one call, so that novel motions too begin as warm as natural work before them leaves the arm.
    plans = (*study.test.plans, *study.novel.plans)
    jobs = past_jobs(study.hardware, plans, np.random.default_rng([seed, 7]), warning_c=study.warning_c)
    order = np.random.default_rng([seed, 8]).permutation(natural)
    fit, setting, rest = np.split(order, (labelled, labelled + watched))
    novel = np.arange(natural, len(jobs))
    return PastWork(study=study, seed=seed, jobs=jobs, fit=fit, watched=setting, held_out=rest, novel=novel)


def judge_twin(work: PastWork, twin: Twin) -> tuple[list[Prediction], list[Alarm]]:
    """Every way in which a learned twin predicts saturation, and every alarm on its scores."""
    past = experience(twin, work.jobs)
    fit, setting, rest, novel = (past.part(rows) for rows in (work.fit, work.watched, work.held_out, work.novel))
    predictions, scores = [], dict[str, Callable[[Experience], Array]]()
    for evidence in EVIDENCE:
        for method in METHODS:
            model = fit_saturation(fit, evidence=evidence, method=method)
            p = model.risk(rest.features, rest.duration_s).at(rest.temp_c)
            predictions.append(_judged(f"{evidence}, {method}", p, rest.passed))
        model = fit_saturation(fit, evidence=evidence)
        scores[f"p_{evidence}"] = lambda e, m=model: m.score(e.features, e.duration_s, e.temp_c)
    scores |= {name: lambda e, n=name: score_of(e.features, n) for name in UNLABELLED}
    alarms = []
    for name, score in scores.items():
        alarm = ConformalAlarm.fit(score(setting.part(~setting.passed)), ALPHA)
        alarms.append(
            Alarm(
                score=name,
                false_alarms=float(alarm(score(rest.part(~rest.passed))).mean()),
                expected=alarm.spread(),
                false_novel=float(alarm(score(novel.part(~novel.passed))).mean()),
                caught=float(alarm(score(rest.part(rest.passed))).mean()),
            )
        )
    return predictions, alarms


def judge_networks(work: PastWork) -> tuple[Prediction, Prediction]:
    """Prediction of the nominal thermal network, and of one identified from logs of some of the labelled jobs.

    Neither knows the ambient temperature of a job, only that of the study.
    """
    study, jobs = work.study, work.jobs
    logs = own_logs(study, [jobs.plans[i] for i in work.fit[:LOGS]], np.random.default_rng([work.seed, 9]))
    arm = identify(logs, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K)
    nominal = RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c)
    return _network("rc nominal", nominal, work), _network("rc identified", RcTwin.of(arm), work)


def _network(name: str, twin: RcTwin, work: PastWork) -> Prediction:
    jobs, fit, rest = work.jobs, work.fit, work.held_out
    plans, times = [jobs.plans[i] for i in fit], jobs.repetitions[fit].tolist()
    fitted = twin.with_past_jobs(plans, times, temp_c=jobs.measured_c[fit], passed=jobs.passed[fit])
    plans, times, temp_c = [jobs.plans[i] for i in rest], jobs.repetitions[rest].tolist(), jobs.measured_c[rest]
    p = np.array([float(fitted.risk(*job).at(t)) for *job, t in zip(plans, times, temp_c, strict=True)])
    peak_c = twin.peaks(plans, times, start_c=twin.likely_start(temp_c)).max(axis=1)
    error_k = float(np.sqrt(np.mean((peak_c - jobs.peak_c[rest].max(axis=1)) ** 2)))
    return _judged(name, p, jobs.passed[rest], error_k)


def _judged(name: str, p: Array, passed: Array, peak_error_k: float | None = None) -> Prediction:
    return Prediction(
        name=name,
        auroc=float(roc_auc_score(passed, p)),
        brier=brier(p, passed),
        table=reliability(p, passed),
        peak_error_k=peak_error_k,
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of the seeds given after the folder, mean ± standard deviation over the seeds."""
    folder, *numbers = sys.argv[1:] if argv is None else argv
    config, size = TwinConfig.quick(), LABELLED + WATCHED + HELD_OUT
    for exploration in (0, EXPLORATION):
        predictions, alarms = list[list[Prediction]](), list[list[Alarm]]()
        for number in numbers:
            print(f"seed {number}, exploration {exploration}", file=sys.stderr, flush=True)
            entropy = np.random.SeedSequence(int(number))
            study = make_study(entropy, test=size, novel=NOVEL, exploration=exploration)
            twin = train_or_load(study.train.records(), config, entropy, arm=study.robot.name, folder=Path(folder))
            work = past_work(study, seed=int(number))
            stated, raised = judge_twin(work, twin)
            predictions.append([*stated, *judge_networks(work)])
            alarms.append(raised)
        print(f"exploration {exploration}: AUROC, Brier, ECE, error of the peak in K")
        for row in zip(*predictions, strict=True):
            columns = [[p.auroc, p.brier, p.table.error, p.peak_error_k or np.nan] for p in row]
            print(f"  {row[0].name:20} " + "  ".join(spread(values) for values in np.transpose(columns)))
        print("  alarm on: false alarms, false on novel motions, caught")
        for row in zip(*alarms, strict=True):
            columns = [[a.false_alarms, a.false_novel, a.caught] for a in row]
            print(f"  {row[0].score:20} " + "  ".join(spread(values) for values in np.transpose(columns)))


if __name__ == "__main__":
    main()
