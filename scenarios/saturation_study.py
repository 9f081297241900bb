"""How far P(saturation) and its alarm can be trusted: fitted on labelled past jobs of a studied arm, judged on others.

`python -m scenarios.saturation_study FOLDER 1 2 3` prints the figures of these seeds; trained twins stay in the folder.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_auc_score

from scenarios.past_jobs import PastJobs, past_jobs
from scenarios.rehearse import trained
from scenarios.study import Study, make_study
from twin.alarm import ConformalAlarm
from twin.calibrate import Experience, fit_saturation
from twin.measures import score_of
from twin.model import TwinConfig
from twin.reliability import Reliability, brier, reliability
from twin.saturation import EVIDENCE, METHODS, Evidence, Method
from twin.score import Twin

Array = np.ndarray

LABELLED = 200
"""Past jobs that a model learns from."""
WATCHED = 200
"""Further past jobs; those of them that went well set the alarm."""
HELD_OUT = 800
"""Past jobs of the natural mix that nothing was fitted on."""
NOVEL = 200
"""Light novel motions."""
EXPLORATION = 80
"""Light motions among the twin's 200 training jobs."""
ALPHA = 0.05
UNLABELLED = ("sum", "joint_2", "load_max", "excess")
"""Scores of the twin alone, which know neither duration nor temperature."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stated:
    """One way to state P(saturation), on held-out jobs."""

    evidence: Evidence
    method: Method
    auroc: float
    brier: float
    table: Reliability
    """With the expected calibration error."""
    p: Array
    """[job]."""
    passed: Array
    """bool [job]."""


@dataclass(frozen=True, kw_only=True)
class Alarmed:
    """An alarm on one score, set on jobs that went well."""

    score: str
    """`p_` and the evidence, or a score of the twin alone."""
    false_alarms: float
    """Share of held-out jobs of the natural mix that went well."""
    expected: tuple[float, float]
    """Where that share lies for nine calibrations of ten."""
    false_novel: float
    """Share of light novel motions."""
    caught: float
    """Share of held-out jobs in which a motor passed the limit."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trust:
    """What one twin's probabilities and alarms are worth."""

    seed: int
    exploration: int
    """Light motions among the twin's training jobs."""
    share_passed: float
    """Of the held-out jobs."""
    stated: tuple[Stated, ...]
    alarms: tuple[Alarmed, ...]


def saturation_study(
    seeds: Sequence[int],
    *,
    config: TwinConfig,
    folder: Path,
    make: Callable[..., Study] = make_study,
    explorations: Sequence[int] = (0, EXPLORATION),
    labelled: int = LABELLED,
    watched: int = WATCHED,
    held_out: int = HELD_OUT,
    novel: int = NOVEL,
    progress: Callable[[str], None] = lambda stage: None,
) -> list[Trust]:
    """Both questions for arms, jobs and twins of several seeds, each with and without exploration.

    Args:
        folder: Where trained twins are kept.
        make: Makes the study of a seed, as `make_study`.
    """
    found = []
    for seed in seeds:
        for exploration in explorations:
            progress(f"seed {seed}, exploration {exploration}")
            entropy = np.random.SeedSequence(seed)
            study = make(entropy, test=labelled + watched + held_out, novel=novel, exploration=exploration)
            twin = trained(study.train.records(), config, entropy, arm=study.robot.name, folder=folder)
            found.append(trust(study, twin, seed=seed, exploration=exploration, labelled=labelled, watched=watched))
    return found


def trust(
    study: Study,
    twin: Twin,
    *,
    seed: int,
    exploration: int,
    labelled: int = LABELLED,
    watched: int = WATCHED,
) -> Trust:
    """What the probabilities and alarms of a twin are worth; of the test jobs the first two kinds are set aside.

    Args:
        labelled: Past jobs that the models learn from.
        watched: Past jobs that set the alarms.

    Raises:
        ValueError: no test jobs left to judge by.
    """
    natural = len(study.test)
    if natural <= labelled + watched:
        raise ValueError(f"This takes more than {labelled} + {watched} test jobs (got {natural}).")
    # In one call, so that novel motions too begin as warm as natural work before them leaves the arm.
    begun, split = np.random.default_rng([seed, 7]), np.random.default_rng([seed, 8])
    jobs = past_jobs(study, (*study.test.plans, *study.novel.plans), begun)
    past = seen(twin, jobs)
    order = split.permutation(natural)
    learned, setting, rest = (past.part(rows) for rows in np.split(order, (labelled, labelled + watched)))
    novel = past.part(np.arange(natural, len(past)))
    kinds: list[tuple[Evidence, Method]] = [(evidence, method) for evidence in EVIDENCE for method in METHODS]
    return Trust(
        seed=seed,
        exploration=exploration,
        share_passed=float(rest.passed.mean()),
        stated=tuple(_stated(learned, rest, evidence, method) for evidence, method in kinds),
        alarms=tuple(_alarmed(name, score, setting, rest, novel) for name, score in _scores(learned)),
    )


