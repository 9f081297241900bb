"""Write the generated parts of the docs: tables of the pages, JSON schemas and AsyncAPI document of the bus.

    python docs/tables.py            # writes what is not current
    python docs/tables.py --check    # only names it, with exit code 1

A page marks a table by `<!-- made by docs/tables.py: NAME -->` and `<!-- end -->`. Each table is a function without
arguments from the code or from files in `docs/results` to Markdown; `TABLES` has all of them by name.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, get_args  # Any: values of JSON

import numpy as np
from msgspec.structs import replace

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [path for path in (str(ROOT), str(ROOT / "docs")) if path not in sys.path]

from reference_tables import TABLES as REFERENCE

from agents.learned.evolution import read_log
from agents.registry import RULES
from benchmarks.alarms import stored_table
from benchmarks.knowledge import MOST_ARMS
from benchmarks.paper.__main__ import study
from benchmarks.result_tables import (
    FIGURES as ABLATION_FIGURES,
)
from benchmarks.result_tables import (
    bold_if,
    channel_table,
    difference,
    env_ratios_table,
    env_table,
    halls_table,
    processor_sentence,
    read_json,
    signed,
    steps_table,
    stored,
)
from docs.bus_contract import asyncapi, schema_document
from fleet.errors import FleetError
from scenarios.evaluate.leaderboard import (
    BASELINE,
    SOURCE,
    BoardResult,
    board_of,
    read,
    read_all,
    split_references,
)
from scenarios.evaluate.references import load_references, reference_table
from scenarios.evaluate.rollout import FIGURES, KINDS
from scenarios.evaluate.scores import Normalised, SuiteScores, normalised, ranked, score_cells, scores_of, split_file
from scenarios.evaluate.statistics import LEVEL, Interval, holm, unit
from scenarios.json_rows import Rows
from scenarios.policy_loader import trainings_of
from scenarios.spec.schema import SPLITS, SurpriseKind
from scenarios.suite.instances import FAULTS, JUDGED, Bus
from scenarios.suite.splits import cell_name, cell_of_instance, heat_binds, instance, manifest
from scenarios.table import markdown_table as table

Array = np.ndarray
Tables = Mapping[str, Callable[[], str]]
"""Text of each table by the name in its mark."""

MARK = re.compile(r"(<!-- made by [^:>]+: (?P<name>\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
DOCS = ROOT / "docs"

NAMED = ("faults", "value", "on_time", "reward", "hot_surface_min")
"""Figures of the table of named scenarios; those that are 0 everywhere are left out."""
SOURCES = {"oracle": "true state", "twin": "identified network, corrected"}
"""Score sources of the measured table, by the end of the file's name."""


def ladder(results: Path) -> str:
    """Rewards and their differences to the baseline, a column for each file, the best mean of the first file first."""
    files = {path.stem: read_json(path) for path in sorted(results.glob("*_*.json"))}
    head = ["policy"]
    for stem, one in files.items():
        scores = SOURCES[stem.removeprefix(f"{one['scenario']}_")]
        head.append(f"`{one['scenario']}`, {scores}")
    first = next(iter(files.values()))["figures"]
    order = sorted(first, key=lambda policy: -first[policy]["reward"]["mean"])
    rows = [(f"`{name}`", *(cell(one, name) for one in files.values())) for name in order]
    return table(tuple(head), rows)


def cell(comparison: dict[str, Any], policy: str) -> str:
    figures = comparison["figures"][policy]
    reward, faults = figures["reward"], figures["faults"]["mean"]
    some = f"; {faults:.2f} faults" if faults else ""
    if policy == comparison["baseline"]:
        return f"{reward['mean']:.1f}{some}"
    return difference(*(reward[name] for name in ("difference", "difference_low", "difference_high"))) + some


def named(results: Path) -> str:
    """Mean and difference of several figures, a column for each policy."""
    files = [read_json(path) for path in sorted(results.glob("*.json"))]
    rows: list[tuple[str, ...]] = []
    for one in files:
        figures = one["figures"]
        for figure in NAMED:
            own = {policy: figures[policy][figure] for policy in figures}
            if any(each["mean"] for each in own.values()):
                base = one["baseline"]
                cells = [mean_cell(each, is_base=policy == base) for policy, each in own.items()]
                rows.append((f"`{one['scenario']}`: {KINDS[figure].heading}", *cells))
    return table(("", *(f"`{policy}`" for policy in files[0]["figures"])), rows)


