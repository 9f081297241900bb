"""Overheating and a twin's errors (`readings`), and the hot side of its latent space (`sides`).

A reading makes one score of a job from the errors of its joints and channels, without labels. The paper's is the sum of
d_k. Each is judged on jobs of an arm with its true mount: does it rank jobs by whether any joint overheats, and how
often does a verdict with it call a cool job anomalous?

`sides` samples motion from the hot and from the cool side of the latent space and heats the simulated arm with it. The
side of a job follows from its latents alone: a linear discriminant of their means over the job, fitted on one half of
the test jobs. New motion is decoded from perturbed latents of the other half, its torque comes from MuJoCo's inverse
dynamics. With one payload for all, the sides differ by motion only.
"""

import math
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any  # values of the JSON

import msgspec
import numpy as np
from scipy.stats import binomtest, spearmanr
from sklearn.covariance import LedoitWolf
from sklearn.metrics import average_precision_score, roc_auc_score

from benchmarks.paper.harness import (
    Experiment,
    Unit,
    content_key,
    mean_share,
    names,
    nonnegative,
    one_row,
    scenarios_of,
    size_given,
    size_options,
    table_of,
    whole,
)
from benchmarks.paper.subjects import ALARM_RATE, SCENARIOS, Sample, Study, arm_of, make_study
from fleet.arm.model import ArmModel
from fleet.errors import FleetError
from fleet.files import cache_folder
from fleet.motion import Plan
from scenarios.evaluate.statistics import Interval
from scenarios.json_rows import Row
from scenarios.motion.generate import Rejected, planned
from scenarios.prepare.twins import cold_peaks, train_or_load
from scenarios.spec.schema import Scenario
from scenarios.table import Table
from twin.vae.config import TwinConfig
from twin.vae.generate import Variation, vary
from twin.vae.measures import TAU, Calibration, Features, largest_p_value, p_value
from twin.vae.twin import Twin

Array = np.ndarray

LIGHT = 64
"""Light motions that calibrate."""
WORK = 100
"""Cool work that calibrates; the rest, and the cool test jobs, test."""
CALIBRATION_BEFORE = 64
"""Jobs of each kind in the calibration that was used before: light held-out motion, and work that was trained on."""


@dataclass(frozen=True)
class ArmSize:
    """Numbers of jobs of an arm."""

    train: int = 200
    exploration: int = field(default=64, metadata={"least": 0})
    reference: int = 200
    test: int = 500
    novel: int = 150

    def __post_init__(self) -> None:
        if self.exploration > self.train:
            raise FleetError(f"--exploration must be at most --train (got {self.exploration} and {self.train}).")


@dataclass(frozen=True, eq=False)
class Errors:
    """Features of some jobs with what a reading may use of the twin.

    Readings that use the calibration know its own jobs; with n of them this changes a p-value by the order of 1/n.
    """

    features: Features
    """[job, joint]."""
    calibration: Calibration
    weight: Array
    """w_k, [joint]."""

    @property
    def error(self) -> Array:
        """e_k, [job, joint]."""
        return self.features.errors.sum(axis=-1)

    @property
    def p(self) -> Array:
        """p-value of each joint's e_k against the calibration, [job, joint]."""
        known = self.calibration.reference.errors.sum(axis=-1)
        return np.stack([p_value(np.sort(k), e) for k, e in zip(known.T, self.error.T, strict=True)], axis=1)


Reading = Callable[[Errors], Array]
"""Per job [job], or per joint [job, joint]."""
TOTALS: Mapping[str, Reading] = {
    "Σ d (paper)": lambda e: e.features.difficulty.sum(axis=1),
    "max d": lambda e: e.features.difficulty.max(axis=1),
    "Σ w d": lambda e: e.features.difficulty @ e.weight,
    "Σ w e": lambda e: e.error @ e.weight,
    "max d_cal": lambda e: ((e.error - e.calibration.floor) / e.calibration.spread).max(axis=1),
    "smallest p": lambda e: -e.p.min(axis=1),
    "Fisher": lambda e: -np.log(e.p).sum(axis=1),
    "Fisher, weighted": lambda e: -np.log(e.p) @ e.weight,
    "Cauchy, weighted": lambda e: np.tan((0.5 - e.p) * np.pi) @ e.weight,
    "Σ w torque error": lambda e: e.features.errors[..., TAU] @ e.weight,
    "load: Σ w torque above": lambda e: e.features.one_sided @ e.weight,
    "Σ excess torque²": lambda e: e.features.excess_sq.sum(axis=1),
    "latent, weighted": lambda e: e.calibration.latent(e.features) @ e.weight,
    "latent, largest": lambda e: e.calibration.latent(e.features).max(axis=1),
    "squared torque": lambda e: (e.features.torque_sq / e.calibration.reference.torque_sq.mean(axis=0)) @ e.weight,
}
"""Score of a job for: does any joint overheat? The last one owes nothing to the twin but its weights."""
JOINTS: Mapping[str, Reading] = {
    "d": lambda e: e.features.difficulty,
    "torque error": lambda e: e.features.errors[..., TAU],
    "load: torque above": lambda e: e.features.one_sided,
    "latent": lambda e: e.calibration.latent(e.features),
    "squared torque": lambda e: e.features.torque_sq,
}
"""Score of a joint for: does the joint that carries the load (largest w_k) overheat?"""
MEASURES = ("auroc", "auprc", "spearman", "hits", "false_work", "false_before")


