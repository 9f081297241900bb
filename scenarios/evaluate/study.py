"""What a study runs: every policy on every instance, fleet, training and seed, with every source of predictions."""

import hashlib
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import product
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.learned.cards import check_recipe
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError, nearest
from fleet.fields import MAX_SEED
from fleet.seeding import child
from scenarios.evaluate.rollout import FIGURES, DecisionLimit, Outcome, TooSlow
from scenarios.evaluate.sources import ALL_SOURCES, check_source, drawn, is_trained, preparations
from scenarios.policy_loader import OWN_PACKAGES, is_on_bus, label, policy_of, source_of, trainings_of
from scenarios.prepare.randomisation import Randomisation, randomisation_of
from scenarios.run.log import code_hash, versions_of
from scenarios.spec.load import INSTANCE, SPLITS, library, load
from scenarios.spec.options import StudySpec
from scenarios.spec.parse import scenario_hash
from scenarios.spec.schema import Scenario
from scenarios.suite.splits import Instance, instance, split

CARD = "study.json"
"""File of a study with its plan, in the folder of its results."""
TOGETHER = 16
"""Shifts of a policy that are stepped side by side."""
_LIBRARIES = ("thermofleet", "numpy", "numba", "scipy", "mujoco", "torch")


@dataclass(frozen=True, kw_only=True)
class Case:
    """An instance: one scenario, and the seeds of its shifts."""

    name: str
    scenario: Scenario
    seeds: tuple[int, ...]


def seeds_of_instance(seed: int, count: int) -> tuple[int, ...]:
    """The seed of an instance of a suite, and others made of it, so that no two instances share a draw by accident."""
    more = [int(child(np.random.SeedSequence([seed, 2]), k).generate_state(1)[0]) for k in range(1, count)]
    return (seed, *more)


class RowKey(NamedTuple):
    """Which shift a row is of."""

    policy: str
    instance: str
    fleet: int
    """Draw of the arms: `spread.seed` of the scenario plus this."""
    training: int
    """Training of the policy if it has several, else of the twins; from 0."""
    difficulty: str
    seed: int


@dataclass(frozen=True)
class Row:
    """The result of one shift."""

    key: RowKey
    outcome: Outcome | None
    """None if the policy failed."""
    illegal: int = 0
    """Illegal actions of all arms."""
    error: str | None = None
    """What went wrong, in a sentence."""
    trace: str | None = None
    """Last lines of the traceback."""


@dataclass(frozen=True)
class Unit:
    """Some shifts that one process runs at once."""

    policy: str
    case: Case
    """With the seeds of this unit only."""
    fleet: int
    training: int
    difficulty: str
    """Source of predictions."""
    played: str = ""
    """The policy itself, or the one of its trainings."""
    twins: int = 0
    """Training of the twins."""
    cell: int = field(default=-1, compare=False)
    """Number of what its plans depend on (`scenarios.evaluate.sources.plan_content`); default: of each instance."""

    @property
    def keys(self) -> list[RowKey]:
        """The rows it gives."""
        of = (self.policy, self.case.name, self.fleet, self.training, self.difficulty)
        return [RowKey(*of, seed) for seed in self.case.seeds]

    @property
    def scenario(self) -> Scenario:
        """With the draw of its arms."""
        return drawn(self.case.scenario, self.fleet)

    @property
    def size(self) -> int:
        """Arms times decision intervals, which the time of a run follows."""
        return len(self.case.seeds) * len(self.case.scenario.arms) * self.case.scenario.ticks

    @property
    def group(self) -> tuple[object, ...]:
        """Units of one group share plans and twins."""
        return self.case.name if self.cell < 0 else self.cell, self.fleet, self.twins, self.difficulty