def mean_cell(figure: dict[str, Any], *, is_base: bool) -> str:
    text = f"{figure['mean']:.1f}"
    if is_base:
        return text
    low, high = figure["difference_low"], figure["difference_high"]
    if low is None:
        return f"{text} ({signed(figure['difference'])})"
    own = Interval(figure["difference"], low, high)
    stars = own.stars(1.0 if figure["p_holm"] is None else figure["p_holm"]).replace("*", "\\*")
    return f"{text} ({signed(own.mean)}) {stars}".rstrip()


def decisions(measured: dict[str, Any]) -> str:
    rows = [(f"`{row['policy']}`", row["scope"], f"{row['median_ms']:.2f}") for row in measured["rows"]]
    return table(("policy", "scope", "median, ms of CPU time"), rows)


def references_text() -> str:
    """A line for each split: how its references were found, and how far their two bounds are apart, as Markdown."""
    rows: list[tuple[str, ...]] = []
    for split in SPLITS:
        found = list(split_references(split).values())
        rows.append(
            (
                split,
                f"{len(found)} of {len(manifest(split))}",
                span([each.evaluations for each in found]),
                span([each.nodes for each in found]),
                f"{median(each.gap for each in found):.2f}",
                f"{median(each.normalised(each.best_rule) for each in found):.2f}",
            )
        )
    heads = (
        "split",
        "instances",
        "shifts of the last search",
        "nodes",
        "gap, median",
        "score of the best starting policy, median",
    )
    return table(heads, rows)


def span(numbers: Sequence[int]) -> str:
    least, most = min(numbers), max(numbers)
    return f"{least}" if least == most else f"{least} to {most}"


