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
HEAT, MOTION = "heat", "motion"
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
    told_of_heat: tuple[str, ...] = ()
    """Scorers that were given motor data and the thermal law; the others know motion alone."""

    def knows(self, scorer: str) -> str:
        """What a scorer was told: heat or motion."""
        return HEAT if scorer in self.told_of_heat else MOTION

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


def table(per_seed: Sequence[Judged], told_of_heat: Sequence[str] = ()) -> QualityTable:
    """What was found under several seeds, side by side.

    Args:
        told_of_heat: Names of scorers that know more than motion, as `QualityTable.told_of_heat`.

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
        told_of_heat=tuple(told_of_heat),
    )


def _asked(scores: Scores, question: str) -> Array:
    return scores.total if question.endswith("total") else scores.per_joint[:, CARRIER]


def _truth(peak_c: Array, question: str) -> Array:
    return peak_c.max(axis=1) if question.startswith("any") else peak_c[:, CARRIER]


def verdicts(quality: QualityTable, subject: str, rivals: Sequence[str]) -> tuple[str, ...]:
    """Who beats the subject, who ties with it and whom it beats: a sentence per question and kind of knowledge.

    One is ahead of the other in a measure if it is under every seed; between equals chance alone does so in one of
    four times with three seeds. Whatever changes sides from seed to seed is a tie. Rivals who did not take part are
    passed over.
    """
    present = [rival for rival in rivals if any(row.scorer == rival for row in quality.rows)]
    groups = [(kind, [rival for rival in present if quality.knows(rival) == kind]) for kind in (MOTION, HEAT)]
    return tuple(
        _verdict(quality, question, subject, kind, some) for question in QUESTIONS for kind, some in groups if some
    )


def _verdict(quality: QualityTable, question: str, subject: str, kind: str, rivals: Sequence[str]) -> str:
    own = quality.row(subject, question)
    rows = sorted((quality.row(rival, question) for rival in rivals), key=lambda row: -_mean_lead(row, own, "auroc"))
    said: dict[str, list[str]] = {"is beaten by": [], "is partly beaten by": [], "ties with": [], "beats": []}
    for row in rows:
        leads = {m: _mean_lead(row, own, m) for m in RANKING if _sides(row, own, m)}
        if not leads:
            said["ties with"].append(row.scorer)
        elif max(leads.values()) < 0:
            said["beats"].append(row.scorer)
        else:
            way = "is beaten by" if min(leads.values()) > 0 else "is partly beaten by"
            said[way].append(f"{row.scorer} ({_leads(leads)})")
    told = "know motion alone" if kind == MOTION else "were told of motors and heat"
    found = ". It ".join(f"{way} {_listed(names)}" for way, names in said.items() if names)
    return f"{WORDS[question]}? Among those that {told}, {subject} {found}."


def _leads(leads: dict[str, float]) -> str:
    """What the one has more than the other, and then what less: `AUROC +.020, but Spearman −.100`."""
    more, less = (
        ", ".join(f"{LABELS[m]} {sign}{_short(abs(lead))}" for m, lead in leads.items() if (lead > 0) == (sign == "+"))
        for sign in ("+", "−")
    )
    return f"{more}, but {less}" if less else more


def _mean_lead(row: Row, own: Row, measure: str) -> float:
    return float((row.values(measure) - own.values(measure)).mean())


def _sides(row: Row, own: Row, measure: str) -> bool:
    """Whether the same one is ahead under every seed, by what the table shows."""
    ahead = np.round(row.values(measure) - own.values(measure), 3)
    return bool(np.all(ahead > 0) or np.all(ahead < 0))


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + f" and {names[-1]}"


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
        lines += [f"**{WORDS[question]}**", "", "| score | knows | " + " | ".join(LABELS[m] for m in MEASURES) + " |"]
        lines.append("|---" * (2 + len(MEASURES)) + "|")
        for row in quality.rows:
            if row.question == question:
                told = (row.scorer, quality.knows(row.scorer), *(spread(row.values(m)) for m in MEASURES))
                lines.append("| " + " | ".join(told) + " |")
        lines.append("")
    return "\n".join(lines)
