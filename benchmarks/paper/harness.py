"""The harness of the studies: one resumable store, one table, one command line.

A study is a list of units, each with the keys of the rows that it computes, and a function from rows to tables. Rows
are JSON lines: each is appended when it is complete, so the same command continues after an interruption. Equal keys
mean equal results: a key ends with a hash of everything that a result depends on.
"""

import hashlib
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple  # values of JSON

import msgspec
import numpy as np
from rich.console import Console

from fleet.errors import FleetError
from scenarios.evaluate.statistics import Interval, interval
from scenarios.json_rows import Row, Rows
from scenarios.progress import brief
from scenarios.spec.load import load
from scenarios.spec.schema import Scenario
from scenarios.table import Table

WIDEST = 240
"""Characters of a printed line."""
KeyedRows = Iterable[tuple[str, Mapping[str, Any]]]


class Unit(NamedTuple):
    """Rows that are computed together, because they share for example the jobs of an arm."""

    keys: tuple[str, ...]
    compute: Callable[[Collection[str]], KeyedRows]
    """Rows of some of the keys, each with its key, one by one."""


def table_of(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> Table:
    """A table of texts."""
    return Table(head=tuple(head), rows=tuple(map(tuple, rows)), caption=caption)


def mean_by_group(values: Iterable[tuple[str, float]], *, least: float = -np.inf, most: float = np.inf) -> Interval:
    """The interval of the mean over groups that each have some values, such as an arm under several seeds.

    The groups are the sample; of a single group, its values are.

    Args:
        values: Name of the group, and a value of it.
        least, most: As in `interval`.
    """
    groups = dict[str, list[float]]()
    for name, value in values:
        groups.setdefault(name, []).append(value)
    several = list(groups.values())
    return interval([np.mean(each) for each in several] if len(several) > 1 else several[0], least=least, most=most)


def mean_share(values: Iterable[tuple[str, float]], *, measure: str = "") -> Interval:
    """As `mean_by_group`, of shares or of a measure of ranking, `auroc`, `auprc` or `spearman`."""
    return mean_by_group(values, least=-1.0 if measure == "spearman" else 0.0, most=1.0)


def no_options(parser: ArgumentParser) -> None:
    """Options of a study without options."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One study of the paper."""

    help: str
    """What it measures, and how long it takes."""
    units: Callable[[Namespace], Sequence[Unit]]
    """Its work with these options."""
    tables: Callable[[Sequence[Row]], Mapping[str, Table]]
    """Tables by name, from some of its rows."""
    options: Callable[[ArgumentParser], None] = no_options


def content_key(*basis: Any) -> str:
    """Hash of the values that a result depends on (Any: what msgspec can encode)."""
    return hashlib.sha256(msgspec.json.encode(list(basis))).hexdigest()[:12]


def one_row(key: str, compute: Callable[[], Mapping[str, Any]]) -> Unit:
    """A unit of a single row."""
    return Unit((key,), lambda _: [(key, compute())])


def compute(units: Sequence[Unit], rows: Rows, **mark: str) -> None:
    """Append the missing rows of the units.

    Args:
        mark: What every row says, too.

    Raises:
        FleetError: the file cannot be written, or an error of the study.
    """
    rows.check_writable()
    missing = [(unit, [key for key in unit.keys if key not in rows]) for unit in units]
    began_s, done, total = monotonic(), 0, sum(len(keys) for _, keys in missing)
    for unit, keys in missing:
        for key, row in unit.compute(keys) if keys else ():
            rows.append(key, mark | plain(row))
            done += 1
            print(f"{done} of {total} rows, {brief(monotonic() - began_s)}: {key}", file=sys.stderr, flush=True)


def plain(row: Mapping[str, Any]) -> Row:
    """The values of JSON; numbers that are not finite become None."""

    def of_numpy(value: Any) -> Any:
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else _unknown(value)

    return msgspec.json.decode(msgspec.json.encode(row, enc_hook=of_numpy))


def _unknown(value: object) -> Any:
    raise NotImplementedError(f"A row cannot hold a {type(value).__name__}.")


def number(value: float | None) -> float:
    """A number of a row; NaN for None."""
    return float("nan") if value is None else float(value)


def matching(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """The rows with these values."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def main(studies: Mapping[str, Callable[[], Experiment]], argv: Sequence[str] | None = None) -> None:
    """Run a study by its name: compute the missing rows, and print the tables.

    Errors that the user can correct are one sentence and exit code 2.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    if not given or given[0] not in studies:
        names = "\n".join(f"  {name:16} {study().help.splitlines()[0]}" for name, study in studies.items())
        asked_for_help = given[:1] in ([], ["-h"], ["--help"])
        print(f"usage: python -m benchmarks.paper STUDY [options]\n\n{names}\n\nSTUDY --help lists its options.")
        if not asked_for_help:
            print(f"Error: no study '{given[0]}'. Name one of those above.", file=sys.stderr)
        raise SystemExit(0 if asked_for_help else 2)
    name = given[0]
    try:
        run(name, studies[name](), given[1:])
    except FleetError as error:
        print(f"Error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("Interrupted; the same command continues from the rows that are in the file.", file=sys.stderr)
        raise SystemExit(130) from None


def run(name: str, study: Experiment, argv: Sequence[str]) -> None:
    """Compute the missing rows of a study and print its tables; `main` without its treatment of errors."""
    parser = ArgumentParser(
        prog=f"python -m benchmarks.paper {name}", description=study.help, formatter_class=RawDescriptionHelpFormatter
    )
    study.options(parser)
    out = Path(f"runs/paper/{name}.jsonl")
    parser.add_argument("--out", type=Path, default=out, help=f"file of the rows, which is continued [{out}]")
    parser.add_argument("--show", action="store_true", help="compute nothing: print the rows of the file")
    given = parser.parse_args(argv)
    units, rows = study.units(given), Rows(given.out)
    if others := {row.get("study", name) for row in rows.by_key.values()} - {name}:
        raise FleetError(
            f"'{given.out}' has rows of the study {', '.join(sorted(others))}: name another file with --out."
        )
    if not given.show:
        compute(units, rows, study=name)
    wanted = rows.some(key for unit in units for key in unit.keys)
    if not wanted:
        raise FleetError(
            f"'{given.out}' has no such row. Give the options with which its rows were computed, or leave out --show "
            "to compute them."
        )
    with rows.readable():
        tables = study.tables(wanted).values()
    console = Console(width=WIDEST, highlight=False)
    for number, table in enumerate(tables):
        console.print(*[""] * (number > 0), table, sep="\n")
    print(f"The rows are in {given.out}.", file=sys.stderr)


def whole(least: int) -> Callable[[str], int]:
    """Converter of an option: a whole number that is not less.

    Raises:
        ArgumentTypeError: another text; the parser prints it with the name of the option.
    """

    def convert(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise ArgumentTypeError(f"must be a whole number from {least} (got '{text}')")
        return int(text)

    return convert


def nonnegative(text: str) -> float:
    """Converter of an option: a finite number from 0; raises as `whole`."""
    with suppress(ValueError):
        if 0 <= float(text) < np.inf:
            return float(text)
    raise ArgumentTypeError(f"must be a number from 0 (got '{text}')")


def wholes(text: str) -> list[int]:
    """Converter of an option: whole numbers from 0, separated by commas, each once; raises as `whole`."""
    return list(dict.fromkeys(whole(0)(part.strip()) for part in text.split(",")))


def names(text: str) -> list[str]:
    """Converter of an option: names separated by commas, each once."""
    return list(dict.fromkeys(part.strip() for part in text.split(",")))


def seed_options(parser: ArgumentParser, count: int, first: int = 1) -> None:
    """Add the options --seeds and --first-seed."""
    parser.add_argument("--seeds", type=whole(1), default=count, help=f"number of seeds [{count}]")
    parser.add_argument("--first-seed", type=whole(0), default=first, help=f"first seed [{first}]")


def seeds_of(given: Namespace) -> range:
    """The seeds of the options."""
    return range(given.first_seed, given.first_seed + given.seeds)


def scenarios_of(given: Sequence[str]) -> list[Scenario]:
    """The scenarios with these names or files."""
    return [load(name) for name in given]


def size_options(parser: ArgumentParser, size: type[Any]) -> None:
    """Add an option for each whole number of a size, such as --test; at least 1, or what its metadata say.

    Args:
        size: A dataclass (Any: of any study); its other fields have no options.
    """
    group = parser.add_argument_group("numbers of jobs, training steps and the like")
    for each in fields(size):
        default = each.default
        some = "+" if isinstance(default, tuple) else None
        if some or (isinstance(default, int) and not isinstance(default, bool)):
            text = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
            flag = f"--{each.name.replace('_', '-')}"
            least = each.metadata.get("least", 1)
            group.add_argument(flag, type=whole(least), nargs=some, metavar="N", help=f"[{text}]")


def size_given(given: Namespace, size: type[Any]) -> Any:
    """The size of the options that `size_options` added."""
    own = {each.name: getattr(given, each.name, None) for each in fields(size)}
    own = {name: tuple(value) if isinstance(value, list) else value for name, value in own.items() if value is not None}
    return size(**own)


def seeded(
    help_: str,
    size: type[Any],
    seeds: int,
    rows: Callable[[int, Any, Collection[str]], KeyedRows],
    tables: Callable[[Sequence[Row]], Mapping[str, Table]],
    parts: Sequence[str] = ("",),
) -> Experiment:
    """A study with a unit for each seed.

    Args:
        size: A dataclass of the numbers of jobs and the like.
        seeds: Number of seeds, which begin at 1.
        rows: Rows of a seed in a size, with the names of some of the parts.
        parts: Names of the rows of each seed.
    """

    def options(parser: ArgumentParser) -> None:
        seed_options(parser, seeds)
        size_options(parser, size)

    def units(given: Namespace) -> list[Unit]:
        chosen = size_given(given, size)
        basis = content_key(asdict(chosen))
        named = {seed: {f"{p}/{seed}/{basis}".lstrip("/"): p for p in parts} for seed in seeds_of(given)}
        return [Unit(tuple(keys), partial(_seed_rows, rows, seed, chosen, keys)) for seed, keys in named.items()]

    return Experiment(help=help_, options=options, units=units, tables=tables)


def _seed_rows(
    rows: Callable[[int, Any, Collection[str]], KeyedRows],
    seed: int,
    size: Any,
    keys: Mapping[str, str],
    missing: Collection[str],
) -> KeyedRows:
    key_of = {part: key for key, part in keys.items() if key in missing}
    for part, row in rows(seed, size, key_of):
        yield key_of[part], row
