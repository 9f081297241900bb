"""The leaderboard: results of policies on a whole split, one file each, their check and their scores."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from fleet.bus.exchange.channel import PERFECT
from fleet.engine.batch import RewardWeights
from fleet.engine.observe import PEAK_HIGH_C
from fleet.errors import FleetError, distinguish, printable
from fleet.files import atomic_path
from fleet.robot import ThermalLimits
from fleet.seeding import shift_seeds
from scenarios.evaluate.references import ShiftReference
from scenarios.evaluate.rollout import FIGURES, KINDS, Outcome
from scenarios.evaluate.scores import Shift, SuiteScores, normalised, ranked, references_of, scores_of
from scenarios.evaluate.sources import ALL_SOURCES
from scenarios.evaluate.study import CARD, Row, RowKey, suite_of
from scenarios.policy_loader import is_built_in, is_on_bus, label, scope_of
from scenarios.prepare.randomisation import Randomisation
from scenarios.result_folder import disk_errors
from scenarios.spec.jobs import draw_jobs, weights_of
from scenarios.spec.options import DECISION_LIMIT_S, RiskName
from scenarios.spec.schema import SplitName
from scenarios.suite.instances import JUDGED
from scenarios.suite.splits import ManifestLine, cell_of_instance, instance_of, line_of, manifest

DIGITS = 10
"""Significant digits of figures in a file."""
MOST_BYTES = 1_000_000
MOST_TRAININGS = 20
SLACK = 1e-6
"""By which a reward may exceed an upper bound, as a share, for rounding."""
SLACK_K = 0.01
"""By which a temperature may differ from a limit, for rounding."""
NEEDED = ("python", "thermofleet", "numpy", "numba", "scipy")
"""Versions that a result must state."""
MOST_FIGURE = 1e9
MOST_LOSS = 100.0
"""Least possible reward: this many times the unit of the score, or the way from random to the upper bound, below
random."""
SHOWN = 3
"""Problems that an error names."""
PLAIN = r"^[^\x00-\x1f\x7f-\x9f|<>`\u2028\u2029\ud800-\udfff]*$"
"""Text of a table: no control characters, and no | < > `."""
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]


class Card(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The first line of a file."""

    format: Literal[1]
    policy: Annotated[str, msgspec.Meta(min_length=1, max_length=80, pattern=PLAIN)]
    difficulty: Annotated[str, msgspec.Meta(max_length=40)]
    """Source of the predictions, one of `scenarios.evaluate.sources.ALL_SOURCES`."""
    split: SplitName
    scope: Literal["arm", "central"]
    trainings: Annotated[int, msgspec.Meta(ge=1, le=MOST_TRAININGS)]
    """Trainings of the policy, or else of the twins; each has a row for every instance."""
    author: Annotated[str, msgspec.Meta(min_length=1, max_length=200, pattern=PLAIN)]
    about: Annotated[str, msgspec.Meta(max_length=200, pattern=PLAIN)]
    """What the policy is, and where it can be had."""
    manifest: Hash
    """Of the split."""
    code_hash: Hash
    policy_hash: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{16})?$")]
    """Of the policy's files; "" if it belongs to the code, or ran in another process."""
    risk: RiskName
    versions: dict[str, str | None]


class ResultLine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The other lines: one shift each."""

    instance: str
    scenario: Hash
    """As in the manifest."""
    seed: int
    training: Annotated[int, msgspec.Meta(ge=0, lt=MOST_TRAININGS)]
    figures: list[float] | None
    """In the order of `FIGURES`; None if the policy failed, which counts as the mean of random."""
    illegal: Annotated[int, msgspec.Meta(ge=0)]
    error: Annotated[str, msgspec.Meta(max_length=200)] | None = None


class BoardResult(msgspec.Struct, frozen=True, kw_only=True):
    """A result file."""

    card: Card
    rows: tuple[ResultLine, ...]

    @property
    def name(self) -> str:
        """Of its file, without the ending."""
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "-", self.card.policy).strip("-.")
        return f"{self.card.split}-{plain}-{self.card.difficulty}"

    @property
    def failures(self) -> int:
        """Shifts in which the policy failed."""
        return sum(row.figures is None for row in self.rows)

    @property
    def faults(self) -> float | None:
        """Mean over the shifts in which the policy did not fail; None if there is none."""
        values = [row.figures[FIGURES.index("faults")] for row in self.rows if row.figures]
        return sum(values) / len(values) if values else None

    @property
    def faults_text(self) -> str:
        """`faults` as a cell of a table."""
        return "" if self.faults is None else f"{self.faults:.2f}"

    def study_rows(self) -> list[Row]:
        """As a study has them."""
        return [
            Row(
                RowKey(self.card.policy, row.instance, 0, row.training, self.card.difficulty, row.seed),
                None if row.figures is None else Outcome(**dict(zip(FIGURES, row.figures, strict=True))),
                row.illegal,
                row.error,
            )
            for row in self.rows
        ]


def manifest_hash(split: str) -> str:
    """Hash of all lines of a split's manifest."""
    return hashlib.sha256("\n".join(map(line_of, manifest(split))).encode()).hexdigest()[:16]


def split_references(split: str) -> dict[Shift, ShiftReference]:
    """The references of a split that come with the package."""
    return references_of(suite_of(split, 1))


def result_line(row: Row, scenario: str) -> ResultLine:
    """The line of a row of a study."""
    figures = None
    if row.outcome is not None:
        figures = [float(f"{value:.{DIGITS}g}") for value in asdict(row.outcome).values()]
    key = row.key
    return ResultLine(
        instance=key.instance,
        scenario=scenario,
        seed=key.seed,
        training=key.training,
        figures=figures,
        illegal=row.illegal,
        error=row.error and row.error[:200],
    )


def check(submission: BoardResult, references: Mapping[Shift, ShiftReference]) -> None:
    """Check a result.

    Args:
        references: Of its split: no reward exceeds an upper bound.

    Raises:
        FleetError: what is wrong.
    """
    wrong = [*_problems_of_card(submission), *_problems_of_shifts(submission, references)]
    if wrong:
        more = f"; and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        raise FleetError(f"The result '{submission.name}' is refused: {'; '.join(wrong[:SHOWN])}{more}.")


def _problems_of_card(submission: BoardResult) -> Iterator[str]:
    card = submission.card
    if (is_built_in(card.policy) or is_on_bus(card.policy)) == bool(card.policy_hash):
        yield (
            f"its policy '{card.policy}' must be built-in and have no hash, or have another name and one "
            "(bus:NAME has none)"
        )
    elif not card.policy_hash and card.scope != (scope := scope_of(card.policy)):
        yield f"its scope is {scope}, as that of every `{card.policy}` (got {card.scope})"
    if card.difficulty not in ALL_SOURCES:
        yield f"its predictions are of no source '{card.difficulty}'"
    if card.manifest != manifest_hash(card.split):
        yield f"its manifest of the split {card.split} is another one (hash {card.manifest})"
    missing = [name for name in NEEDED if not card.versions.get(name)]
    if missing:
        yield f"it does not state the versions of {', '.join(missing)}"


def _problems_of_shifts(submission: BoardResult, references: Mapping[Shift, ShiftReference]) -> Iterator[str]:
    split, lines = submission.card.split, {line.name: line for line in manifest(submission.card.split)}
    given = {(row.instance, row.training) for row in submission.rows}
    wanted = {(name, training) for name in lines for training in range(submission.card.trainings)}
    if len(given) < len(submission.rows):
        yield f"shifts given twice: {len(submission.rows) - len(given)}"
    if wanted - given:
        name, training = min(wanted - given)
        yield f"{len(wanted - given)} of {len(wanted)} shifts are missing, the first {name}, training {training}"
    if given - wanted:
        yield f"shifts not of the split {split}: {len(given - wanted)}, the first {min(given - wanted)[0]}"
    for row in submission.rows:
        if line := lines.get(row.instance):
            problems = _problems_of_shift(row, line, references.get((row.instance, line.seed)))
            yield from (f"{row.instance} {what}" for what in problems)


def _problems_of_shift(row: ResultLine, line: ManifestLine, known: ShiftReference | None) -> Iterator[str]:
    if row.scenario != line.scenario:
        yield f"was another scenario (hash {row.scenario}, in the manifest {line.scenario})"
    if row.seed != line.seed:
        yield f"has seed {line.seed} (got {row.seed})"
    if (row.figures is None) != (row.error is not None):
        yield "needs either figures or an error"
    if row.figures is None:
        return
    if len(row.figures) != len(FIGURES) or not all(abs(value) <= MOST_FIGURE for value in row.figures):
        yield f"needs {len(FIGURES)} figures of at most {MOST_FIGURE:g}"
        return
    own = dict(zip(FIGURES, row.figures, strict=True))
    counts = [name for name, kind in KINDS.items() if kind.is_count]
    cell = cell_of_instance(line)
    longest_min, reward = 60.0 * cell.hours * cell.arms, own["reward"]
    if not 0 <= own["on_time"] <= own["finished"] <= line.count:
        yield f"has {own['finished']:g} finished jobs, {own['on_time']:g} on time, of {line.count}"
    if any(value < KINDS[name].least or value > KINDS[name].most for name, value in own.items()):
        yield "has a figure below 0, or an availability above 1"
    if any(own[name] % 1 for name in counts):
        yield f"has counts that are no whole numbers ({', '.join(counts)})"
    if max(own["above_warning_min"], own["hot_surface_min"]) > longest_min + SLACK:
        yield f"has more minutes above a limit than its arms work ({longest_min:g})"
    limits = _limits_of(line)
    bound = min(max(own["peak_c"], limits.ambient_c), float(PEAK_HIGH_C))
    if abs(own["peak_c"] - bound) > SLACK:
        peak, _ = distinguish(own["peak_c"], bound)
        yield f"has a hottest motor of {peak} °C, not within {limits.ambient_c:g} to {PEAK_HIGH_C:g}"
    least, most = limits.value_of(int(own["finished"]))
    bound = min(max(own["value"], least), most)
    if abs(own["value"] - bound) > SLACK * most:
        value, limit = distinguish(own["value"], bound)
        at = "least" if own["value"] < bound else "most"
        yield f"has a finished value of {value}, but {own['finished']:g} of its jobs have at {at} {limit}"
    weights = limits.weights
    costs = -weights.faults * own["faults"] - weights.above_warning * own["above_warning_min"]
    if reward > (net := own["value"] - costs) + SLACK * (1 + own["value"] + costs):
        given, bound = distinguish(reward, net)
        yield (
            f"has a reward of {given}, above {bound}: the finished value {own['value']:.4g} less {costs:.4g} for "
            "faults and minutes above the warning limit; all else is a cost"
        )
    if known and reward < (worst := known.random - MOST_LOSS * max(known.unit, known.upper - known.random)):
        yield "has a reward of {}, below what the worst policy could lose ({})".format(*distinguish(reward, worst))
    if known and reward > known.upper + SLACK * (1 + abs(known.upper)):
        yield "has a reward of {}, above the upper bound {}, which no policy exceeds".format(
            *distinguish(reward, known.upper)
        )
    yield from _problems_of_heat(own, limits.heat)


def _problems_of_heat(own: Mapping[str, float], heat: ThermalLimits) -> Iterator[str]:
    """What is impossible, as only heat stops arms of the suite."""
    faults, minutes, peak_c = own["faults"], own["above_warning_min"], own["peak_c"]
    for what, happened, limit_c in (
        (f"{faults:g} fault{'s' * (faults != 1)}, which come at", faults > 0, heat.error_c),
        (f"{minutes:.4g} min above the warning limit of", minutes > 0, heat.warning_c),
    ):
        if peak_c < limit_c - SLACK_K if happened else peak_c > limit_c + SLACK_K:
            peak, limit = distinguish(peak_c, limit_c)
            yield f"has {what} {limit} °C, but a hottest motor of {peak} °C"
    if not faults and own["availability"] < 1 - SLACK:
        yield f"has no faults, but an availability of {own['availability']:.9g}, which only faults lower"


@dataclass(frozen=True)
class _Limits:
    """What the jobs, the reward, and the limits and ambient temperature of an instance allow."""

    values: tuple[float, ...]
    """Of its jobs, the least first."""
    weights: RewardWeights
    heat: ThermalLimits
    ambient_c: float
    """Lowest ambient temperature."""

    def value_of(self, count: int) -> tuple[float, float]:
        """Least and most value that this number of its jobs can have."""
        return sum(self.values[:count]), sum(self.values[max(len(self.values) - count, 0) :])


@cache
def _limits_of(line: ManifestLine) -> _Limits:
    made = instance_of(line)
    jobs = draw_jobs(made.scenario, shift_seeds(np.random.SeedSequence(made.seed))[0])
    coolest_c = min(ambient_c for _, ambient_c in made.scenario.ambient.points)
    values = tuple(sorted(job.value for job in jobs))
    return _Limits(values, weights_of(made.scenario), made.scenario.limits, coolest_c)


def write(submission: BoardResult, folder: Path) -> Path:
    """Write the file of a result, and return its path.

    Raises:
        FleetError: it is too large, cannot be written, or would replace the result of another author.
    """
    lines = [msgspec.json.encode(each).decode() for each in (submission.card, *submission.rows)]
    content = "\n".join(lines) + "\n"
    if len(content.encode()) > MOST_BYTES:
        raise FleetError(f"The file of '{submission.name}' would be larger than {MOST_BYTES} bytes: fewer trainings.")
    path = folder / f"{submission.name}.jsonl"
    if path.exists() and (other := read(path).card.author) != submission.card.author:
        raise FleetError(f"'{path}' has a result of {other}; give another --out, or your policy another name.")
    with disk_errors(path):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as draft:
            draft.write_text(content, encoding="utf-8")
    return path


def read(path: Path) -> BoardResult:
    """A result file; `check` tells whether it is one that counts.

    Raises:
        FleetError: it is too large, or a line is no part of a result.
    """
    number, line = 1, ""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise FleetError(f"'{path}': a result has at most {MOST_BYTES} bytes.")
        line, *rest = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
        card, rows = msgspec.json.decode(line, type=Card), list[ResultLine]()
        for line in rest:
            number += 1
            rows.append(msgspec.json.decode(line, type=ResultLine))
    except OSError as error:
        raise FleetError(f"Cannot read '{path}': {error.strerror}.") from error
    except (ValueError, msgspec.DecodeError) as error:
        why = f"line {number}: {printable(_problem_text(error, line))}"
        raise FleetError(f"'{path}' is no result of `thermofleet leaderboard --submit`: {why}.") from error
    return BoardResult(card=card, rows=tuple(rows))


def _problem_text(error: Exception, line: str = "") -> str:
    """What is wrong with a line, without regular expressions."""
    named = re.search(r"NaN|-?Infinity", line)
    if named and not isinstance(error, msgspec.ValidationError):
        return f"{error}: {named[0]} is no number of JSON"
    text = str(error).replace(f"matching regex {PLAIN!r}", "without control characters and | < > `")
    return re.sub(r"matching regex '.*'", "of 16 hexadecimal digits", text)