def judge_arm(study: Study, twin: Twin) -> dict[str, Any]:
    """Every reading on one arm.

    Returns:
        `any`: [reading][measure], `carrier`: the joint of the largest w_k, counted from one, `joint`:
        [reading][measure] for it. A measure without jobs of both kinds is None.
    """
    parts = {name: _features(twin, getattr(study, name)) for name in ("train", "reference", "test", "novel")}
    work, light = parts["reference"], parts["novel"]
    split = [_rows(light, slice(LIGHT)), _rows(work, slice(WORK))]
    count = CALIBRATION_BEFORE
    before = [_rows(light, slice(count)), _rows(parts["train"], slice(count))]
    peak_c = study.test.peak_c
    cool = peak_c.max(axis=1) < study.cool_c
    new_work = _stack([_rows(work, slice(WORK, None)), _rows(parts["test"], cool)])
    carrier = int(np.argmax(twin.joint_weight))

    def judged(reading: Reading, joint: int | None) -> dict[str, float | None]:
        def scores(features: Features, kinds: Sequence[Features]) -> Array:
            group = np.repeat(np.arange(len(kinds)), [len(kind.packed) for kind in kinds])
            values = reading(Errors(features, Calibration(_stack(kinds), group), twin.joint_weight))
            return values if joint is None else values[:, joint]

        def p(features: Features, kinds: Sequence[Features], *, pooled: bool = False) -> Array:
            group = np.repeat(np.arange(len(kinds)), [len(kind.packed) for kind in kinds])
            known = scores(_stack(kinds), kinds)
            return largest_p_value(known, 0 * group if pooled else group, scores(features, kinds))

        peak = peak_c.max(axis=1) if joint is None else peak_c[:, joint]
        hot, score = peak >= study.warning_c, scores(parts["test"], split)
        both = hot.any() and not hot.all()
        return {
            "auroc": float(roc_auc_score(hot, score)) if both else None,
            "auprc": float(average_precision_score(hot, score)) if both else None,
            "spearman": float(np.asarray(spearmanr(score, peak))[0]),
            "hits": float((p(parts["test"], split)[hot] <= ALARM_RATE).mean()) if both else None,
            "false_work": float((p(new_work, split) <= ALARM_RATE).mean()),
            "false_before": float((p(new_work, before, pooled=True) <= ALARM_RATE).mean()),
        }

    return {
        "carrier": carrier + 1,
        "any": {name: judged(reading, None) for name, reading in TOTALS.items()},
        "joint": {name: judged(reading, carrier) for name, reading in JOINTS.items()},
    }


def _features(twin: Twin, sample: Sample) -> Features:
    return twin.features(sample.plans, sample.repetitions)


def _rows(features: Features, rows: slice | Array) -> Features:
    return Features(features.packed[rows])


def _stack(parts: Sequence[Features]) -> Features:
    return Features(np.concatenate([part.packed for part in parts]))


def reading_cells(rows: Sequence[Row], question: str) -> dict[str, dict[str, Interval]]:
    """Mean of each measure with its 95 % interval over arms, [reading][measure]; NaN for one that no arm has.

    Args:
        question: `any` or `joint`.
    """
    found: dict[str, dict[str, Interval]] = {}
    for reading in rows[0][question]:
        values = {m: [(arm_of(row["arm"]), row[question][reading][m]) for row in rows] for m in MEASURES}
        known = {m: [(arm, value) for arm, value in some if value is not None] for m, some in values.items()}
        found[reading] = {m: mean_share(some, measure=m) if some else Interval(math.nan) for m, some in known.items()}
    return found


HEADS = ("AUROC", "AUPRC", "Spearman", "overheating jobs found", "false alarms, new work", "before")
TITLES = {
    "any": "score, for: does any joint overheat?",
    "joint": "score of the joint with the largest w_k, for: does it overheat?",
}


