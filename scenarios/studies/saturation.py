"""Quality of P(saturation) and of its alarm, for the learned twin and for thermal networks.

All are fitted on labelled past jobs of one studied arm and judged on others. `python -m scenarios.studies.saturation
FOLDER 1 2 3` prints the figures of these seeds; trained twins are cached in the folder.
"""

import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_auc_score

from fleet.robot import ThermalLimits
from scenarios.prepare.simulated_history import PastJobs, experience, past_jobs
from scenarios.prepare.simulated_logs import LOGS, identify_from_work
from scenarios.progress import Progress, quiet
from scenarios.studies.ranking import spread
from scenarios.studies.setup import Bench, Study, make_study
from twin.saturation.alarm import ConformalAlarm
from twin.saturation.fit import Experience, fit_saturation
from twin.saturation.model import EVIDENCE, METHODS
from twin.saturation.reliability import Reliability, brier, reliability
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import score_of
from twin.vae.twin import Twin

Array = np.ndarray

LABELLED = 200
"""Past jobs that a model is fitted on; as many more set the alarm."""
HELD_OUT = 800
"""Past jobs that no model is fitted on."""
NOVEL = 200
"""Light novel motions."""
EXPLORATION = 80
"""Light motions among the twin's 200 training jobs."""
ALPHA = 0.05
PREDICTION_MEASURES = ("auroc", "brier", "ece", "peak_error_k")
ALARM_MEASURES = ("false_alarms", "false_novel", "caught")
UNLABELLED = ("sum", "joint_2", "load_max", "excess")
"""Scores of the twin alone, which know neither duration nor temperature."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """Quality of one method of predicting P(saturation), on held-out jobs."""

    name: str
    """Evidence and method of the learned twin, `rc nominal` or `rc identified`."""
    auroc: float
    brier: float
    table: Reliability
    peak_error_k: float = np.nan
    """Root mean square of predicted minus true peak of the hottest motor; NaN where no peak is predicted."""

    @property
    def ece(self) -> float:
        """Expected calibration error."""
        return self.table.error


@dataclass(frozen=True)
class Alarm:
    """Quality of an alarm on one score, set on jobs without saturation."""

    score: str
    """`p_` and the evidence, or a score of the twin alone."""
    false_alarms: float
    """Share of held-out jobs without saturation."""
    false_novel: float
    """Share of light novel motions."""
    caught: float
    """Share of held-out jobs with saturation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PastWork:
    """Past jobs of a studied arm; the natural mix is split into jobs to fit on, to set alarms, and to judge on."""

    study: Study
    seed: int
    jobs: PastJobs
    fit: Array
    """Indices of jobs, int [job], as are the following."""
    watched: Array
    held_out: Array
    novel: Array


def past_work(study: Study, *, seed: int, labelled: int = LABELLED, watched: int = LABELLED) -> PastWork:
    """Past jobs made of the study's test jobs and novel motions.

    Raises:
        ValueError: too few test jobs.
    """
    natural = len(study.test)
    if natural <= labelled + watched:
        raise ValueError(f"Past work needs more than {labelled} + {watched} test jobs (got {natural}).")
    # In one call, so that novel motions too begin as warm as natural work before them leaves the arm.
    plans = (*study.test.plans, *study.novel.plans)
    jobs = past_jobs(study.hardware, plans, np.random.default_rng([seed, 7]), limits=ThermalLimits())
    order = np.random.default_rng([seed, 8]).permutation(natural)
    fit, setting, rest = np.split(order, (labelled, labelled + watched))
    novel = np.arange(natural, len(jobs))
    return PastWork(study=study, seed=seed, jobs=jobs, fit=fit, watched=setting, held_out=rest, novel=novel)


def judge_twin(work: PastWork, twin: Twin) -> tuple[list[Prediction], list[Alarm]]:
    """Every prediction of saturation from a learned twin, and every alarm on its scores."""
    past = experience(twin, work.jobs)
    fit, setting, rest, novel = (past.part(rows) for rows in (work.fit, work.watched, work.held_out, work.novel))
    predictions, scores = [], dict[str, Callable[[Experience], Array]]()
    for evidence in EVIDENCE:
        for method in METHODS:
            model = fit_saturation(fit, evidence=evidence, method=method)
            p = model.risk(rest.features, rest.duration_s).at(rest.known_c)
            predictions.append(_judged(f"{evidence}, {method}", p, rest.passed))
        model = fit_saturation(fit, evidence=evidence)
        scores[f"p_{evidence}"] = lambda e, m=model: m.score(e.features, e.duration_s, e.known_c)
    scores |= {name: lambda e, n=name: score_of(e.features, n) for name in UNLABELLED}
    calm, critical, calm_novel = rest.part(~rest.passed), rest.part(rest.passed), novel.part(~novel.passed)
    alarms = []
    for name, score in scores.items():
        alarm = ConformalAlarm.fit(score(setting.part(~setting.passed)), ALPHA)
        shares = (float(alarm(score(jobs)).mean()) for jobs in (calm, calm_novel, critical))
        alarms.append(Alarm(name, *shares))
    return predictions, alarms