def submissions_of(card: Mapping[str, Any], rows: Sequence[Row], author: str, about: str) -> list[BoardResult]:
    """A result for each policy and source of scores in the folder of a study; not yet checked.

    Shifts of other fleets, of other instances and with other seeds than the split's are left out.

    Args:
        card: Content of study.json (Any: JSON values).

    Raises:
        FleetError: the study is not finished, of other settings than the leaderboard's, or of no split.
    """
    if card.get("status") != "finished":
        raise FleetError("The study is not finished; run the same command of `thermofleet compare` again.")
    usual = json.loads(json.dumps({"channel": PERFECT.described(), "randomise": asdict(Randomisation())}))
    if any(card[name] != value for name, value in usual.items()):
        raise FleetError("Results of the leaderboard have no randomisation, and the bus of each instance.")
    if card["decision_limit_s"] is None or card["decision_limit_s"] > DECISION_LIMIT_S:
        raise FleetError(f"Results of the leaderboard have a decision limit of at most {DECISION_LIMIT_S:g} s.")
    splits = sorted({name.partition("/")[0] for name in card["instances"] if "/" in name} & set[str](JUDGED))
    if not splits:
        raise FleetError("The study has no instance of a split that policies are judged on; compare with --suite test.")
    made: list[BoardResult] = []
    for split in splits:
        seeds = {line.name: line.seed for line in manifest(split)}
        by_policy: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row.key.fleet == 0 and seeds.get(row.key.instance) == row.key.seed:
                by_policy.setdefault((row.key.policy, row.key.difficulty), []).append(row)
        for (policy, difficulty), own in sorted(by_policy.items()):
            header = {
                "format": 1, "policy": label(policy), "difficulty": difficulty, "split": split,
                "scope": scope_of(policy), "trainings": 1 + max(row.key.training for row in own), "author": author,
                "about": about, "manifest": manifest_hash(split), "code_hash": card["code_hash"],
                "policy_hash": card["policies"][policy], "risk": card["risk"], "versions": card["versions"],
            }  # fmt: skip
            try:
                head = msgspec.convert(header, Card)
            except msgspec.ValidationError as error:
                raise FleetError(f"The result of '{policy}' cannot be written: {_problem_text(error)}.") from error
            lines = tuple(result_line(row, card["instances"][row.key.instance]) for row in own)
            made.append(BoardResult(card=head, rows=lines))
    return made


