"""How well d and other scores of the same motion rank jobs by whether a motor overheats: `quality`.

Every score is judged on the same jobs: d of the twin and of networks that learned nothing, squared torque above the
reconstruction, RMS torque, distances to cool motion, and thermal networks, which alone use motor data.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import StandardScaler

from benchmarks.paper.harness import seeded, table_of
from benchmarks.paper.subjects import CARRIER, LABELS, Jobs, Study, cached_twin, detection, jobs_of, usual_study
from fleet.motion import CHANNELS, Plan
from scenarios.json_rows import Row
from scenarios.prepare.identify import SIMULATED_LOGS, identify_from_work
from scenarios.table import Table
from twin.baselines import torque_over_known, untrained_config
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import Features
from twin.vae.twin import Twin
from twin.vae.window import Scaler, check_jobs, cut_jobs, draw_windows, windows_of

Array = np.ndarray

CONFIG = TwinConfig(max_windows=768, epochs=60, restarts=1, hidden=32).changed(window=50)
"""Windows of 4 s, the default at the time of the stored figures."""
NEIGHBOURS = 5
CHUNK = 256
"""Jobs read at a time."""


@dataclass(frozen=True)
class QualitySize:
    """Numbers of jobs, and epochs of each training."""

    train: int = 200
    reference: int = 200
    test: int = 1200
    novel: int = 300
    epochs: int = 60

    @property
    def config(self) -> TwinConfig:
        """Of the twins; a collapse is a result too."""
        return replace(CONFIG, epochs=self.epochs, allow_collapse=True)


Scorer = Callable[[Sequence[Plan], Sequence[int]], Array]
"""Score of each joint, larger for harder jobs, [job, joint], of plans and their repetitions."""
WORST = ("RMS torque / known", "rc nominal", "rc identified")
"""Scorers whose total is that of the worst joint; that of others is the sum over joints."""


def collapsed_config(config: TwinConfig) -> TwinConfig:
    """A VAE whose loss is the mean instead of the sum of squares: the KL outweighs it and the posterior collapses.

    mean (x − x̂)² + KL is ½ Σ (x − x̂)² + β·KL with β = samples · channels / 2, up to a factor.
    """
    return replace(config, beta=config.window * len(CHANNELS) / 2, restarts=1, allow_collapse=True)


def twin_scorer(twin: Twin, of_features: Callable[[Features], Array]) -> Scorer:
    """A score from features of jobs."""
    return lambda plans, repetitions: of_features(twin.features(plans, repetitions))


def window_statistics(windows: Array) -> Array:
    """18 statistics of each joint, [batch, joint, feature], of windows [batch, time, joint, channel].

    Mean, standard deviation, RMS, least and largest value, and mean absolute difference from one sample to the next, of
    each channel.

    Raises:
        ValueError: windows of another shape, or of fewer than two samples.
    """
    if windows.ndim != 4 or windows.shape[1] < 2 or windows.shape[3] != len(CHANNELS):
        raise ValueError(f"Windows must be [batch, time >= 2, joint, {len(CHANNELS)}] (got {windows.shape}).")
    x = np.asarray(windows, dtype=float)
    rms, step = np.sqrt(np.square(x).mean(axis=1)), np.abs(np.diff(x, axis=1)).mean(axis=1)
    return np.concatenate([x.mean(axis=1), x.std(axis=1), rms, x.min(axis=1), x.max(axis=1), step], axis=-1)


def neighbour_scorer(records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence) -> Scorer:
    """Mean distance to the nearest training windows (Ramaswamy et al., SIGMOD 2000, mean instead of the last)."""
    windows = draw_windows(windows_of(records, config), TwinConfig().max_windows, seed)
    scaler, fitted = Scaler.fit(windows), list[tuple[StandardScaler, NearestNeighbors]]()
    for x in np.moveaxis(window_statistics(scaler.to_z(windows)), 1, 0):
        scale = StandardScaler().fit(x)
        fitted.append((scale, NearestNeighbors(n_neighbors=NEIGHBOURS).fit(np.asarray(scale.transform(x)))))

    def score(plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        check_jobs(plans, repetitions)
        parts = list[Array]()
        for first in range(0, len(plans), CHUNK):
            jobs = cut_jobs(plans[first : first + CHUNK], repetitions[first : first + CHUNK], config)
            features = np.moveaxis(window_statistics(scaler.to_z(jobs.windows)), 1, 0)
            columns = [
                index.kneighbors(np.asarray(scale.transform(x)))[0].mean(axis=1)
                for (scale, index), x in zip(fitted, features, strict=True)
            ]
            parts.append(jobs.mean(np.stack(columns, axis=1)[:, None]))
        return np.concatenate(parts)

    return score


def thermal_scorer(network: RcTwin) -> Scorer:
    """Difficulty by a thermal network."""

    def score(plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        check_jobs(plans, repetitions)
        found = [network.score(plan, times) for plan, times in zip(plans, repetitions, strict=True)]
        if unknown := [i for i, each in enumerate(found) if each is None]:
            raise ValueError(f"The thermal network has no score for job {unknown[0]}.")
        return np.stack([each.per_joint for each in found if each is not None])

    return score


def scorers_of(study: Study, config: TwinConfig, seed: np.random.SeedSequence) -> dict[str, Scorer]:
    """Every score by its name; thermal networks are nominal or identified from the arm's logs, not its truth."""
    motion, rng = study.train.records(), np.random.default_rng(seed)
    torque = torque_over_known(motion)
    twin, untrained, collapsed = (
        cached_twin(motion, each, seed) for each in (config, untrained_config(config), collapsed_config(config))
    )
    arm = identify_from_work(study.hardware, study.train.plans[:SIMULATED_LOGS], rng, ambient_c=study.ambient_c)
    nominal, identified = (
        replace(each, warning_c=study.warning_c)
        for each in (RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c), RcTwin.of(arm))
    )
    return {
        "d": twin_scorer(twin, lambda features: features.difficulty),
        "d, untrained": twin_scorer(untrained, lambda features: features.difficulty),
        "d, collapsed": twin_scorer(collapsed, lambda features: features.difficulty),
        "excess torque²": twin_scorer(twin, lambda features: features.excess_sq),
        "RMS torque / known": lambda plans, repetitions: torque.scores(plans, repetitions).per_joint,
        f"kNN-{NEIGHBOURS}": neighbour_scorer(motion, config, seed),
        "rc nominal": thermal_scorer(nominal),
        "rc identified": thermal_scorer(identified),
    }