def reading_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """A table for each question, with intervals of AUROC and of the false alarms."""
    tables: dict[str, Table] = {}
    for question, title in TITLES.items():
        lines: list[tuple[str, ...]] = []
        for reading, measured in reading_cells(rows, question).items():
            texts = (each.text(3) if i in (0, 4) else f"{each.mean:.3f}" for i, each in enumerate(measured.values()))
            lines.append((reading, *texts))
        caption = f"{len(rows)} arms and seeds; jobs found and false alarms of a verdict at {ALARM_RATE:.0%}"
        tables[f"readings_{question}"] = table_of((title, *HEADS), lines, caption)
    return tables


def studied(
    scenario: Scenario, index: int, draw: np.random.SeedSequence, config: TwinConfig, size: ArmSize
) -> tuple[Study, Twin]:
    """Jobs of an arm of a scenario, and the twin of its cool ones."""
    study = make_study(draw, robot=scenario.arms[index].robot(), **asdict(size))  # pyright: ignore[reportArgumentType]
    return study, train_or_load(study.train.records(), config, draw, arm="arm", folder=cache_folder())


def arm_row(
    scenario: Scenario, arm: int, name: str, draw: np.random.SeedSequence, config: TwinConfig, size: ArmSize
) -> Row:
    """Every reading on one arm."""
    return {"arm": name, **judge_arm(*studied(scenario, arm, draw, config, size))}


def reading_options(parser: ArgumentParser) -> None:
    """Options of `readings`."""
    parser.add_argument("--scenarios", type=names, default=names(SCENARIOS), help=f"scenarios [{SCENARIOS}]")
    parser.add_argument("--seeds", type=whole(1), default=1, help="number of seeds: 1, 2, … [1]")
    parser.add_argument("--full", action="store_true", help="train the twins in full size")
    size_options(parser, ArmSize)


def reading_units(given: Namespace) -> list[Unit]:
    """A unit for each arm and seed."""
    config, size = TwinConfig() if given.full else TwinConfig.quick(), size_given(given, ArmSize)
    arms = [(scenario, i) for scenario in scenarios_of(given.scenarios) for i in range(len(scenario.arms))]
    basis = content_key(asdict(size), msgspec.to_builtins(config), ALARM_RATE)
    units = list[Unit]()
    for seed in range(1, given.seeds + 1):
        for number, (scenario, i) in enumerate(arms, start=1):
            name, draw = f"{scenario.name}/{scenario.arms[i].name}/{seed}", np.random.SeedSequence([seed, number])
            units.append(one_row(f"{name}/{number}/{basis}", partial(arm_row, scenario, i, name, draw, config, size)))
    return units


READINGS = Experiment(
    help="Compare readings of a twin's errors on all arms of some scenarios: ranking of jobs, and verdicts.\n\n"
    "Each arm gets random jobs with true outcomes and a twin trained on its cool ones: half a minute.",
    options=reading_options,
    units=reading_units,
    tables=reading_tables,
)

COMMON_KG = 2.0
"""Payload of all motions where only motion shall differ; jobs without payload get it too."""
MOST_DRAWS = 5
"""Most attempts per requested motion."""


def sides(study: Study, twin: Twin, *, count: int = 40, s: float = 1.0, seed: int = 0) -> Row:
    """Generate `count` motions from each side of the latent space and heat the arm with them.

    Args:
        s: Perturbation in posterior standard deviations.

    Returns:
        `sources`: test jobs on each side, `source_critical`: share of them that are critical. `own` and `common`, with
        the payload of the source and with `COMMON_KG` for all: for each side the numbers of `motions` and of those
        `rejected` beyond joint or torque limits, the shares that get `warm` (above the cool limit) and `critical` when
        the motion repeats over the horizon, with 95 % intervals, and the median `peak_c` of the hottest motor.

    Raises:
        FleetError: a side has no jobs, or none of its motions is possible.
    """
    score, critical, rest = hot_side(study, twin)
    chosen = {"hot": rest[score[rest] > 0], "cool": rest[score[rest] <= 0]}
    if not all(map(len, chosen.values())):
        raise FleetError("All test jobs lie on one side of the latent space; take another arm or more test jobs.")
    model = ArmModel(study.robot)
    result: Row = {
        "sources": {side: len(index) for side, index in chosen.items()},
        "source_critical": {side: float(critical[index].mean()) for side, index in chosen.items()},
        "own": {},
        "common": {},
    }
    for number, (side, index) in enumerate(chosen.items()):
        rng = np.random.default_rng([seed, number])
        motions: dict[str, list[Plan]] = {"own": [], "common": []}
        rejected = dict.fromkeys(motions, 0)
        for _ in range(MOST_DRAWS * count):
            if len(motions["own"]) == count:
                break
            source = study.test.plans[int(rng.choice(index))]
            made = vary(twin, source, s, rng)
            for name, plans in motions.items():
                try:
                    plans.append(_realised(model, made, source, COMMON_KG if name == "common" else None))
                except Rejected:
                    rejected[name] += 1
        if not all(motions.values()):
            raise FleetError(f"No motion from the {side} side stays within the arm's limits; take a smaller --s.")
        law = {"ambient_c": study.ambient_c, "horizon_s": study.horizon_s}
        for name, plans in motions.items():
            peak_c = cold_peaks(plans, study.motors, study.thermal, **law).max(axis=1)
            result[name][side] = {
                "motions": len(plans),
                "rejected": rejected[name],
                "warm": share_of(peak_c > study.cool_c),
                "critical": share_of(peak_c >= study.warning_c),
                "peak_c": float(np.median(peak_c)),
            }
    return result