def failed_text(count: int) -> str:
    """That a policy failed in shifts, as the end of a sentence; "" for none."""
    return f", {count} failed shift{'s' * (count > 1)}, which count as random" if count else ""


BASELINE, SOURCE = "wsept", "twin"
"""Policy that differences refer to, with the predictions of this source if it has several; without it the last of the
board."""


@dataclass(frozen=True, kw_only=True)
class Board:
    """The results on one split, the best first."""

    split: str
    scores: SuiteScores
    """By name of the submission."""
    entries: Mapping[str, BoardResult]
    instances: int
    """Of the split."""

    @property
    def order(self) -> list[str]:
        """Names of the submissions, the best first."""
        return ranked(self.scores)

    def as_json(self) -> dict[str, Any]:
        """The scores, with mean faults and failed shifts of each submission (Any: JSON values)."""
        described = asdict(self.scores)
        for name, entry in self.entries.items():
            described["policies"][name] |= {"faults": entry.faults, "failed": entry.failures}
        return described

    @property
    def summary(self) -> str:
        """The policy with the highest mean score of each scope, in a sentence."""
        best: dict[str, str] = {}
        for name in self.order:
            card, failed = self.entries[name].card, failed_text(self.entries[name].failures)
            best.setdefault(card.scope, f"`{card.policy}` ({self.scores.policies[name].mean.text()}{failed})")
        texts = [f"{scope} {best[scope]}" for scope in ("central", "arm") if scope in best]
        return f"Highest mean score of scope {', of scope '.join(texts)}."

    @property
    def remark(self) -> str:
        """What a reader must know of the results."""
        scores, base = self.scores, self.entries[self.scores.baseline].card
        remark = (
            f"{scores.instances} of {self.instances} instances; differences to `{base.policy}` ({base.difficulty}). "
            f"Mean score of the hindsight: {scores.reachable}."
        )
        if missing := self.instances - scores.instances:
            remark += f" {missing} have no reference yet and are not scored."
        if len({each.card.code_hash for each in self.entries.values()}) > 1:
            remark += " Results are of several versions of the code."
        return remark