def benchmark_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table of docs/leaderboard.md and docs/bounds.md by the name in its mark.

    Args:
        results: docs/results.
    """

    return {
        "bounds": lambda: reference_table(load_references(results / "bounds_library.jsonl")).markdown(),
        "references": references_text,
        "leaderboard_questions": partial(by_question, results / "leaderboard"),
        "leaderboard_bus": partial(by_bus, results / "leaderboard"),
        "leaderboard_top": partial(board_top, results / "leaderboard"),
        "leaderboard_knowledge": partial(knowledge, results / "leaderboard"),
        "leaderboard_fresh": partial(fresh, results / "fresh.json"),
        "leaderboard_planners": partial(planners, results / "leaderboard"),
        "leaderboard_surprises": partial(surprises, results / "fresh.json"),
        **{f"leaderboard_{split}": partial(board_text, results / "leaderboard", split) for split in JUDGED},
    }


BOARD = ("", "policy", "scope", "mean score", "difference", "heat binds", "it does not", "true state", "IQM",
         "better in", "faults", "failed", "by", "code")  # fmt: skip


def with_source(results: Sequence[BoardResult], source: str) -> list[BoardResult]:
    """The results with predictions from one source."""
    return [each for each in results if each.card.difficulty == source]


def scores_by_name(found: Mapping[str, BoardResult], split: str) -> Normalised:
    """Scores of results on a split."""
    rows = {name: each.study_rows() for name, each in found.items()}
    values = normalised(rows, split_references(split), failed_as_random=True)
    assert values is not None
    return values


def true_state(results: Sequence[BoardResult], split: str) -> dict[str, str]:
    """Mean score with exact predictions by policy, as far as there are results."""
    found = {each.card.policy: each for each in with_source(results, "oracle")}
    return {name: f"{score.mean():.2f}" for name, score in scores_by_name(found, split).score.items()} if found else {}


def plans(entry: BoardResult) -> bool:
    """Whether the policy of a result plans in a simulator."""
    return entry.card.policy in RULES and RULES[entry.card.policy].plans


def board_text(folder: Path, split: str) -> str:
    """The leaderboard of a split: what is best of each scope, the table of policies, that of planners, and a remark."""
    results = read_all(folder, split)
    board = board_of(split, with_source(results, SOURCE) or results)
    if board is None:
        return f"No results on the split {split}."
    exact = true_state(results, split)
    groups: dict[bool, list[tuple[str, ...]]] = {False: [], True: []}
    for name in board.order:
        entry, (mean, difference_, stars, *rest) = board.entries[name], score_cells(board.scores, name)
        card, stars, place = entry.card, stars.replace("*", "\\*"), str(len(groups[plans(entry)]) + 1)
        known = exact.get(card.policy, "")
        cells = (place, title(entry), card.scope, mean, f"{difference_} {stars}".strip(), *rest[:2], known, *rest[2:])
        more = (entry.faults_text, str(entry.failures or ""), card.author, f"`{card.code_hash[:8]}`")
        groups[plans(entry)].append((*cells, *more))
    parts = [board.summary, table(BOARD, groups[False])]
    if groups[True]:
        parts += ["Policies with a simulator of the cell:", table(BOARD, groups[True])]
    return "\n\n".join([*parts, board.remark])


SHOWN = 8
"""Rows of the leaderboard in README."""


def board_top(folder: Path) -> str:
    """The best policies of the test split without a simulator and the two that all scores refer to, for README."""
    results = read_all(folder, "test")
    board, exact = board_of("test", with_source(results, SOURCE)), true_state(results, "test")
    assert board is not None
    rows: list[tuple[str, ...]] = []
    for place, name in enumerate((name for name in board.order if not plans(board.entries[name])), start=1):
        entry, score = board.entries[name], board.scores.policies[name]
        if place <= SHOWN or entry.card.policy in ("wspt", "random"):
            hot, cool = (f"{each.mean:.2f}" if each else "" for each in (score.hot, score.cool))
            cells = (title(entry), entry.card.scope, score.mean.text(), hot, cool, entry.faults_text)
            rows.append((str(place), *cells, exact.get(entry.card.policy, "")))
    heads = ("", "policy", "scope", "mean score", "heat binds", "it does not", "faults", "true state")
    return f"{table(heads, rows)}\n\nMean score of the hindsight: {board.scores.reachable}."


KNOWLEDGE = {
    "blind": "nothing",
    "torque-alone": "no thermometers, regression on squared torque",
    "untrained-alone": "no thermometers, regression on errors of the untrained twin",
    "trained-alone": "no thermometers, regression on errors of the twin",
    "torque": "thermometers, regression on squared torque",
    "untrained": "thermometers, regression on errors of the untrained twin",
    "trained": "thermometers, regression on errors of the twin",
    "rc-nominal": "thermometers, nominal thermal network",
    "rc": "thermometers, identified network",
    "twin": "the same, corrected by measured heat and temperatures",
    "oracle": "true state",
}
"""States of knowledge by source, the least first. The first two with d and P(saturation) have no thermal network."""


def known_scores(folder: Path) -> tuple[dict[str, BoardResult], Normalised]:
    """Results of the best rule by its source of predictions, and their scores; see `common_scores`."""
    return common_scores(folder, {name: (CENTRAL, name) for name in KNOWLEDGE})


def common_scores(folder: Path, wanted: Mapping[str, tuple[str, str]]) -> tuple[dict[str, BoardResult], Normalised]:
    """Results by name, as far as they are stored, and their scores, in the instances that all of them have.

    Args:
        folder: The leaderboard; beside it is the folder `knowledge` with results on a part of the split.
        wanted: Policy and source of predictions of each.
    """
    results = [*read_all(folder, "test"), *map(read, sorted((folder.parent / "knowledge").glob("*.jsonl")))]
    by_card = {(each.card.policy, each.card.difficulty): each for each in results}
    found = {name: by_card[which] for name, which in wanted.items() if which in by_card}
    common = set.intersection(*({row.instance for row in each.rows} for each in found.values()))
    some = {
        name: replace(each, rows=tuple(row for row in each.rows if row.instance in common))
        for name, each in found.items()
    }
    return some, scores_by_name(some, "test")


PLANNERS = {
    "`mpc` that knows of no heat": ("WithoutHeat", "rc"),
    "`mpc` with the identified network": ("mpc", "rc"),
    "the same, corrected by measured heat and temperatures": ("mpc", "twin"),
    "`mpc` with the true network and state": ("mpc", "oracle"),
    "`bid_price` with the identified network, corrected": ("bid_price", "twin"),
}
"""Rows of the table of planners: policy and source of predictions; the first policy is of benchmarks/mpc_parts.py."""


def planners(folder: Path) -> str:
    """Scores of `mpc` by what its simulator knows of heat, and of the best rule."""
    found, values = common_scores(folder, PLANNERS)
    kind = surprise_where_heat_binds(values)
    parts = (kind == kind, kind != "", ~np.isin(kind, ("", "nothing")), kind == "")
    rows = [
        (
            name,
            *(values.only(part).interval(values.only(part).score[name]).text() for part in parts),
            found[name].faults_text,
        )
        for name in found
    ]
    return table(("policy", "mean score", "heat binds", "heat binds, surprise", "it does not", "faults"), rows)


def surprise_where_heat_binds(values: Normalised) -> Array:
    """What surprises the arms in each instance of the test split; "" where heat does not bind."""
    kinds = {line.name: line.axes.surprise for line in manifest("test")}
    return np.array([kinds[name] if heat_binds(name) else "" for name in values.instances])


def knowledge(folder: Path) -> str:
    """Scores of one policy by what its arms know, and the share of the gain from nothing to the true state."""
    found, values = known_scores(folder)
    kind = surprise_where_heat_binds(values)
    hot, surprised = kind != "", ~np.isin(kind, ("", "nothing"))
    rows: list[tuple[str, ...]] = []
    for name in found:
        own = (values, values.only(hot), values.only(surprised))
        means = [each.interval(each.score[name]).text() for each in own]
        some = [share_of_gain(each, name) for each in own[1:]]
        rows.append((KNOWLEDGE[name], f"`{name}`", *means, *some, found[name].faults_text))
    heads = ("the arms know", "source", "mean score", "heat binds", "heat binds, surprise", "share of the gain")
    count = (
        f"{len(values.instances)} instances in {len(set(values.cells))} cells; heat binds in {int(hot.sum())}, "
        f"{int(surprised.sum())} of them with a surprise. Mean score of the hindsight: {values.reachable}."
    )
    if {"trained-alone", "torque-alone", "untrained-alone"} <= found.keys():
        count += f" Where heat binds, without thermometers, {twin_against_rivals(values.only(hot))}."
    trainings = {name: found[name].card.trainings for name in found if found[name].card.trainings > 1}
    if trainings:
        listed = ", ".join(f"`{name}`" for name in trainings)
        count += f" Mean of {min(trainings.values())} trainings of every arm's twin: {listed}."
    return table((*heads, "share, surprise", "faults"), rows) + f"\n\n{count}"


def twin_against_rivals(values: Normalised) -> str:
    """Score of the errors of the twin as a feature, less that of the simpler ones."""
    others = {"torque-alone": "squared torque", "untrained-alone": "errors of the untrained twin"}
    gains = [values.difference("trained-alone", name) for name in others]
    adjusted = holm([gain.p for gain in gains]).tolist()
    texts = [
        f"less {what} {bold_if(p < 1 - LEVEL, gain.text(3))} (p = {gain.p:.3f}, {p:.3f} after Holm's correction)"
        for what, gain, p in zip(others.values(), gains, adjusted, strict=True)
    ]
    return f"errors of the twin {' and '.join(texts)}"


@dataclass(frozen=True)
class FreshShifts:
    """Results of benchmarks/knowledge.py on fresh shifts of the instances in which heat binds."""

    values: Normalised
    """By source; the zero and the unit of an instance are those of its shift of the split."""
    faults: dict[str, Array]
    """By source, [instance]."""
    seeds: int
    trainings: int

    @classmethod
    def read(cls, file: Path) -> "FreshShifts":
        """From the file of the benchmark."""
        found: dict[str, dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))
        references = {each.instance: each for each in load_references(split_file("test"))}
        own = {name: references[name] for name in found["blind"]["reward"]}
        values = Normalised(
            instances=tuple(own),
            cells=tuple(map(cell_name, own)),
            score={
                source: np.array([[each.normalised(of_source["reward"][name]) for name, each in own.items()]])
                for source, of_source in found.items()
            },
            hindsight=np.array([each.normalised(each.hindsight) for each in own.values()]),
        )
        faults = {source: np.array([each["faults"][name] for name in own]) for source, each in found.items()}
        return cls(values, faults, found["blind"]["seeds"], found["trained-alone"]["trainings"])


def fresh(file: Path) -> str:
    """As `knowledge`, on fresh shifts."""
    results = FreshShifts.read(file)
    values = results.values
    surprised = ~np.isin(surprise_where_heat_binds(values), ("", "nothing"))
    parts = values, values.only(surprised)
    rows = [
        (
            meaning,
            f"`{source}`",
            *(shown(part.difference(source, "blind")) for part in parts),
            *(share_of_gain(part, source) for part in parts),
            *(f"{results.faults[source][chosen].mean():.2f}" for chosen in (surprised | True, surprised)),
        )
        for source, meaning in KNOWLEDGE.items()
        if source in values.score
    ]
    heads = ("the arms know", "source", "score, less `blind`", "the same, surprise", "share of the gain",
             "share, surprise", "faults", "faults, surprise")  # fmt: skip
    corrected = [shown(part.difference("twin", "rc")) for part in parts]
    return table(heads, rows) + (
        f"\n\n{len(surprised)} instances in {len(set(values.cells))} cells, {int(surprised.sum())} of them with a "
        f"surprise; {results.seeds} fresh shifts each, {results.trainings} trainings of every arm's twin. Without "
        f"thermometers, {twin_against_rivals(values)}. Corrected less identified network {corrected[0]}, with a "
        f"surprise {corrected[1]}. With `twin`, `bid_price` less `wsept` {shown(values.difference('twin', 'wsept'))}, "
        f"less `bid_price_shared` {shown(values.difference('twin', 'bid_price_shared'))}."
    )


def share_of_gain(values: Normalised, name: str) -> str:
    """Share of the gain from `blind` to `oracle` that a source has, with the interval of shares that are not refuted.

    A share r is refuted if the interval of (score − blind) − r (oracle − blind) excludes 0 (Fieller's method).
    """
    if name in ("blind", "oracle"):
        return f"{float(name == 'oracle'):.0f}"
    gain, whole = (values.score[each] - values.score["blind"] for each in (name, "oracle"))

    def refuted(share: float) -> bool:
        return values.interval(gain - share * whole).excludes_zero

    best, ends = float(gain.mean() / whole.mean()), list[float]()
    for direction in (-1.0, 1.0):
        near, far = best, best + 3.0 * direction
        for _ in range(30):
            middle = (near + far) / 2.0
            near, far = (near, middle) if refuted(middle) else (middle, far)
        ends.append(near)
    return f"{best:.2f} [{ends[0]:.2f}, {ends[1]:.2f}]"


def surprises(file: Path) -> str:
    """Faults and scores on fresh shifts by what surprises the arms, of the networks with and without corrections."""
    results = FreshShifts.read(file)
    kind = surprise_where_heat_binds(results.values)
    parts = {each: kind == each for each in ("nothing", *get_args(SurpriseKind))}
    parts["any of these"] = kind != "nothing"
    rows: list[tuple[str, ...]] = []
    for name, chosen in parts.items():
        own = results.values.only(chosen)
        faults = {source: results.faults[source][chosen] for source in ("rc", "twin", "oracle")}
        fewer = own.interval((faults["twin"] - faults["rc"])[None])
        counts = [f"{each.mean():.2f}" for each in faults.values()]
        gains = [shown(own.difference(source, "rc")) for source in ("twin", "oracle")]
        rows.append((name, f"{len(own.instances)} in {len(set(own.cells))}", *counts, shown(fewer), *gains))
    heads = ("surprise", "instances in cells", "faults, network", "faults, corrected", "faults, true state",
             "corrected less network", "score, corrected less network", "score, true state less network")  # fmt: skip
    return table(heads, rows)


CENTRAL, ALONE, BLIND = "bid_price", "wsept_local", "wspt"
"""The best central rule, the best with which each arm decides alone, and one that ignores heat."""


def by_question(folder: Path) -> str:
    """Worth of knowing the heat, of one decision for all arms, and of prices, by what cells ask and level of heat."""
    found, values = scored(folder, "test")
    lines = {line.name: line for line in manifest("test")}
    level = np.array([lines[name].axes.heat for name in values.instances])
    asks = np.array([cell_of_instance(lines[name]).asks for name in values.instances])
    parts = {f"advantage, {each}": (asks == "advantage") & (level == each) for each in FAULTS}
    parts["advantage, heat binds"] = (asks == "advantage") & (level != "cool")
    parts |= {f"control: {each}": asks == each for each in dict.fromkeys(asks.tolist()) if each != "advantage"}
    rows: list[tuple[str, ...]] = []
    for name, chosen in parts.items():
        own = values.only(chosen)
        means = (f"{own.score[policy].mean():.2f}" for policy in (CENTRAL, ALONE, BLIND))
        pairs = (ALONE, BLIND), (BASELINE, ALONE), (CENTRAL, ALONE)
        gains = (shown(own.difference(*pair)) for pair in pairs)
        quiet = [each for each in own.instances if lines[each].axes.surprise == "nothing"]
        count = " (".join(f"{faults_in(found[BLIND], some).mean():.2f}" for some in (own.instances, quiet)) + ")"
        rows.append((name, str(len(own.instances)), count, *means, *gains))
    heads = (
        "cells, heat",
        "instances",
        f"faults of `{BLIND}` (no surprise)",
        *(f"`{each}`" for each in (CENTRAL, ALONE, BLIND)),
    )
    return table((*heads, "knowing the heat", "one decision", "prices"), rows)


BY_MESSAGES = "bid_price_shared"
"""The best rule by messages."""


def by_bus(folder: Path) -> str:
    """Worth of messages by the bus of the instances, with exact predictions and with those of the source `twin`."""
    bus = {line.name: line.axes.bus for line in manifest("test")}
    by_source = [scored(folder, "test", source)[1] for source in ("oracle", SOURCE)]
    rows: list[tuple[str, ...]] = []
    for kind in get_args(Bus):
        cells: list[str] = []
        for values in by_source:
            own = values.only(np.array([bus[name] == kind for name in values.instances]))
            cells += [f"{own.score[policy].mean():.2f}" for policy in (BY_MESSAGES, ALONE)]
            cells.append(shown(own.difference(BY_MESSAGES, ALONE)))
        rows.append((kind, str(sum(each == kind for each in bus.values())), *cells))
    policies = (f"`{BY_MESSAGES}`", f"`{ALONE}`", "difference")
    sources = ("true state", "corrected network (`twin`)")
    heads = (f"{each}, {source}" for source in sources for each in policies)
    return table(("bus", "instances", *heads), rows)


def title(entry: BoardResult) -> str:
    """The policy of a result."""
    more = f", {entry.card.trainings} trainings" if entry.card.trainings > 1 else ""
    return f"`{entry.card.policy}`{more}"


def faults_in(entry: BoardResult, instances: Sequence[str]) -> Array:
    """Faults in instances of a result of one training without failures, [instance]."""
    index = FIGURES.index("faults")
    by_instance = {row.instance: row.figures[index] for row in entry.rows if row.figures}
    return np.array([by_instance[each] for each in instances])


ABLATED = ("heat_wave", "active_waiting")
WRAPPED = {"wspt": "wspt@blind", "wsept": "wsept@rc"}
"""Policies of the table of wrappers, with their sources."""
DIGITS = {"faults": 2}
"""Decimals of a figure; 1 for others."""


def ablated(folder: str, results: Path) -> dict[str, Path]:
    """Folders of stored ablations by scenario, as far as there are some."""
    return {name: path for name in ABLATED if (path := results / folder.format(name)).is_dir()}


def ablation_rows(folder: Path, names: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
    """Heading and cells of every figure: the mean of the first source and differences to it."""
    effects = stored(folder).effects(names[0])
    for key in ABLATION_FIGURES:
        digits = DIGITS.get(key, 1)
        cells = [f"{effects[names[0]][key].mean:.{digits}f}"]
        for name in names[1:]:
            f = effects[name][key] if name in effects else None
            cells.append(difference(f.difference, f.difference_low, f.difference_high, digits) if f else "–")
        yield KINDS[key].heading, cells


def sizes_text(folders: Mapping[str, Path]) -> str:
    """A line on the numbers of fleets, trainings and seeds."""
    return "\n\n" + "; ".join(f"`{name}`: {unit(stored(each).shape)}" for name, each in folders.items()) + "."


def wrappers_table(folders: Mapping[str, Path]) -> str:
    """Every policy of `WRAPPED`, bare and in the two wrappers."""
    rows: list[tuple[str, ...]] = []
    for policy, bare in WRAPPED.items():
        for name, folder in folders.items():
            some = ablation_rows(folder, (bare, f"limited:{bare}", f"fuzzy:{bare}"))
            rows += [(f"`{policy}`, `{name}`: {heading}", *cells) for heading, cells in some]
    return table(("policy, scenario", "bare", "`limited:`", "`fuzzy:`"), rows) + sizes_text(folders)


TEST_SIZES: Mapping[str, Callable[[Array], Array]] = {
    "4 to 8 arms": lambda arms: arms <= MOST_ARMS,
    "16 to 64 arms": lambda arms: arms > MOST_ARMS,
}
"""Groups of instances by their numbers of arms."""


def trainings_table(folder: Path) -> str:
    """Scores in validation of the trainings in a folder: at the beginning, and the best."""
    rows: list[tuple[str, ...]] = []
    for training in map(Path, trainings_of(str(folder / "train-pairs-*"))):
        log = read_log(training)
        validated = [row for row in log if "validation" in row]
        best = max(validated, key=lambda row: row["validation"])
        iterations = max(row.get("number", 0) for row in log)
        scores = (validated[0]["validation"], best["validation"], validated[-1]["validation"])
        rows.append((training.name.rpartition("-")[2], str(iterations), *(f"{score:.3f}" for score in scores)))
    return table(("training", "iterations", "`bid_price`, the beginning", "best", "last"), rows)


def scored(folder: Path, split: str, source: str = "oracle") -> tuple[dict[str, BoardResult], Normalised]:
    """The results on a split by policy, with exact predictions or from another source, and their scores."""
    found = {each.card.policy: each for each in with_source(read_all(folder, split), source)}
    return found, scores_by_name(found, split)


def shown(difference: Interval, digits: int = 2) -> str:
    """A difference with its interval, bold if that excludes 0."""
    return bold_if(difference.excludes_zero, difference.text(digits))


def by_size(folder: Path, split: str, groups: Mapping[str, Callable[[Array], Array]]) -> str:
    """Differences of normalised scores to the best rule on a split: on all instances, and by numbers of arms."""
    found, values = scored(folder, split)
    arms = np.array([len(instance(name).scenario.arms) for name in values.instances])
    parts: dict[str, SuiteScores] = {}
    for name, chosen in {"all instances": np.ones_like, **groups}.items():
        own = values.only(chosen(arms).astype(bool))
        parts[f"{name} ({len(own.instances)} in {len(set(own.cells))} cells)"] = scores_of(own, CENTRAL)
    rows: list[tuple[str, ...]] = []
    for name in ranked(next(iter(parts.values()))):
        cells = [title(found[name])]
        for scores in parts.values():
            cells.append("" if name == CENTRAL else shown(scores.policies[name].difference))
        rows.append((*cells, found[name].faults_text))
    return table(("policy", *parts, "faults"), rows)


def workers_table(path: Path) -> str:
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        took = (f"{one['median_s'][name]:.0f}" for name in ("one", "two"))
        rows.append((one["what"], str(one["shifts"]), *took, f"{one['speed_up']:.2f}", f"{one['limit']:.2f}"))
    return table(("workers", "shifts", "one, s", "two, s", "speed-up", "two loops that share nothing"), rows)


def commands_table(folder: Path) -> str:
    measured = json.loads((folder / "commands.json").read_text(encoding="utf-8"))
    rows = [
        (
            re.sub("^[^,]+", r"`\g<0>`", each["command"]),  # as `show`, plans included
            f"{each['cpu_s']:.0f}",
            f"{each['wall_s']:.0f}",
            f"{each['most_mb'] / 1000:.2f}",
        )
        for each in measured["commands"]
    ]
    return table(("command", "CPU s", "s", "memory, GB"), rows)


def coverage_by_law(path: Path) -> str:
    measured = json.loads(path.read_text(encoding="utf-8"))
    rows = [(law, *map(coverage_cell, cells)) for law, cells in measured["laws"].items()]
    return table(("values", *(f"n = {n}" for n in measured["seeds"])), rows)


def coverage_by_limit(path: Path) -> str:
    measured = json.loads(path.read_text(encoding="utf-8"))
    rows = [(law, *map(coverage_cell, cells)) for law, cells in measured["limited"].items()]
    return table(
        ("values", *("no limit" if limit == "none" else f"limit {limit}" for limit in measured["limits"])), rows
    )


def coverage_cell(measured: Mapping[str, float]) -> str:
    return f"{measured['share']:.3f} ({measured['width']:.2f})"


def coverage_by_clusters(path: Path) -> str:
    measured = json.loads(path.read_text(encoding="utf-8"))
    samples = measured["sizes"] | measured["cells"]
    rows = [(sample, *(f"{share:.3f}" for share in shares)) for sample, shares in samples.items()]
    return table(("fleets × trainings × seeds", "normal effects", "exponential effects"), rows)


PAPER = {
    "readings": ("readings_any", "readings_joint"),
    "sides": ("sides",),
    "forms": ("forms",),
    "surprises": ("surprises",),
    "questions": ("questions_25s", "questions_6s"),
    "forecast": ("forecast",),
    "amounts": ("amounts",),
    "sweep": ("sweep",),
    "parsimony": ("parsimony",),
    "transfer": ("transfer_errors", "transfer_savings"),
    "features": ("features_r2",),
    "augmentation": ("augmentation_errors",),
    "drift": ("drift_delays", "drift_costs"),
    "cooling": ("cooling_motor", "cooling_joint", "cooling_active_waiting", "cooling_heat_wave"),
}
"""Tables of the studies of the paper that stand in pages, each from `docs/results/paper/STUDY.jsonl`."""


def paper_table(name: str, which: str, results: Path) -> str:
    """A table of a study of the paper, from all of its stored rows."""
    rows = [*Rows(results / f"paper/{name}.jsonl").by_key.values()]
    return study(name).tables(rows)[which].markdown()


def tables_of(results: Path) -> Tables:
    """Every table of the pages, by the name in its mark.

    Args:
        results: docs/results.
    """

    def of(make: Callable[..., str], *given: Any) -> Callable[[], str]:
        return lambda: make(*given)

    def of_file(make: Callable[[Any], str], path: str) -> Callable[[], str]:
        return lambda: make(read_json(results / path))

    board, scaling = results / "leaderboard", results / "scaling"
    return {
        **REFERENCE,
        "ladder": of(ladder, results / "ladder"),
        "named_scenarios": of(named, results / "named"),
        "decisions": of_file(decisions, "ladder/decisions.json"),
        "steps": of_file(steps_table, "steps.json"),
        "env_rows": of_file(env_table, "env.json"),
        "env_ratios": of_file(env_ratios_table, "env.json"),
        "processors": of_file(processor_sentence, "processors.json"),
        **{
            f"channels_{path.stem}": of_file(channel_table, f"channels/{path.name}")
            for path in results.glob("channels/*.json")
        },
        "coverage": of(coverage_by_law, results / "coverage.json"),
        "coverage_limits": of(coverage_by_limit, results / "coverage.json"),
        "coverage_clusters": of(coverage_by_clusters, results / "coverage.json"),
        **benchmark_tables(results),
        "trainings": of(trainings_table, results / "learned"),
        "leaderboard_sizes": of(by_size, board, "test", TEST_SIZES),
        "workers": of(workers_table, scaling / "workers.jsonl"),
        "growing_halls": of(halls_table, scaling / "arms.jsonl"),
        "large_fleet": of(commands_table, scaling),
        "wrappers_measured": lambda: wrappers_table(ablated("wrappers/{}", results)),
        **{which: of(stored_table, which, results / "alarms.jsonl") for which in ("alarms", "alarms_before_faults")},
        **{which: of(paper_table, name, which, results) for name, several in PAPER.items() for which in several},
    }


def fill_tables(page: str, tables: Tables | None = None) -> str:
    """Replace every marked part of a page; by default from `docs/results`.

    Raises:
        FleetError: a mark names an unknown table.
    """
    known = tables_of(DOCS / "results") if tables is None else tables

    def fill(match: re.Match[str]) -> str:
        if match["name"] not in known:
            raise FleetError(f"Unknown table '{match['name']}' in the page. Allowed: {', '.join(known)}.")
        return f"{match[1]}\n{known[match['name']]()}\n\n{match[3]}"

    return MARK.sub(fill, page)


def documents(docs: Path) -> dict[Path, str]:
    """Text of every generated document by path, and of every page with marks."""
    tables = tables_of(docs / "results")
    contract = {"schemas.json": schema_document(), "asyncapi.json": asyncapi()}
    made = {
        docs / "contract" / name: json.dumps(each, indent=1, ensure_ascii=False) + "\n"
        for name, each in contract.items()
    }
    paths = [*([docs.parent / "README.md"] if docs == DOCS else []), *sorted(docs.rglob("*.md"))]
    pages = {page: page.read_text(encoding="utf-8") for page in paths}
    return made | {page: fill_tables(text, tables) for page, text in pages.items() if MARK.search(text)}


def main(argv: list[str] | None = None) -> int:
    """Write the documents that are not current, or with --check name them; 1 if there are some then."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only check whether the documents are current")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the pages, with results and contract")
    given = parser.parse_args(argv)
    made = documents(given.docs)
    stale = [path for path, text in made.items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    names = ", ".join(map(str, stale))
    if given.check:
        print(
            f"Not current: {names}. Run: python docs/tables.py" if stale else f"Current: {', '.join(map(str, made))}."
        )
        return int(bool(stale))
    (given.docs / "contract").mkdir(parents=True, exist_ok=True)
    for path in stale:
        path.write_text(made[path], encoding="utf-8")
    print(f"Written: {names}." if stale else "All documents were current.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