@dataclass(frozen=True, kw_only=True)
class Study(StudySpec):
    """Policies, instances and everything that they are run with."""

    policies: Sequence[str]
    """Each runs with every one of `difficulties`, but POLICY@SOURCE with that source alone."""
    cases: Sequence[Case]
    difficulties: Sequence[str] = ("twin",)
    """Sources of predictions, see `scenarios.evaluate.sources`."""
    randomise: Randomisation | None = None
    channel: Channel = PERFECT
    """Of scenarios that have no channel of their own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for source in self.difficulties:
            check_source(source)
        for what, given in (
            ("policy", self.policies),
            ("policy", [f"{policy}@{source}" for policy, source in self.pairs]),
            ("instance", [case.name for case in self.cases]),
            ("difficulty", self.difficulties),
        ):
            for i, name in enumerate(given):
                if name in given[:i]:
                    raise FleetError(f"The {what} '{name}' is given twice; names must be unique.")
        randomise = randomisation_of(self.randomise)
        for case in self.cases:
            randomise.scenarios_of(case.scenario)  # before the first shift, as an error of a late one comes late
        if self.trainings > 1 and not any(map(is_trained, self.sources)):
            trained = ", ".join(filter(is_trained, ALL_SOURCES))
            raise FleetError(
                f"--trainings {self.trainings} needs predictions of a trained source ({trained}); "
                f"of {', '.join(self.sources)} there is one."
            )
        labels: dict[str, str] = {}
        for policy, own in self.own_trainings.items():
            for each in own:
                check_policy(each, self.decision_limit_s)
            if len(own) > 1:
                check_recipe(policy, [source for each in own if (source := source_of(each))])
            if len(own) > 1 and (self.trainings > 1 or self.fleets > 1):
                raise FleetError(f"'{policy}' has {len(own)} trainings: then --trainings and --fleets must be 1.")
            if len(own) not in (1, self.most_trainings):
                raise FleetError(
                    f"'{policy}' has {len(own)} trainings, another policy {self.most_trainings}: give as many of each."
                )
            if (other := labels.setdefault(label(policy), policy)) != policy:
                raise FleetError(f"'{other}' and '{policy}' are both called {label(policy)} in results: rename one.")

    def units(self, done: Collection[RowKey]) -> Iterator[Unit]:
        """What is left to run, by cells, then by what is prepared, then in the order of the instances."""
        together = TOGETHER if self.channel.perfect else 1
        groups = preparations([case.scenario for case in self.cases], self.sources[0])
        for (cell, _), case in sorted(zip(groups, self.cases, strict=True), key=lambda each: each[0]):
            for difficulty, policies in self._policies_with.items():
                most = max(self.trainings_of(policy, difficulty) for policy in policies)
                for fleet, training, policy in product(range(self.fleets), range(most), policies):
                    if training >= self.trainings_of(policy, difficulty):
                        continue
                    key = (policy, case.name, fleet, training, difficulty)
                    left = [seed for seed in case.seeds if RowKey(*key, seed) not in done]
                    own = self.own_trainings[policy]
                    member, twins = (training, 0) if len(own) > 1 else (0, training)
                    for i in range(0, len(left), together):
                        part = replace(case, seeds=tuple(left[i : i + together]))
                        yield Unit(policy, part, fleet, training, difficulty, own[member], twins, cell)

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Policy and source of predictions of everything that is compared."""
        given = [split_source(name) for name in self.policies]
        everywhere = ((policy, each) for each in self.difficulties for policy, source in given if source is None)
        return (*everywhere, *((policy, source) for policy, source in given if source is not None))

    @cached_property
    def competitors(self) -> dict[tuple[str, str], str]:
        """What a table calls each of `pairs`: POLICY, or POLICY@SOURCE if there are several sources."""
        several = len(self._policies_with) > 1
        return {(policy, source): f"{policy}@{source}" if several else policy for policy, source in self.pairs}

    @cached_property
    def _policies_with(self) -> dict[str, list[str]]:
        """The policies that run with each source."""
        found: dict[str, list[str]] = {}
        for policy, source in self.pairs:
            found.setdefault(source, []).append(policy)
        return found

    @property
    def sources(self) -> tuple[str, ...]:
        return tuple(self._policies_with)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Fleets, trainings and seeds of an instance: the order of a policy's rows."""
        trainings = max(self.trainings_of(*pair) for pair in self.pairs)
        return self.fleets, trainings, len(self.cases[0].seeds)

    @cached_property
    def own_trainings(self) -> dict[str, tuple[str, ...]]:
        """The trainings of each policy, as they were when the study began; itself if it has none."""
        return {policy: trainings_of(policy) for policy, _ in self.pairs}

    @cached_property
    def policy_hashes(self) -> dict[str, str]:
        """Of each policy, as its files were when the study began."""
        return {policy: policy_hash(policy) for policy, _ in self.pairs}

    @property
    def channel_text(self) -> str:
        """The channel of all instances in words."""
        texts = {case.scenario.channel(self.channel).text for case in self.cases}
        return texts.pop() if len(texts) == 1 else "that of each instance"

    @property
    def most_trainings(self) -> int:
        """Of those policies that have trainings of their own."""
        return max(map(len, self.own_trainings.values()))

    def trainings_of(self, policy: str, source: str) -> int:
        """Number of trainings of a policy with a source of predictions: its own, or else those of the twins."""
        own = len(self.own_trainings[policy])
        return self.trainings if own == 1 and is_trained(source) else own

    @cached_property
    def card(self) -> dict[str, object]:
        """What makes two results comparable: hashes of code, scenarios and policies, versions, settings."""
        return {
            "code_hash": code_hash(),
            "versions": versions_of(_LIBRARIES),
            "risk": self.risk,
            "randomise": asdict(self.randomise or Randomisation()),
            "channel": self.channel.described(),
            "decision_limit_s": self.decision_limit_s,
            "figures": list(FIGURES),
            "instances": {case.name: scenario_hash(case.scenario) for case in self.cases},
            "policies": self.policy_hashes,
        }