def read_all(folder: Path, split: str) -> list[BoardResult]:
    """The checked results of a split in a folder, by the names of their files.

    Raises:
        FleetError: a file is no result, or one that is refused, or has the name of another, or of no split.
    """
    if (folder / CARD).exists():
        raise FleetError(
            f"'{folder}' is a folder of `thermofleet compare`; run `thermofleet leaderboard --submit` with it first."
        )
    references, found = split_references(split), list[BoardResult]()
    for path in sorted(folder.glob("*.jsonl")):
        if (named := path.stem.partition("-")[0]) not in JUDGED:
            raise FleetError(
                f"'{path}' must have the name that `thermofleet leaderboard --submit` gives, "
                f"SPLIT-POLICY-PREDICTIONS.jsonl with SPLIT {', '.join(JUDGED)}."
            )
        if named != split:
            continue
        submission = read(path)
        if path.stem != submission.name:
            raise FleetError(f"'{path}' must have the name of its policy and split, {submission.name}.jsonl.")
        check(submission, references)
        found.append(submission)
    return found


def board_of(split: str, submissions: Sequence[BoardResult]) -> Board | None:
    """The board of a split; None without results or without references.

    A failed shift counts as the mean of random.
    """
    entries = {each.name: each for each in submissions}
    rows = {name: each.study_rows() for name, each in entries.items()}
    values = normalised(rows, split_references(split), failed_as_random=True)
    if values is None:
        return None
    bases = [name for name, each in entries.items() if (each.card.policy, each.card.policy_hash) == (BASELINE, "")] or [
        min(entries, key=lambda name: values.score[name].mean())
    ]
    base = next((name for name in bases if entries[name].card.difficulty == SOURCE), bases[0])
    return Board(split=split, scores=scores_of(values, base), entries=entries, instances=len(manifest(split)))
