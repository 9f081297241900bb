"""What a study runs: every policy on every instance, fleet, training and seed, with every source of scores."""

import hashlib
import platform
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import NamedTuple

import numpy as np

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from fleet.seeding import child
from scenarios.policy_loader import Unusable, label, policy_of, source_of, trainings_of
from scenarios.prepare.fleet import RISK, DifficultyName, RiskName
from scenarios.prepare.randomisation import Randomisation, randomisation_of
from scenarios.run.decision_limit import DECISION_LIMIT_S, DecisionLimit, TooSlow
from scenarios.run.evaluate import FIGURES, Outcome
from scenarios.run.provenance import code_hash
from scenarios.scenario_hash import scenario_hash
from scenarios.schema import Scenario
from scenarios.trials.cells import plan_content

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


class Key(NamedTuple):
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

    key: Key
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
    difficulty: DifficultyName
    played: str = ""
    """The policy itself, or the one of its trainings."""
    twins: int = 0
    """Training of the twins."""
    cell: int = field(default=-1, compare=False)
    """Number of what its plans depend on, see `scenarios.trials.cells`; by default each instance is a cell."""
    deaths: int = field(default=0, compare=False)
    """How many processes died while they ran it."""

    @property
    def keys(self) -> list[Key]:
        """The rows it gives."""
        of = (self.policy, self.case.name, self.fleet, self.training, self.difficulty)
        return [Key(*of, seed) for seed in self.case.seeds]

    @property
    def size(self) -> int:
        """Arms times decision intervals, which the time of a run follows."""
        return len(self.case.seeds) * len(self.case.scenario.arms) * self.case.scenario.ticks

    @property
    def group(self) -> tuple[object, ...]:
        """Units of one group share plans and twins."""
        return self.case.name if self.cell < 0 else self.cell, self.fleet, self.twins, self.difficulty


@dataclass(frozen=True, kw_only=True)
class Study:
    """Policies, instances and everything that they are run with."""

    policies: Sequence[str]
    cases: Sequence[Case]
    fleets: int = 1
    trainings: int = 1
    """Only difficulty `twin` has trainings; the others have one."""
    difficulties: Sequence[DifficultyName] = ("twin",)
    risk: RiskName = RISK
    randomise: Randomisation | None = None
    channel: Channel = PERFECT
    """Of scenarios that have no channel of their own."""
    decision_limit_s: float | None = DECISION_LIMIT_S

    def __post_init__(self) -> None:
        for what, given in (
            ("policy", self.policies),
            ("instance", [case.name for case in self.cases]),
            ("difficulty", self.difficulties),
        ):
            for i, name in enumerate(given):
                if name in given[:i]:
                    raise FleetError(f"The {what} '{name}' is given twice; names must be unique.")
        randomise = randomisation_of(self.randomise)
        for case in self.cases:
            randomise.scenarios_of(case.scenario)  # before the first shift, as an error of a late one comes late
        labels: dict[str, str] = {}
        for policy, own in self.own_trainings.items():
            for each in own:
                check_policy(each, self.decision_limit_s)
            if len(own) > 1 and (self.trainings > 1 or self.fleets > 1):
                raise FleetError(
                    f"'{policy}' has {len(own)} trainings of its own: then --trainings and --fleets must be 1."
                )
            if len(own) not in (1, self.most_trainings):
                raise FleetError(
                    f"'{policy}' has {len(own)} trainings, another policy {self.most_trainings}: give as many of each."
                )
            if (other := labels.setdefault(label(policy), policy)) != policy:
                raise FleetError(f"'{other}' and '{policy}' are both called {label(policy)} in results: rename one.")

    def units(self, done: set[Key]) -> Iterator[Unit]:
        """What is left to run, in the order of the instances."""
        together = TOGETHER if self.channel.perfect else 1
        cells: dict[object, int] = {}
        for case in self.cases:
            cell = cells.setdefault(plan_content(case.scenario), len(cells))
            for difficulty in self.difficulties:
                for fleet in range(self.fleets):
                    most = max(self.trainings_of(policy, difficulty) for policy in self.policies)
                    for training in range(most):
                        for policy in self.policies:
                            if training >= self.trainings_of(policy, difficulty):
                                continue
                            of = (policy, case.name, fleet, training, difficulty)
                            left = [seed for seed in case.seeds if Key(*of, seed) not in done]
                            for i in range(0, len(left), together):
                                part = Case(name=case.name, scenario=case.scenario, seeds=tuple(left[i : i + together]))
                                own = self.own_trainings[policy]
                                member, twins = (training, 0) if len(own) > 1 else (0, training)
                                yield Unit(policy, part, fleet, training, difficulty, own[member], twins, cell)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Fleets, trainings and seeds of an instance: the order of a policy's rows."""
        trainings = max(self.trainings_of(policy, each) for policy in self.policies for each in self.difficulties)
        return self.fleets, trainings, len(self.cases[0].seeds)

    @cached_property
    def own_trainings(self) -> dict[str, tuple[str, ...]]:
        """The trainings of each policy, as they were when the study began; itself if it has none."""
        return {policy: trainings_of(policy) for policy in self.policies}

    @cached_property
    def policy_hashes(self) -> dict[str, str]:
        """Of each policy, as its files were when the study began."""
        return {policy: policy_hash(policy) for policy in self.policies}

    @property
    def channel_text(self) -> str:
        """The channel of all instances in words."""
        texts = {case.scenario.channel(self.channel).text for case in self.cases}
        return texts.pop() if len(texts) == 1 else "that of each instance"

    @property
    def most_trainings(self) -> int:
        """Of those policies that have trainings of their own."""
        return max(map(len, self.own_trainings.values()))

    def trainings_of(self, policy: str, difficulty: DifficultyName) -> int:
        """How many trainings a policy has with a source of scores: of its own, or else of the twins."""
        own = len(self.own_trainings[policy])
        return self.trainings if own == 1 and difficulty == "twin" else own

    @cached_property
    def card(self) -> dict[str, object]:
        """What makes two results comparable: hashes of code, scenarios and policies, versions, settings."""
        return {
            "code_hash": code_hash(),
            "versions": {"python": platform.python_version()} | dict(_versions()),
            "risk": self.risk,
            "randomise": asdict(self.randomise or Randomisation()),
            "channel": self.channel.described(),
            "decision_limit_s": self.decision_limit_s,
            "figures": list(FIGURES),
            "instances": {case.name: scenario_hash(case.scenario) for case in self.cases},
            "policies": self.policy_hashes,
        }


def _versions() -> Iterator[tuple[str, str | None]]:
    for name in _LIBRARIES:
        try:
            yield name, version(name)
        except PackageNotFoundError:
            yield name, None


def check_policy(name: str, limit_s: float | None = None) -> None:
    """Check that there is such a policy. One that is there and cannot be made fails later, shift by shift.

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
    except Unusable:
        return
    except FleetError:
        raise
    except Exception:  # whatever its own code raises
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
        files = sorted(path for path in source.rglob("*") if path.is_file()) if source.is_dir() else [source]
        for path in files:
            digest.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def columns(row: Row) -> dict[str, object]:
    """A row as columns: key, figures, illegal, error, trace."""
    figures = dict.fromkeys(FIGURES) if row.outcome is None else asdict(row.outcome)
    return {**row.key._asdict(), **figures, "illegal": row.illegal, "error": row.error, "trace": row.trace}
