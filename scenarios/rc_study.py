"""P(saturation) of the physical twin, nominal and identified, on the jobs of `scenarios.saturation_study`.

`python -m scenarios.rc_study 1 2 3` prints the figures of these seeds.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.metrics import roc_auc_score

from scenarios.own_logs import AIR_SD_K, own_logs
from scenarios.past_jobs import PastJobs, past_jobs
from scenarios.saturation_study import HELD_OUT, LABELLED, NOVEL, WATCHED
from scenarios.study import Study, make_study
from twin.identify import identify
from twin.rc import RcTwin
from twin.reliability import Reliability, brier, reliability

Array = np.ndarray

LOGS = 6
"""Recordings of half an hour from which the arm is identified."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RcTrust:
    """How far the probability of one physical twin can be trusted, on held-out jobs."""

    seed: int
    name: str
    """nominal or identified."""
    share_passed: float
    auroc: float
    brier: float
    table: Reliability
    """With the expected calibration error."""
    peak_error_k: float
    """Root mean square of predicted minus true peak of the hottest motor, K."""


def rc_trust(study: Study, *, seed: int, labelled: int = LABELLED, watched: int = WATCHED) -> tuple[RcTrust, RcTrust]:
    """Nominal and identified; the same jobs, begun and split as `scenarios.saturation_study.trust` does.

    The arm is identified from logs of some of its labelled jobs. No twin knows the air of a job, only the study's.

    Raises:
        ValueError: no test jobs left to judge by.
    """
    natural = len(study.test)
    if natural <= labelled + watched:
        raise ValueError(f"This takes more than {labelled} + {watched} test jobs (got {natural}).")
    jobs = past_jobs(study, (*study.test.plans, *study.novel.plans), np.random.default_rng([seed, 7]))
    order = np.random.default_rng([seed, 8]).permutation(natural)
    learned, rest = order[:labelled], order[labelled + watched :]
    logs = own_logs(study, [jobs.plans[i] for i in learned[:LOGS]], np.random.default_rng([seed, 9]))
    arm = identify(logs, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K)
    nominal = RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c)
    return (
        _judged(nominal, jobs, learned, rest, seed, "nominal"),
        _judged(RcTwin.of(arm), jobs, learned, rest, seed, "identified"),
    )


def _judged(twin: RcTwin, jobs: PastJobs, learned: Array, rest: Array, seed: int, name: str) -> RcTrust:
    plans, times = [jobs.plans[i] for i in learned], jobs.repetitions[learned].tolist()
    taught = twin.learned(plans, times, temp_c=jobs.measured_c[learned], passed=jobs.passed[learned])
    plans, times, temp_c = [jobs.plans[i] for i in rest], jobs.repetitions[rest].tolist(), jobs.measured_c[rest]
    p = np.array([float(taught.risk(*job).at(t)) for *job, t in zip(plans, times, temp_c, strict=True)])
    peak = twin.peaks(plans, times, start_c=twin.likely_start(temp_c)).max(axis=1)
    passed = jobs.passed[rest]
    return RcTrust(
        seed=seed,
        name=name,
        share_passed=float(passed.mean()),
        auroc=float(roc_auc_score(passed, p)),
        brier=brier(p, passed),
        table=reliability(p, passed),
        peak_error_k=float(np.sqrt(np.mean((peak - jobs.peak_c[rest].max(axis=1)) ** 2))),
    )


def lines(found: Sequence[tuple[RcTrust, RcTrust]]) -> list[str]:
    """The figures as text, mean ± standard deviation over seeds."""
    said = [f"seeds {', '.join(str(pair[0].seed) for pair in found)}", f"{'rc':12} AUROC  Brier  ECE  peak error K"]
    for row in zip(*found, strict=True):
        figures = [[t.auroc for t in row], [t.brier for t in row], [t.table.error for t in row]]
        figures.append([t.peak_error_k for t in row])
        said.append(f"{row[0].name:12} " + "  ".join(f"{np.mean(v):.3f} ± {np.std(v):.3f}" for v in figures))
    return said


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of the seeds given."""
    found = []
    for seed in map(int, sys.argv[1:] if argv is None else argv):
        print(f"seed {seed}", file=sys.stderr, flush=True)
        size = LABELLED + WATCHED + HELD_OUT
        study = make_study(np.random.SeedSequence(seed), train=0, reference=0, test=size, novel=NOVEL)
        found.append(rc_trust(study, seed=seed))
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
