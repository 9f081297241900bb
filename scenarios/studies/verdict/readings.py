"""Readings of the same reconstruction errors, on every arm of some scenarios: ranking, false alarms, hits.

A reading makes one score of a job from the errors of its joints and channels, without labels. The paper's is the sum of
d_k. Each is judged on jobs of an arm with its true mount: does it rank jobs by whether any joint overheats, and how
often does a verdict with it call a cool job anomalous?
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # values of the JSON

import numpy as np
from scipy.stats import spearmanr
from sklearn.metrics import average_precision_score, roc_auc_score

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.evaluate.statistics import Interval, mean_by_group
from scenarios.prepare.train_twins import train_or_load
from scenarios.progress import Count, Progress, quiet
from scenarios.result_folder import disk_errors
from scenarios.schema import Scenario
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.setup import Sample, Study, make_study
from scenarios.studies.sweep.subjects import arm_of
from twin.conformal import largest_p_value, p_value
from twin.vae.config import TwinConfig
from twin.vae.measures import TAU, Calibration, Features
from twin.vae.twin import Twin

Array = np.ndarray

ALPHA = 0.05
SIZES = {"train": 200, "exploration": 64, "reference": 200, "test": 500, "novel": 150}
LIGHT = 64
"""Light motions that calibrate; the others test."""
WORK = 100
"""Cool work that calibrates; the rest, and the cool test jobs, test."""
CALIBRATION_BEFORE = 64
"""Jobs of each kind in the calibration that was used before: light held-out motion, and work that was trained on."""


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
MEASURES = ("auroc", "auprc", "spearman", "hits", "false_work", "false_light", "false_known", "false_before")


def study_arms(
    scenarios: Sequence[Scenario],
    seeds: Sequence[int],
    out: Path,
    *,
    config: TwinConfig,
    folder: Path,
    sizes: Mapping[str, int] = SIZES,
    make: Callable[..., Study] = make_study,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Judge every reading on every arm under every seed; finished ones are taken from `out`, which is kept up to date.

    Args:
        folder: Cache of trained twins.
        make: Makes the study of an arm; sizes as in `make_study`.

    Returns:
        The content of `out`: for each arm and seed what it measured.

    Raises:
        FleetError: `out` holds something else, or cannot be written.
    """
    basis = {"sizes": dict(sizes), "epochs": config.epochs, "max_windows": config.max_windows, "window": config.window}
    basis |= {"hidden": config.hidden, "latent": config.latent, "beta": config.beta, "alpha": ALPHA}
    card: dict[str, Any] = {**basis, "arms": {}}
    if out.exists():
        card = _kept(out, basis)
    units = [(s, i) for s in scenarios for i in range(len(s.arms))]
    names = [f"{s.name}/{s.arms[i].name}/{seed}" for seed in seeds for s, i in units]
    for done, name in enumerate(names):
        progress("judging readings", Count(done, len(names)))
        if name in card["arms"]:
            continue
        seed, number = seeds[done // len(units)], done % len(units)
        scenario, arm = units[number]
        draw = np.random.SeedSequence([seed, number + 1])
        study = make(draw, **sizes, robot=scenario.arms[arm].robot())
        twin = train_or_load(study.train.records(), config, draw, arm="arm", folder=folder)
        card["arms"][name] = judge_arm(study, twin)
        with disk_errors(out), atomic_path(out) as draft:
            draft.write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return {**card, "arms": {name: card["arms"][name] for name in names}}


def _kept(out: Path, basis: Mapping[str, Any]) -> dict[str, Any]:
    try:
        card = json.loads(out.read_bytes())
        same = {name: card[name] for name in basis} == basis and isinstance(card["arms"], dict)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise FleetError(f"'{out}' is no result of `twin readings`; give another --out.") from None
    if not same:
        raise FleetError(f"'{out}' has readings of other settings, such as --size; give another --out.")
    return card


def judge_arm(study: Study, twin: Twin) -> dict[str, Any]:
    """Every reading on one arm.

    Returns:
        `any`: [reading][measure], `carrier`: the joint of the largest w_k, counted from one, `joint`:
        [reading][measure] for it, and shares of jobs that overheat. A measure without jobs of both kinds is None.
    """
    parts = {name: _features(twin, study, getattr(study, name)) for name in ("train", "reference", "test", "novel")}
    work, light = parts["reference"], parts["novel"]
    split = [_rows(light, slice(LIGHT)), _rows(work, slice(WORK))]
    count = CALIBRATION_BEFORE
    before = [_rows(light, slice(count)), _rows(parts["train"], slice(count))]
    peak_c = study.test.peak_c
    cool = peak_c.max(axis=1) < study.cool_c
    asked = {
        "test": parts["test"],
        "work": _stack([_rows(work, slice(WORK, None)), _rows(parts["test"], cool)]),
        "light": _rows(light, slice(LIGHT, None)),
        "known": _rows(parts["train"], slice(SIZES["train"] - SIZES["exploration"])),
    }
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
        hot, score = peak >= study.warning_c, scores(asked["test"], split)
        both = hot.any() and not hot.all()
        return {
            "auroc": float(roc_auc_score(hot, score)) if both else None,
            "auprc": float(average_precision_score(hot, score)) if both else None,
            "spearman": float(np.asarray(spearmanr(score, peak))[0]),
            "hits": float((p(asked["test"], split)[hot] <= ALPHA).mean()) if both else None,
            **{f"false_{kind}": float((p(asked[kind], split) <= ALPHA).mean()) for kind in ("work", "light", "known")},
            "false_before": float((p(asked["work"], before, pooled=True) <= ALPHA).mean()),
        }

    return {
        "carrier": carrier + 1,
        "overheats": [float(share) for share in (peak_c >= study.warning_c).mean(axis=0)],
        "weight": [float(w) for w in twin.joint_weight],
        "twin": twin.version,
        "any": {name: judged(reading, None) for name, reading in TOTALS.items()},
        "joint": {name: judged(reading, carrier) for name, reading in JOINTS.items()},
    }


def _features(twin: Twin, study: Study, sample: Sample) -> Features:
    jobs = jobs_of(sample, study.horizon_s)
    return twin.features(jobs.plans, jobs.repetitions)


def _rows(features: Features, rows: slice | Array) -> Features:
    return Features(features.packed[rows])


def _stack(parts: Sequence[Features]) -> Features:
    return Features(np.concatenate([part.packed for part in parts]))


def summary(card: Mapping[str, Any], question: str) -> Iterator[tuple[str, dict[str, Interval]]]:
    """Mean of each measure with its 95 % interval over arms, reading by reading; NaN for one that no arm has.

    Args:
        question: `any` or `joint`.
    """
    arms = card["arms"]
    for reading in next(iter(arms.values()))[question]:
        found = {m: [(arm_of(name), arm[question][reading][m]) for name, arm in arms.items()] for m in MEASURES}
        known = {m: [(arm, value) for arm, value in values if value is not None] for m, values in found.items()}
        yield reading, {m: mean_by_group(values) if values else Interval(math.nan) for m, values in known.items()}