def judge(name: str, scorer: Scorer, study: Study) -> Row:
    """Detection of jobs that overheat joint 2, by its score, and any joint, by the total."""
    parts: Sequence[Jobs] = [jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel)]
    scores = [scorer(jobs.plans, jobs.repetitions) for jobs in parts]
    totals = [each.max(axis=1) if name in WORST else each.sum(axis=1) for each in scores]
    peak_c = study.test.peak_c
    asked = {
        "joint 2": ([each[:, CARRIER] for each in scores], peak_c[:, CARRIER]),
        "any joint": (totals, peak_c.max(axis=1)),
    }
    return {
        question: detection(values[0], peaks, reference=values[1], novel=values[2], limit_c=study.warning_c)
        for question, (values, peaks) in asked.items()
    }


def quality_rows(seed: int, size: QualitySize, _wanted: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Quality of every score.

    Raises:
        FleetError: no test job is critical, or all are.
    """
    draw = np.random.SeedSequence(seed)
    study = usual_study(draw, train=size.train, reference=size.reference, test=size.test, novel=size.novel)
    scorers = scorers_of(study, size.config, draw)
    yield "", {"seed": seed, "scores": {name: judge(name, scorer, study) for name, scorer in scorers.items()}}


def spread(values: Sequence[float] | Array, digits: int = 3) -> str:
    """Mean and sample standard deviation over the seeds as text, `0.941 ± 0.006`; the mean alone for one seed."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return "–"
    mean = f"{finite.mean():.{digits}f}"
    return mean if len(finite) == 1 else f"{mean} ± {finite.std(ddof=1):.{digits}f}"


def quality_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Means of every measure, for joint 2 and for any joint."""
    measures = {**LABELS, "caught": "jobs found at 5 %", "false_novel": "alarms on light new motion"}
    tables: dict[str, Table] = {}
    for question in ("joint 2", "any joint"):
        lines = [
            (name, *(spread([row["scores"][name][question][measure] for row in rows]) for measure in measures))
            for name in rows[0]["scores"]
        ]
        caption = f"Does {question} overheat? Mean ± standard deviation over {len(rows)} seeds"
        tables[f"quality_{question}"] = table_of(("score", *measures.values()), lines, caption)
    return tables


QUALITY = seeded(
    "How well d and other scores of the same motion rank jobs by whether a motor overheats.\n\nMinutes for each seed.",
    QualitySize,
    3,
    quality_rows,
    quality_tables,
)
