"""Compare scorers on the same held-out jobs, over several seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from fleet.motion import Plan
from scenarios.studies.detection_metrics import LIMIT_C, Detection, detection
from twin.baselines.reconstruction import Scorer, Scores

Array = np.ndarray

CARRIER = 1
"""Joint 2 carries the stretched arm: nearly every critical job is critical there (index 0..6)."""
QUESTIONS = ("any joint, total", "any joint, joint 2", "joint 2, joint 2")
"""Which joint must reach the limit, and which score predicts it: the job's total or that of joint 2."""
WORDS = {
    "any joint, total": "Any joint overheats, by the job's total score",
    "any joint, joint 2": "Any joint overheats, by the score of joint 2",
    "joint 2, joint 2": "Joint 2 overheats, by its own score",
}
RANKING = ("auroc", "auprc", "spearman")
"""Measures that need no threshold."""
LABELS = {
    "auroc": "AUROC",
    "auprc": "AUPRC",
    "spearman": "Spearman",
    "caught": "TPR at 5 %",
    "false_novel": "FPR novel",
}
HEAT, MOTION = "heat", "motion"
MEASURES = tuple(field.name for field in fields(Detection))

Judged = dict[tuple[str, str], Detection]
"""By scorer and question."""


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


@dataclass(frozen=True, kw_only=True)
class Row:
    """Quality of one scorer for one question."""

    scorer: str
    question: str
    seeds: tuple[Detection, ...]
    """One per seed, each with its own study and trainings."""

    def values(self, measure: str) -> Array:
        """One of `MEASURES`, [seed]."""
        return np.array([getattr(each, measure) for each in self.seeds])


@dataclass(frozen=True, kw_only=True)
class QualityTable:
    """Rows in the order in which the scorers were given, question by question."""

    rows: tuple[Row, ...]
    thermal: tuple[str, ...] = ()
    """Scorers that were given motor data and the thermal law; the others know motion alone."""

    def knows(self, scorer: str) -> str:
        """What a scorer was given: heat or motion."""
        return HEAT if scorer in self.thermal else MOTION

    def row(self, scorer: str, question: str) -> Row:
        """The row of a scorer.

        Raises:
            ValueError: no such row.
        """
        for row in self.rows:
            if (row.scorer, row.question) == (scorer, question):
                return row
        names = ", ".join(dict.fromkeys(row.scorer for row in self.rows))
        raise ValueError(f"No scorer '{scorer}' under '{question}'. Scorers: {names}; questions: {QUESTIONS}.")


def judge(scorers: Sequence[Scorer], *, test: Jobs, reference: Jobs, novel: Jobs, limit_c: float = LIMIT_C) -> Judged:
    """Detection of every scorer for every question, by (scorer, question).

    Raises:
        ValueError: two scorers of one name.
        FleetError: all test jobs are critical or none is, or too few reference jobs for a threshold.
    """
    names = [scorer.name for scorer in scorers]
    if len(set(names)) < len(names):
        raise ValueError(f"Names of scorers must be unique (got {', '.join(names)}).")
    quality: Judged = {}
    for scorer in scorers:
        results = [scorer.scores(jobs.plans, jobs.repetitions) for jobs in (test, reference, novel)]
        for question in QUESTIONS:
            score, at_reference, at_novel = (_score(scores, question) for scores in results)
            quality[scorer.name, question] = detection(
                score, _truth(test.peak_c, question), reference=at_reference, novel=at_novel, limit_c=limit_c
            )
    return quality


def table(per_seed: Sequence[Judged], thermal: Sequence[str] = ()) -> QualityTable:
    """Quality under several seeds, side by side.

    Args:
        thermal: As `QualityTable.thermal`.

    Raises:
        ValueError: no seed, or seeds with other scorers.
    """
    if not per_seed or any(each.keys() != per_seed[0].keys() for each in per_seed):
        raise ValueError("A quality table needs at least one seed, and the same scorers under each.")
    scorers = list(dict.fromkeys(scorer for scorer, _ in per_seed[0]))
    return QualityTable(
        rows=tuple(
            Row(scorer=scorer, question=question, seeds=tuple(each[scorer, question] for each in per_seed))
            for question in QUESTIONS
            for scorer in scorers
        ),
        thermal=tuple(thermal),
    )


def _score(scores: Scores, question: str) -> Array:
    return scores.total if question.endswith("total") else scores.per_joint[:, CARRIER]


def _truth(peak_c: Array, question: str) -> Array:
    return peak_c.max(axis=1) if question.startswith("any") else peak_c[:, CARRIER]


def verdicts(quality: QualityTable, subject: str, baselines: Sequence[str]) -> tuple[str, ...]:
    """Compare baselines with a scorer: a sentence per question and kind of knowledge.

    One is ahead of the other in a measure if it is ahead under every seed; between equals this happens by chance in
    one of four cases with three seeds. Everything else is a tie. Baselines without rows are skipped.
    """
    present = [name for name in baselines if any(row.scorer == name for row in quality.rows)]
    groups = [(kind, [name for name in present if quality.knows(name) == kind]) for kind in (MOTION, HEAT)]
    return tuple(
        _verdict(quality, question, subject, kind, some) for question in QUESTIONS for kind, some in groups if some
    )


def _verdict(quality: QualityTable, question: str, subject: str, kind: str, baselines: Sequence[str]) -> str:
    own = quality.row(subject, question)
    rows = sorted((quality.row(name, question) for name in baselines), key=lambda row: -_mean_lead(row, own, "auroc"))
    groups: dict[str, list[str]] = {"is beaten by": [], "is partly beaten by": [], "ties with": [], "beats": []}
    for row in rows:
        leads = {m: _mean_lead(row, own, m) for m in RANKING if _always_one_side(row, own, m)}
        if not leads:
            groups["ties with"].append(row.scorer)
        elif max(leads.values()) < 0:
            groups["beats"].append(row.scorer)
        else:
            outcome = "is beaten by" if min(leads.values()) > 0 else "is partly beaten by"
            groups[outcome].append(f"{row.scorer} ({_leads(leads)})")
    given = "with motion alone" if kind == MOTION else "with motor data and the thermal law"
    text = ". It ".join(f"{outcome} {_listed(names)}" for outcome, names in groups.items() if names)
    return f"{WORDS[question]}. Among scorers {given}, {subject} {text}."


def _leads(leads: dict[str, float]) -> str:
    """Leads and then deficits: `AUROC +.020, but Spearman −.100`."""
    more, less = (
        ", ".join(f"{LABELS[m]} {sign}{_short(abs(lead))}" for m, lead in leads.items() if (lead > 0) == (sign == "+"))
        for sign in ("+", "−")
    )
    return f"{more}, but {less}" if less else more


def _mean_lead(row: Row, own: Row, measure: str) -> float:
    return float((row.values(measure) - own.values(measure)).mean())


def _always_one_side(row: Row, own: Row, measure: str) -> bool:
    """Whether the same scorer is ahead under every seed, to three digits."""
    ahead = np.round(row.values(measure) - own.values(measure), 3)
    return bool(np.all(ahead > 0) or np.all(ahead < 0))


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + f" and {names[-1]}"


def spread(values: Sequence[float] | Array, digits: int = 3) -> str:
    """Mean and sample standard deviation over the seeds as text, `0.941 ± 0.006`; the mean alone for one seed."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return "–"
    mean = f"{finite.mean():.{digits}f}"
    return mean if len(finite) == 1 else f"{mean} ± {finite.std(ddof=1):.{digits}f}"


def _short(value: float) -> str:
    return f"{value:.3f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.3f}"