def seen(twin: Twin, jobs: PastJobs) -> Experience:
    """Past jobs as the arm's twin saw them."""
    times = jobs.repetitions.tolist()
    return Experience.of_jobs(twin, jobs.plans, times, temp_c=jobs.measured_c, passed=jobs.passed)


def _stated(learned: Experience, rest: Experience, evidence: Evidence, method: Method) -> Stated:
    model = fit_saturation(learned, evidence=evidence, method=method)
    p = model.risk(rest.features, rest.duration_s).at(rest.temp_c)
    return Stated(
        evidence=evidence,
        method=method,
        auroc=float(roc_auc_score(rest.passed, p)),
        brier=brier(p, rest.passed),
        table=reliability(p, rest.passed),
        p=p,
        passed=rest.passed,
    )


Score = Callable[[Experience], Array]


def _scores(learned: Experience) -> list[tuple[str, Score]]:
    """By name; the models are fitted on `learned`."""
    found: list[tuple[str, Score]] = []
    for evidence in EVIDENCE:
        model = fit_saturation(learned, evidence=evidence)
        found.append((f"p_{evidence}", lambda e, m=model: m.score(e.features, e.duration_s, e.temp_c)))
    return found + [(name, lambda e, n=name: score_of(e.features, n)) for name in UNLABELLED]


def _alarmed(name: str, score: Score, setting: Experience, rest: Experience, novel: Experience) -> Alarmed:
    alarm = ConformalAlarm.fit(score(setting.part(~setting.passed)), ALPHA)
    return Alarmed(
        score=name,
        false_alarms=float(alarm(score(rest.part(~rest.passed))).mean()),
        expected=alarm.spread(),
        false_novel=float(alarm(score(novel.part(~novel.passed))).mean()),
        caught=float(alarm(score(rest.part(rest.passed))).mean()),
    )


def lines(found: Sequence[Trust]) -> list[str]:
    """The figures as text, mean ± standard deviation over seeds."""
    said = []
    for exploration in dict.fromkeys(each.exploration for each in found):
        some = [each for each in found if each.exploration == exploration]
        passed = ", ".join(f"{each.share_passed:.0%}" for each in some)
        seeds = ", ".join(str(each.seed) for each in some)
        said.append(f"exploration {exploration}, seeds {seeds}, passed the limit: {passed}")
        said.append(f"  {'P(saturation)':20} AUROC         Brier         ECE")
        for row in zip(*(each.stated for each in some), strict=True):
            figures = [[s.auroc for s in row], [s.brier for s in row], [s.table.error for s in row]]
            said.append(f"  {row[0].evidence + ' ' + row[0].method:20} " + "  ".join(map(_figure, figures)))
        said.append(f"  {'alarm on':20} false alarms  false novel   caught")
        for row in zip(*(each.alarms for each in some), strict=True):
            figures = [[a.false_alarms for a in row], [a.false_novel for a in row], [a.caught for a in row]]
            said.append(f"  {row[0].score:20} " + "  ".join(map(_figure, figures)))
    return said


def _figure(values: Sequence[float]) -> str:
    return f"{np.mean(values):.3f} ± {np.std(values):.3f}"


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of the seeds given after the folder."""
    folder, *numbers = sys.argv[1:] if argv is None else argv
    found = saturation_study(
        [int(number) for number in numbers],
        config=TwinConfig.quick(),
        folder=Path(folder),
        progress=lambda stage: print(stage, file=sys.stderr, flush=True),
    )
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
