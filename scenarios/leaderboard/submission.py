"""One result file: a policy on all instances of a split, with what is needed to repeat and to check it."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from fleet.bus.exchange.channel import PERFECT
from fleet.engine.observe import PEAK_HIGH_C, PEAK_LOW_C
from fleet.errors import FleetError, printable
from fleet.files import atomic_path
from scenarios.bounds.references import Reference
from scenarios.policy_loader import is_built_in, is_on_bus, label, scope_of
from scenarios.prepare.fleet import RiskName
from scenarios.prepare.randomisation import Randomisation
from scenarios.result_folder import disk_errors
from scenarios.run.decision_limit import DECISION_LIMIT_S
from scenarios.run.evaluate import COUNTS, FIGURES, Outcome
from scenarios.schema import SplitName
from scenarios.suite.cells import JUDGED
from scenarios.suite.splits import Row as Line
from scenarios.suite.splits import cell_of_instance, line_of, manifest
from scenarios.trials.cases import suite_of
from scenarios.trials.plan import CARD, Key, Row
from scenarios.trials.scores import Shift, references_of

FORMAT = 1
DIGITS = 10
"""Significant digits of figures in a file."""
MOST_BYTES = 1_000_000
MOST_TRAININGS = 20
SLACK = 1e-6
"""By which a reward may exceed an upper bound, as a share, for rounding."""
NEEDED = ("python", "thermofleet", "numpy", "numba", "scipy")
"""Versions that a result must state."""
MOST_FIGURE = 1e9
MOST_LOSS = 100.0
"""Least possible reward: this many times the way from random to the upper bound, below random."""
SHOWN = 3
"""Problems that an error names."""
Text = Annotated[str, msgspec.Meta(max_length=200)]
PLAIN = r"^[^\x00-\x1f\x7f-\x9f|<>`\u2028\u2029\ud800-\udfff]*$"
"""Text of a table: no control characters, and no | < > `."""
Name = Annotated[str, msgspec.Meta(max_length=200, pattern=PLAIN)]
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]


class Card(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The first line of a file."""

    format: Literal[1]
    policy: Annotated[str, msgspec.Meta(min_length=1, max_length=80, pattern=PLAIN)]
    difficulty: Literal["twin", "oracle", "blind"]
    split: SplitName
    scope: Literal["arm", "central"]
    trainings: Annotated[int, msgspec.Meta(ge=1, le=MOST_TRAININGS)]
    """Trainings of the policy, or else of the twins; each has a row for every instance."""
    author: Annotated[str, msgspec.Meta(min_length=1, max_length=200, pattern=PLAIN)]
    about: Name
    """What the policy is, and where it can be had."""
    manifest: Hash
    """Of the split."""
    code_hash: Hash
    policy_hash: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{16})?$")]
    """Of the policy's files; "" if it belongs to the code, or ran in another process."""
    risk: RiskName
    versions: dict[str, str | None]


class Played(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The other lines: one shift each."""

    instance: str
    scenario: Hash
    """As in the manifest."""
    seed: int
    training: Annotated[int, msgspec.Meta(ge=0, lt=MOST_TRAININGS)]
    figures: list[float] | None
    """In the order of `FIGURES`; None if the policy failed, which counts as the mean of random."""
    illegal: Annotated[int, msgspec.Meta(ge=0)]
    error: Text | None = None


class Submission(msgspec.Struct, frozen=True, kw_only=True):
    """A result file."""

    card: Card
    rows: tuple[Played, ...]

    @property
    def name(self) -> str:
        """Of its file, without the ending."""
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "-", self.card.policy).strip("-.")
        return f"{self.card.split}-{plain}-{self.card.difficulty}"

    @property
    def title(self) -> str:
        """Its policy in a table, as Markdown."""
        more = f", {self.card.trainings} trainings" if self.card.trainings > 1 else ""
        return f"`{self.card.policy}`{more}"

    @property
    def failures(self) -> int:
        """Shifts in which the policy failed."""
        return sum(row.figures is None for row in self.rows)

    def mean(self, figure: str) -> float:
        """Mean of a figure over the shifts that did not fail."""
        place = FIGURES.index(figure)
        return sum(row.figures[place] for row in self.rows if row.figures) / max(1, len(self.rows) - self.failures)

    def study_rows(self) -> list[Row]:
        """As a study has them."""
        return [
            Row(
                Key(self.card.policy, row.instance, 0, row.training, self.card.difficulty, row.seed),
                None if row.figures is None else Outcome(**dict(zip(FIGURES, row.figures, strict=True))),
                row.illegal,
                row.error,
            )
            for row in self.rows
        ]


def manifest_hash(split: str) -> str:
    """Hash of all lines of a split's manifest."""
    return hashlib.sha256("\n".join(map(line_of, manifest(split))).encode()).hexdigest()[:16]


def split_references(split: str) -> dict[Shift, Reference]:
    """The references of a split that come with the package."""
    return references_of(suite_of(split, 1))


def played_of(row: Row, scenario: str) -> Played:
    """The line of a row of a study."""
    figures = None
    if row.outcome is not None:
        figures = [float(f"{value:.{DIGITS}g}") for value in asdict(row.outcome).values()]
    key = row.key
    return Played(
        instance=key.instance,
        scenario=scenario,
        seed=key.seed,
        training=key.training,
        figures=figures,
        illegal=row.illegal,
        error=row.error and row.error[:200],
    )


def problems(submission: Submission, references: Mapping[Shift, Reference]) -> Iterator[str]:
    """What is wrong with a result, in sentences; nothing if it can be accepted.

    Args:
        references: Of its split: no reward exceeds an upper bound.
    """
    card, rows = submission.card, submission.rows
    lines = {line.name: line for line in manifest(card.split)}
    if (is_built_in(card.policy) or is_on_bus(card.policy)) == bool(card.policy_hash):
        yield (
            f"its policy '{card.policy}' must be built-in and have no hash, or have another name and one "
            "(bus:NAME has none)"
        )
    if card.manifest != manifest_hash(card.split):
        yield f"its manifest of the split {card.split} is another one (hash {card.manifest})"
    missing = [name for name in NEEDED if not card.versions.get(name)]
    if missing:
        yield f"it does not state the versions of {', '.join(missing)}"
    found = {(row.instance, row.training) for row in rows}
    wanted = {(name, training) for name in lines for training in range(card.trainings)}
    if len(found) < len(rows):
        yield f"{len(rows) - len(found)} shifts are given twice"
    if wanted - found:
        name, training = min(wanted - found)
        yield f"{len(wanted - found)} of {len(wanted)} shifts are missing, the first {name}, training {training}"
    if found - wanted:
        yield f"{len(found - wanted)} shifts are not of the split {card.split}, the first {min(found - wanted)[0]}"
    for row in rows:
        line = lines.get(row.instance)
        if line:
            yield from (f"{row.instance} {what}" for what in _of_shift(row, line, references))


def _of_shift(row: Played, line: Line, references: Mapping[Shift, Reference]) -> Iterator[str]:
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
    if not 0 <= own["on_time"] <= own["finished"] <= line.count:
        yield f"has {own['finished']:g} finished jobs, {own['on_time']:g} on time, of {line.count}"
    if min(value for name, value in own.items() if name not in ("reward", "peak_c")) < 0 or own["availability"] > 1:
        yield "has a figure below 0, or an availability above 1"
    if any(own[name] % 1 for name in COUNTS):
        yield f"has counts that are no whole numbers ({', '.join(COUNTS)})"
    cell = cell_of_instance(line)
    longest_min = 60.0 * cell.hours * cell.arms
    if max(own["above_warning_min"], own["hot_surface_min"]) > longest_min + SLACK:
        yield f"has more minutes above a limit than its arms work ({longest_min:g})"
    if not PEAK_LOW_C <= own["peak_c"] <= PEAK_HIGH_C:
        yield f"has a hottest motor of {own['peak_c']:g} °C, not within {PEAK_LOW_C:g} to {PEAK_HIGH_C:g}"
    if own["reward"] > own["value"] + SLACK * (1 + own["value"]):
        yield f"has a reward of {own['reward']:.4g}, above the finished value {own['value']:.4g}: all else is a cost"
    known = references.get((row.instance, line.seed))
    if known and own["reward"] < (least := known.random - MOST_LOSS * (known.upper - known.random)):
        yield f"has a reward of {own['reward']:.4g}, below what the worst policy could lose ({least:.4g})"
    if known and own["reward"] > known.upper + SLACK * (1 + abs(known.upper)):
        yield f"has a reward of {own['reward']:.4g}, above the upper bound {known.upper:.4g}, which no policy exceeds"


def check(submission: Submission, references: Mapping[Shift, Reference]) -> None:
    """Check a result.

    Raises:
        FleetError: what is wrong.
    """
    wrong = list(problems(submission, references))
    if wrong:
        more = f"; and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        raise FleetError(f"The result '{submission.name}' is refused: {'; '.join(wrong[:SHOWN])}{more}.")


def write(submission: Submission, folder: Path) -> Path:
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


def read(path: Path) -> Submission:
    """A result file; `check` tells whether it is one that counts.

    Raises:
        FleetError: it is too large, or has a line that is none of ours.
    """
    number = 1
    try:
        if path.stat().st_size > MOST_BYTES:
            raise FleetError(f"'{path}': a result has at most {MOST_BYTES} bytes.")
        first, *rest = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
        card, rows = msgspec.json.decode(first, type=Card), list[Played]()
        for line in rest:
            number += 1
            rows.append(msgspec.json.decode(line, type=Played))
    except OSError as error:
        raise FleetError(f"Cannot read '{path}': {error.strerror}.") from error
    except (ValueError, msgspec.DecodeError) as error:
        why = f"line {number}: {printable(str(error))}"
        raise FleetError(f"'{path}' is no result of `thermofleet submit-result`: {why}.") from error
    return Submission(card=card, rows=tuple(rows))


def submissions_of(card: Mapping[str, Any], rows: Sequence[Row], author: str, about: str) -> list[Submission]:
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
    made: list[Submission] = []
    for split in splits:
        seeds = {line.name: line.seed for line in manifest(split)}
        by_policy: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row.key.fleet == 0 and seeds.get(row.key.instance) == row.key.seed:
                by_policy.setdefault((row.key.policy, row.key.difficulty), []).append(row)
        for (policy, difficulty), own in sorted(by_policy.items()):
            header = {
                "format": FORMAT, "policy": label(policy), "difficulty": difficulty, "split": split,
                "scope": scope_of(policy), "trainings": 1 + max(row.key.training for row in own), "author": author,
                "about": about, "manifest": manifest_hash(split), "code_hash": card["code_hash"],
                "policy_hash": card["policies"][policy], "risk": card["risk"], "versions": card["versions"],
            }  # fmt: skip
            try:
                head = msgspec.convert(header, Card)
            except msgspec.ValidationError as error:
                raise FleetError(f"The result of '{policy}' cannot be written: {error}.") from error
            lines = tuple(played_of(row, card["instances"][row.key.instance]) for row in own)
            made.append(Submission(card=head, rows=lines))
    return made


def read_card(out: Path) -> dict[str, Any]:
    """Content of a study's card (Any: JSON values).

    Raises:
        FleetError: it holds no study.
    """
    try:
        card = json.loads((out / CARD).read_text(encoding="utf-8"))
        if isinstance(card, dict):
            return card
        what = f"has a damaged {CARD}, which holds no object"
    except ValueError as error:
        what = f"has a damaged {CARD} ({error})"
    except OSError:
        what = "holds no study of `thermofleet compare --out`" if out.is_dir() else "is no folder"
    raise FleetError(f"'{out}' {what}; give the folder of such a command.")