def judge_networks(work: PastWork) -> tuple[Prediction, Prediction]:
    """Prediction of the nominal thermal network, and of one identified from logs of some of the labelled jobs."""
    study, rng = work.study, np.random.default_rng([work.seed, 9])
    logged = [work.jobs.plans[i] for i in work.fit[:LOGS]]
    arm = identify_from_work(study.hardware, logged, rng, ambient_c=study.ambient_c)
    nominal = RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c)
    return _network("rc nominal", nominal, work), _network("rc identified", RcTwin.of(arm), work)


def _network(name: str, twin: RcTwin, work: PastWork) -> Prediction:
    jobs, fit, rest = work.jobs, work.fit, work.held_out
    plans, times = [jobs.plans[i] for i in fit], jobs.repetitions[fit].tolist()
    fitted = twin.with_past_jobs(plans, times, known_c=jobs.known_c[fit], peak_c=jobs.hottest_c[fit])
    forecasts = [fitted.peak(jobs.plans[i], int(jobs.repetitions[i])) for i in rest]
    p = np.array([float(each.at(known)) for each, known in zip(forecasts, jobs.known_c[rest], strict=True)])
    peak_c = np.array([float(each.value(known)) for each, known in zip(forecasts, jobs.known_c[rest], strict=True)])
    error_k = float(np.sqrt(np.mean((peak_c - jobs.hottest_c[rest]) ** 2)))
    return _judged(name, p, jobs.passed[rest], error_k)


def _judged(name: str, p: Array, passed: Array, peak_error_k: float = np.nan) -> Prediction:
    return Prediction(
        name=name,
        auroc=float(roc_auc_score(passed, p)),
        brier=brier(p, passed),
        table=reliability(p, passed),
        peak_error_k=peak_error_k,
    )


def saturation_study(
    bench: Bench, *, exploration: int, test: int, past: int = LABELLED, progress: Progress = quiet
) -> tuple[dict[str, list[Prediction]], dict[str, list[Alarm]]]:
    """Predictions by name and alarms by score, [seed].

    Args:
        exploration: Light motions among the training jobs.
        test: Past jobs in all.
        past: Past jobs that are fitted on; as many again set the alarm.
    """
    predictions, alarms = defaultdict[str, list[Prediction]](list), defaultdict[str, list[Alarm]](list)
    for done, (seed, study, twin) in enumerate(bench.studies(test=test, exploration=exploration)):
        progress("saturation", done / len(bench.seeds))
        work = past_work(study, seed=int(seed.entropy), labelled=past, watched=past)  # pyright: ignore[reportArgumentType]
        of_twin, raised = judge_twin(work, twin)
        for each in (*of_twin, *judge_networks(work)):
            predictions[each.name].append(each)
        for each in raised:
            alarms[each.score].append(each)
    return predictions, alarms


def measured(rows: Mapping[str, Sequence[object]], measures: Sequence[str]) -> dict[str, dict[str, list[float]]]:
    """Attributes of predictions or alarms: [name][measure] → [seed]."""
    return {name: {m: [getattr(each, m) for each in row] for m in measures} for name, row in rows.items()}


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of the seeds given after the folder, mean ± standard deviation over the seeds."""
    folder, *seeds = sys.argv[1:] if argv is None else argv
    sequences = [np.random.SeedSequence(int(seed)) for seed in seeds]
    bench = Bench(
        sequences, TwinConfig(max_windows=768, epochs=60, restarts=1), Path(folder), partial(make_study, novel=NOVEL)
    )
    for exploration in (0, EXPLORATION):
        results = saturation_study(bench, exploration=exploration, test=2 * LABELLED + HELD_OUT)
        for rows, measures in zip(results, (PREDICTION_MEASURES, ALARM_MEASURES), strict=True):
            print(f"exploration {exploration}: {', '.join(measures)}")
            for name, values in measured(rows, measures).items():
                print(f"  {name:20} " + "  ".join(spread(row) for row in values.values()))


if __name__ == "__main__":
    main()