def hot_side(study: Study, twin: Twin) -> tuple[Array, Array, Array]:
    """A linear discriminant of critical jobs by their mean latents, fitted on every second test job.

    Returns:
        Discriminant of each test job, positive on the hot side, whether it is critical, each [job], and the indices of
        the jobs that it was not fitted on.
    """
    latent = _features(twin, study.test).latent_moments[0].reshape(len(study.test), -1)
    critical = study.critical
    fitted, rest = np.arange(0, len(latent), 2), np.arange(1, len(latent), 2)
    kinds = [latent[fitted][critical[fitted] == kind] for kind in (False, True)]
    if min(map(len, kinds)) < 2:
        raise FleetError(f"{critical.sum()} of {len(critical)} test jobs are critical: too few for a hot side.")
    cool, hot = (kind.mean(axis=0) for kind in kinds)
    within = LedoitWolf().fit(np.concatenate([kind - kind.mean(axis=0) for kind in kinds]))
    return (latent - (cool + hot) / 2) @ np.linalg.solve(within.covariance_, hot - cool), critical, rest


def _realised(model: ArmModel, made: Variation, source: Plan, payload_kg: float | None) -> Plan:
    """The plan of a variation, with another payload if one is given; raises Rejected."""
    if payload_kg is not None:
        phases = tuple(replace(part, payload_kg=np.full(len(part.payload_kg), payload_kg)) for part in made.phases)
        made = replace(made, phases=phases)
    return planned(made, source, model)


def share_of(event: Array) -> tuple[float, float, float]:
    """Share of true values with its 95 % interval (Wilson, JASA 22, 1927)."""
    ends = binomtest(int(event.sum()), len(event)).proportion_ci(method="wilson")
    return float(event.mean()), float(ends.low), float(ends.high)


PAYLOADS = {"own": "as the source", "common": "2 kg for all"}


def side_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Shares of motions that get warm and hot, of the first row."""
    lines = [
        (
            f"{text}, {side} side",
            Interval(*share["warm"]).text(),
            Interval(*share["critical"]).text(),
            f"{share['peak_c']:.0f} °C",
        )
        for name, text in PAYLOADS.items()
        for side, share in rows[0][name].items()
    ]
    caption = f"Motion generated from each side of the latent space: {rows[0]['arm']} of {rows[0]['scenario']}"
    return {
        "sides": table_of(
            ("payload, side", "above 40 °C", "60 °C or more", "median of the hottest motor"), lines, caption
        )
    }


def side_options(parser: ArgumentParser) -> None:
    """Options of `sides`."""
    parser.add_argument("scenario", nargs="?", default="quickstart", help="scenario [quickstart]")
    parser.add_argument("--arm", help="arm of the scenario [the first]")
    parser.add_argument("--count", type=whole(2), default=40, help="motions from each side [40]")
    parser.add_argument("--s", type=nonnegative, default=1.0, help="perturbation in posterior standard deviations [1]")
    parser.add_argument("--seed", type=whole(0), default=1, help="[1]")
    size_options(parser, ArmSize)


def side_row(given: Namespace) -> Row:
    """Both sides of the latent space of one arm."""
    (scenario,) = scenarios_of([given.scenario])
    index = 0 if given.arm is None else scenario.index_of(given.arm)
    draw = np.random.SeedSequence([given.seed, index + 1])
    study, twin = studied(scenario, index, draw, TwinConfig.quick(), size_given(given, ArmSize))
    found = sides(study, twin, count=given.count, s=given.s, seed=given.seed)
    return {"scenario": scenario.name, "arm": scenario.arms[index].name, "seed": given.seed, **found}


def side_units(given: Namespace) -> list[Unit]:
    """One unit."""
    basis = content_key(
        given.count, given.s, asdict(size_given(given, ArmSize)), msgspec.to_builtins(TwinConfig.quick())
    )
    return [one_row(f"{given.scenario}/{given.arm or ''}/{given.seed}/{basis}", partial(side_row, given))]


SIDES = Experiment(
    help="Sample motion from the hot and the cool side of the latent space: how much of it gets hot.\n\nSome minutes.",
    options=side_options,
    units=side_units,
    tables=side_tables,
)