def split_source(name: str) -> tuple[str, str | None]:
    """Policy and source of POLICY@SOURCE; a name without a source has None.

    Raises:
        FleetError: there is no such source of predictions.
    """
    policy, _, source = name.rpartition("@")
    if not policy or (source not in ALL_SOURCES and (is_on_bus(name) or not source.replace("-", "").isalnum())):
        return name, None  # also the router of a policy in another process, and a path with @
    check_source(source)
    return policy, source


def check_policy(name: str, limit_s: float | None = None) -> None:
    """Check that there is such a policy. One whose making raises an exception fails later, shift by shift.

    Args:
        limit_s: Most time until it is loaded and made, s.

    Raises:
        FleetError: no such rule, file, module, class or folder, one that is no policy, or one that takes too long.
    """
    limit = DecisionLimit(limit_s)
    try:
        with limit.watching(), limit.decision():
            policy_of(name)
    except TooSlow as error:
        raise FleetError(f"The policy '{name}' takes longer than {limit_s:g} s to load (--decision-limit).") from error
    except FleetError:
        raise
    except (Exception, SystemExit):  # of its code
        return


def policy_hash(name: str) -> str:
    """Hash of the files of a policy with all its trainings; "" of a rule, which belongs to the code, and of a policy in
    another process, which has no files here."""
    sources = [source for each in trainings_of(name) if (source := source_of(each)) is not None]
    if not sources:
        return ""
    digest = hashlib.sha256()
    for source in sources:
        folder = source if source.is_dir() else source.parent
        for path in files_of(source):
            digest.update(f"{os.path.relpath(path, folder)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def files_of(source: Path) -> list[Path]:
    """All files of a folder; or a file, and what it imports from its folder, its package and the working directory."""
    if source.is_dir():
        return sorted(path for path in source.rglob("*") if path.is_file())
    root = folder = source.absolute().parent
    while (root / "__init__.py").is_file():
        root = root.parent
    inside = source.absolute().relative_to(root)
    if "site-packages" in root.parts:
        return sorted((root / inside.parts[0]).rglob("*.py")) or [source]
    finder = ModuleFinder([str(folder), str(root), str(Path.cwd())], excludes=OWN_PACKAGES)
    try:
        if len(inside.parts) == 1:
            finder.run_script(str(source))
        else:
            finder.import_hook(".".join(inside.with_suffix("").parts).removesuffix(".__init__"))
    except (SyntaxError, ImportError, ValueError):  # it cannot be loaded either
        return [source]
    found = (getattr(module, "__file__", None) for module in finder.modules.values())
    others = {Path(file).absolute() for file in found if file} - {source.absolute()}
    return [source, *sorted(others)]


def columns(row: Row) -> dict[str, object]:
    """A row as columns: key, figures, illegal, error, trace."""
    figures = dict.fromkeys(FIGURES) if row.outcome is None else asdict(row.outcome)
    return {**row.key._asdict(), **figures, "illegal": row.illegal, "error": row.error, "trace": row.trace}


def row_of(found: Mapping[str, Any]) -> Row:
    """The row of its columns."""
    failed = found["error"] is not None
    outcome = None if failed else Outcome(**{figure: found[figure] for figure in FIGURES})
    return Row(
        RowKey(*(found[name] for name in RowKey._fields)), outcome, found["illegal"], found["error"], found["trace"]
    )


MOST_NAMES = 3
"""Instances of a suite that a title names each."""


def cases_of(names: Sequence[str], seeds: int, first_seed: int = 0) -> list[Case]:
    """Scenarios by library name or file, each with the same seeds, and instances, as `test/0017`, each with its own.

    Raises:
        FleetError: there is no such scenario, or two have one name.
    """
    if first_seed + seeds - 1 > MAX_SEED:
        raise FleetError(f"Seeds are 0..{MAX_SEED}: {seeds} from --first-seed {first_seed} on are too many.")
    cases: list[Case] = []
    for name in names:
        if INSTANCE.fullmatch(name):
            _check_first(name, first_seed)
            cases.append(_case_of(instance(name), seeds))
        else:
            scenario, own = load(name), tuple(range(first_seed, first_seed + seeds))
            cases.append(Case(name=scenario.name, scenario=scenario, seeds=own))
    return cases


def _check_first(name: str, first_seed: int) -> None:
    if first_seed:
        raise FleetError(f"'{name}' has seeds of its own: leave --first-seed {first_seed} out.")


def _case_of(instance: Instance, seeds: int) -> Case:
    return Case(name=instance.name, scenario=instance.scenario, seeds=seeds_of_instance(instance.seed, seeds))


def suite_of(name: str, seeds: int, first_seed: int = 0) -> list[Case]:
    """The instances of a split, each with its own seed and others drawn from it; or names separated by commas.

    Raises:
        FleetError: there is no such split, instance or scenario.
    """
    if name in SPLITS:
        _check_first(name, first_seed)
        return [_case_of(each, seeds) for each in split(name)]
    names = [each.strip() for each in name.split(",")]
    for each in names:
        if each in SPLITS:
            raise FleetError(f"A split stands alone: give --suite {each}, or instances of it, as {each}/0017.")
        if not (INSTANCE.fullmatch(each) or each in library() or each.endswith(".toml")):
            near = nearest(each, [*SPLITS, *library()])
            raise FleetError(f"No instances '{each}'{near} An instance of a split is named as test/0017.")
    return cases_of(names, seeds, first_seed)


def suite_label(name: str) -> str:
    """What a table calls a suite: its name, or the first of many instances and the number of the others."""
    names = [each.strip() for each in name.split(",")]
    return ", ".join(names) if len(names) <= MOST_NAMES else f"{names[0]} and {len(names) - 1} others"
