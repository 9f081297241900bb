"""Who finds hard jobs how well: every scorer on the same held-out jobs, over several seeds, and in words."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from fleet.motion import Plan
from scenarios.detection import LIMIT_C, Detection, detection
from twin.rivals import Scorer, Scores

Array = np.ndarray

CARRIER = 1
"""Joint 2 bears the stretched arm: nearly every critical job is critical there (index 0..6)."""
QUESTIONS = ("any joint, total", "any joint, joint 2", "joint 2, joint 2")
"""Which joint must reach the limit, and which score is asked: the job's total or that of joint 2."""
WORDS = {
    "any joint, total": "Does any joint overheat, asked of the whole job's score",
    "any joint, joint 2": "Does any joint overheat, asked of joint 2's score",
    "joint 2, joint 2": "Does joint 2 overheat, asked of its own score",
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
MEASURES = tuple(field.name for field in fields(Detection))

Judged = dict[tuple[str, str], Detection]
"""By scorer and question."""


@dataclass(frozen=True, eq=False)
class Jobs:
    """Jobs with what truly became of them."""

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
    """One scorer's answer to one question."""

    scorer: str
    question: str
    seeds: tuple[Detection, ...]
    """One per seed: a study and trainings of its own."""

    def values(self, measure: str) -> Array:
        """One of `MEASURES`, [seed]."""
        return np.array([getattr(each, measure) for each in self.seeds])


@dataclass(frozen=True, kw_only=True)
class QualityTable:
    """Rows in the order in which the scorers were given, question by question."""

    rows: tuple[Row, ...]

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
        raise ValueError(f"Scorers must have names of their own (got {', '.join(names)}).")
    found: Judged = {}
    for scorer in scorers:
        said = [scorer.scores(jobs.plans, jobs.repetitions) for jobs in (test, reference, novel)]
        for question in QUESTIONS:
            asked, at_reference, at_novel = (_asked(scores, question) for scores in said)
            found[scorer.name, question] = detection(
                asked, _truth(test.peak_c, question), reference=at_reference, novel=at_novel, limit_c=limit_c
            )
    return found


def table(per_seed: Sequence[Judged]) -> QualityTable:
    """What was found under several seeds, side by side.

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
        )
    )


def _asked(scores: Scores, question: str) -> Array:
    return scores.total if question.endswith("total") else scores.per_joint[:, CARRIER]


def _truth(peak_c: Array, question: str) -> Array:
    return peak_c.max(axis=1) if question.startswith("any") else peak_c[:, CARRIER]


def beaten(quality: QualityTable, subject: str, rivals: Sequence[str]) -> tuple[str, ...]:
    """Where a rival beats the subject, a sentence per question and rival, the largest lead in AUROC first.

    A rival beats it in a measure if it is ahead under every seed; with three seeds chance alone does so in one of
    eight, so the lead and its spread stand in the sentence. Rivals who did not take part are passed over.
    """
    present = {row.scorer for row in quality.rows}
    sentences = []
    for question in QUESTIONS:
        own = quality.row(subject, question)
        rows = [quality.row(rival, question) for rival in rivals if rival in present]
        rows.sort(key=lambda row: -float((row.values("auroc") - own.values("auroc")).mean()))
        sentences += [said for row in rows if (said := _lead(row, own))]
    return tuple(sentences)


def _lead(row: Row, own: Row) -> str | None:
    leads = []
    for measure in RANKING:
        ahead = row.values(measure) - own.values(measure)
        if np.all(ahead > 0):
            figures = f"{spread(row.values(measure))} against {spread(own.values(measure))}"
            leads.append(f"{LABELS[measure]} {figures} (+{ahead.mean():.3f}, at least +{ahead.min():.3f})")
    if not leads:
        return None
    return (
        f"{WORDS[own.question]}, {row.scorer} beats {own.scorer} under all {len(own.seeds)} seeds: {'; '.join(leads)}."
    )


def spread(values: Array) -> str:
    """Mean and standard deviation over the seeds, `.931 ± .011`; of one seed the value alone."""
    mean = _short(float(values.mean()))
    return mean if len(values) < 2 else f"{mean} ± {_short(float(values.std(ddof=1)))}"


def _short(value: float) -> str:
    return f"{value:.3f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.3f}"


def text(quality: QualityTable) -> str:
    """The table as Markdown, a part per question."""
    lines = []
    for question in QUESTIONS:
        lines += [f"**{WORDS[question]}**", "", "| score | " + " | ".join(LABELS[m] for m in MEASURES) + " |"]
        lines.append("|---" * (1 + len(MEASURES)) + "|")
        for row in quality.rows:
            if row.question == question:
                lines.append(f"| {row.scorer} | " + " | ".join(spread(row.values(m)) for m in MEASURES) + " |")
        lines.append("")
    return "\n".join(lines)
