"""Compare scorers on the same held-out jobs, over several seeds."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from fleet.motion import Plan
from scenarios.studies.detection_metrics import LIMIT_C, Detection, detection
from twin.baselines.reconstruction import Scorer, Scores

Array = np.ndarray

CARRIER = 1
"""Joint 2 carries the stretched arm: nearly every critical job is critical there (index 0..6)."""
QUESTIONS = {
    "any joint, total": "Any joint overheats, by the job's total score",
    "any joint, joint 2": "Any joint overheats, by the score of joint 2",
    "joint 2, joint 2": "Joint 2 overheats, by its own score",
}
"""Which joint must reach the limit, and which score predicts it: the job's total or that of joint 2."""
RANKING = ("auroc", "auprc", "spearman")
"""Measures that need no threshold."""
LABELS = {
    "auroc": "AUROC",
    "auprc": "AUPRC",
    "spearman": "Spearman",
    "caught": "TPR at 5 %",
    "false_novel": "FPR novel",
    "brier": "Brier",
    "ece": "ECE",
}
"""Names of measures in tables."""
MEASURES = tuple(field.name for field in fields(Detection))

Judged = dict[str, dict[str, Detection]]
"""[question][scorer] of one seed."""
Quality = dict[str, dict[str, dict[str, Array]]]
"""[question][scorer][measure] → one value per seed, [seed]."""


@dataclass(frozen=True, eq=False)
class Jobs:
    """Jobs with their true outcome."""

    plans: tuple[Plan, ...]
    repetitions: tuple[int, ...]
    """[job]."""
    peak_c: Array
    """True peak of each joint's winding, °C, [job, joint]."""

    def __post_init__(self) -> None:
        if not len(self.plans) == len(self.repetitions) == len(self.peak_c):
            raise ValueError(
                f"Jobs need a repetition and a peak per plan (got {len(self.plans)} plans, "
                f"{len(self.repetitions)} repetitions, {len(self.peak_c)} peaks)."
            )


def judge(scorers: Sequence[Scorer], *, test: Jobs, reference: Jobs, novel: Jobs, limit_c: float = LIMIT_C) -> Judged:
    """Detection by every scorer for every question.

    Raises:
        ValueError: two scorers of one name.
        FleetError: all test jobs are critical or none is, or too few reference jobs for a threshold.
    """
    names = [scorer.name for scorer in scorers]
    if len(set(names)) < len(names):
        raise ValueError(f"Names of scorers must be unique (got {', '.join(names)}).")
    judged: Judged = {question: {} for question in QUESTIONS}
    for scorer in scorers:
        results = [scorer.scores(jobs.plans, jobs.repetitions) for jobs in (test, reference, novel)]
        for question, by_scorer in judged.items():
            score, at_reference, at_novel = (_score(scores, question) for scores in results)
            peak_c = test.peak_c.max(axis=1) if question.startswith("any") else test.peak_c[:, CARRIER]
            by_scorer[scorer.name] = detection(score, peak_c, reference=at_reference, novel=at_novel, limit_c=limit_c)
    return judged


def _score(scores: Scores, question: str) -> Array:
    return scores.total if question.endswith("total") else scores.per_joint[:, CARRIER]


def side_by_side(per_seed: Sequence[Judged]) -> Quality:
    """Quality under several seeds.

    Raises:
        ValueError: no seed, or seeds with other scorers.
    """
    scorers = [[*next(iter(judged.values()))] for judged in per_seed]
    if not scorers or any(set(each) != set(scorers[0]) for each in scorers):
        raise ValueError("A quality table needs at least one seed, and the same scorers under each.")
    return {
        question: {name: by_measure([judged[question][name] for judged in per_seed]) for name in scorers[0]}
        for question in per_seed[0]
    }


def by_measure(seeds: Sequence[Detection]) -> dict[str, Array]:
    """Each of `MEASURES`, [seed]."""
    rows = [asdict(each) for each in seeds]
    return {measure: np.array([row[measure] for row in rows]) for measure in MEASURES}


def verdicts(
    quality: Quality, subject: str, baselines: Sequence[str], *, thermal: Sequence[str] = ()
) -> tuple[str, ...]:
    """Compare baselines with a scorer: a sentence per question and kind of knowledge.

    A scorer is better in a measure if it is better under every seed; between equals this happens by chance in one of
    four cases with three seeds. Everything else is a tie. Baselines that were not measured are skipped.

    Args:
        thermal: Baselines that use motor data and the thermal law; the others use motion alone.
    """
    sentences = []
    for question, scorers in quality.items():
        for given, is_thermal in (("motion alone", False), ("motor data and the thermal law", True)):
            names = [name for name in baselines if name in scorers and (name in thermal) == is_thermal]
            if names:
                text = _verdict({name: scorers[name] for name in names}, scorers[subject])
                sentences.append(f"{QUESTIONS[question]}. Among scorers with {given}, {subject} {text}.")
    return tuple(sentences)


def _verdict(baselines: dict[str, dict[str, Array]], own: dict[str, Array]) -> str:
    leads = {name: {m: values[m] - own[m] for m in RANKING} for name, values in baselines.items()}
    groups: dict[str, list[str]] = {"is beaten by": [], "is partly beaten by": [], "ties with": [], "beats": []}
    for name, lead in sorted(leads.items(), key=lambda item: -item[1]["auroc"].mean()):
        clear = {m: float(values.mean()) for m, values in lead.items() if _same_sign(values)}
        if not clear:
            groups["ties with"].append(name)
        elif max(clear.values()) < 0:
            groups["beats"].append(name)
        else:
            outcome = "is beaten by" if min(clear.values()) > 0 else "is partly beaten by"
            groups[outcome].append(f"{name} ({_leads(clear)})")
    return ". It ".join(f"{outcome} {_listed(names)}" for outcome, names in groups.items() if names)


def _same_sign(leads: Array) -> bool:
    """Whether the same scorer is better under every seed, to three digits."""
    return bool(abs(np.sign(np.round(leads, 3)).sum()) == len(leads))


def _leads(leads: dict[str, float]) -> str:
    """Leads and then deficits: `AUROC +.020, but Spearman −.100`."""
    parts = []
    for sign, chosen in (("+", lambda lead: lead > 0), ("−", lambda lead: lead <= 0)):
        parts.append(", ".join(f"{LABELS[m]} {sign}{_short(abs(lead))}" for m, lead in leads.items() if chosen(lead)))
    return ", but ".join(filter(None, parts))


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def spread(values: Sequence[float] | Array, digits: int = 3) -> str:
    """Mean and sample standard deviation over the seeds as text, `0.941 ± 0.006`; the mean alone for one seed."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return "–"
    mean = f"{finite.mean():.{digits}f}"
    return mean if len(finite) == 1 else f"{mean} ± {finite.std(ddof=1):.{digits}f}"


def _short(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")
