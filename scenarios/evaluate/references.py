"""Stored references of instances, a scenario and a seed each: random, hindsight and upper bound; normalised scores."""

import re
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import isfinite
from pathlib import Path

import msgspec
import numpy as np
from joblib import delayed

from agents.registry import RULES
from fleet.errors import FleetError, ScenarioError
from fleet.files import cache_folder
from fleet.seeding import child
from scenarios.evaluate.hindsight import (
    SIDE_BY_SIDE,
    Claim,
    ScheduleReplay,
    ShiftSimulator,
    Simulated,
    hindsight,
    joined,
    without_scores,
)
from scenarios.evaluate.rollout import DecisionLimit
from scenarios.evaluate.sources import Fleets, preparations
from scenarios.evaluate.study import suite_of
from scenarios.evaluate.upper_bound import Relaxation, upper_bound
from scenarios.json_rows import Row, Rows
from scenarios.policy_loader import blaming, policy_at, policy_of
from scenarios.prepare.fleet import Fleet, ShiftFactory, simulator_of_shift
from scenarios.processes import worker_processes
from scenarios.progress import Count, Progress, quiet
from scenarios.run.log import code_hash
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import DECISION_LIMIT_S, RISK, Budget, DifficultyName
from scenarios.spec.parse import scenario_hash
from scenarios.suite.splits import Instance
from scenarios.table import Table

LEAST_UNIT, TINY = 0.1, 1e-9
"""The unit of a score is at least this share of the reward of the hindsight, so that a shift in which nothing is to be
decided weighs little; and at least this reward."""
RANDOM_SHIFTS = 20
"""Draws of the policy `random` that its reward is the mean of."""
STARTS = tuple(name for name in RULES if name != "random")
"""Policies that the search starts from by default."""


@dataclass(frozen=True, kw_only=True)
class ShiftReference:
    """What the reward of one instance is measured against."""

    instance: str
    """As `heat_wave/100`, or the name of an instance of a split."""
    scenario_hash: str
    """Of what is no default in the scenario: `scenarios.spec.parse`."""
    seed: int
    difficulty: str
    """Source of the scores of the policies that the search starts from."""
    random: float
    """Mean reward of the policy `random`."""
    random_se: float
    """Standard error of that mean."""
    rule: str
    """The best policy that the search starts from."""
    best_rule: float
    """Its reward."""
    hindsight: float
    upper: float
    linear: float
    """Upper bound before whole jobs and heat budgets."""
    evaluations: int
    """Shifts that the search simulated."""
    nodes: int
    """Most nodes of the branch and bound of the upper bound."""
    search_s: float | None
    """CPU time of the search; this and the other times are None if the budget counts evaluations only."""
    upper_s: float | None
    """CPU time of the upper bound."""
    seconds: float | None
    """CPU time of everything but the planning of the fleet."""
    code: str
    """Hash of the code."""
    claims: tuple[Claim, ...]
    """The schedule of the hindsight: decision interval, arm and action of every claim."""

    @property
    def unit(self) -> float:
        """Reward of one unit of the score: from random to hindsight, and at least `LEAST_UNIT` of the hindsight."""
        return max(self.hindsight - self.random, LEAST_UNIT * abs(self.hindsight), TINY)

    def normalised(self, reward: float) -> float:
        """Score of a reward: 0 for random, 1 for `unit` more."""
        return (reward - self.random) / self.unit

    @property
    def gap(self) -> float:
        """Share by which the hindsight could at most be below the optimum, of the span from random to upper bound."""
        span = self.upper - self.random
        return (self.upper - self.hindsight) / span if span > 0 else 0.0


def reference(
    fleet: Fleet,
    task: Instance,
    budget: Budget,
    *,
    difficulty: str = "oracle",
    bound: bool = True,
    known: Sequence[Claim] = (),
    policies: Sequence[str] = STARTS,
) -> ShiftReference:
    """The reference of one instance of a prepared fleet.

    Args:
        difficulty: With which the fleet was prepared.
        bound: Compute the upper bound; else it is infinite.
        known: A schedule of an earlier search, which this one also starts from.
        policies: Those that the search starts from.
    """
    began_s = time.process_time()
    entropy = np.random.SeedSequence(task.seed)
    episode, weights = ShiftFactory(fleet)(entropy), weights_of(fleet.scenario)
    world = episode.world
    simulator = partial(simulator_of_shift, fleet, task.seed)
    rules = ShiftSimulator(world, weights, 1, noise_key=episode.noise_key, simulator=simulator, bids=True)
    # One after the other: side by side, one that wants to be asked in every interval has all of them asked.
    starts = joined([_followed(rules, name, task) for name in policies])
    best = int(starts.reward.argmax())
    rule, best_rule = policies[best], float(starts.reward[best])
    bare = without_scores(world)
    if known:
        starts = joined([starts, ShiftSimulator(bare, weights, 1).follow([ScheduleReplay(known)])])
    drawn = [policy_of("random") for _ in range(RANDOM_SHIFTS)]
    for n, policy in enumerate(drawn):
        policy.reset(np.random.default_rng(child(np.random.SeedSequence([task.seed, 2]), n)))
    random = ShiftSimulator(bare, weights, RANDOM_SHIFTS).follow(drawn).reward
    search = ShiftSimulator(bare, weights, SIDE_BY_SIDE)
    found = hindsight(search, starts, np.random.SeedSequence([task.seed, 3]), budget)
    bounded_s = time.process_time()
    upper = upper_bound(Relaxation(world, weights), nodes=budget.nodes) if bound else None
    ended_s, timed = time.process_time(), isfinite(budget.seconds)
    return ShiftReference(
        instance=task.name,
        scenario_hash=scenario_hash(task.scenario),
        seed=task.seed,
        difficulty=difficulty,
        random=float(random.mean()),
        random_se=float(random.std(ddof=1) / np.sqrt(len(random))),
        rule=rule,
        best_rule=best_rule,
        hindsight=found.reward,
        upper=upper.reward if upper else float("inf"),
        linear=upper.linear if upper else float("inf"),
        evaluations=found.evaluations,
        nodes=budget.nodes if bound else 0,
        search_s=found.seconds if timed else None,
        upper_s=ended_s - bounded_s if timed else None,
        seconds=ended_s - began_s if timed else None,
        code=code_hash(),
        claims=tuple(found.claims),
    )


def _followed(simulator: ShiftSimulator, name: str, task: Instance) -> Simulated:
    """The shift of a task under a policy; a user-defined one that fails raises `PolicyFailed`."""
    limit = DecisionLimit(DECISION_LIMIT_S)
    with blaming(name, task.name), limit.watching():
        with limit.decision():
            policy = policy_at(name, task.seed)
        return simulator.follow([policy], limit)


def references(
    tasks: Sequence[Instance],
    path: Path,
    budget: Budget,
    *,
    difficulty: DifficultyName = "oracle",
    cache: Path | None = None,
    workers: int = 1,
    policies: Sequence[str] = STARTS,
    progress: Progress = quiet,
) -> list[ShiftReference]:
    """The references of instances, kept in a file of JSON lines; those in it are not computed again.

    A row counts if instance, content of the scenario, seed and source of scores are the same. With a larger budget the
    search is repeated, and starts from the known schedule too. At the end the rows are in the order of the instances'
    names.

    Args:
        workers: Processes.
        policies: Those that the searches start from.

    Raises:
        ScenarioError: the weights of the reward allow no bound.
        FleetError: the file has other rows.
    """
    rows, folder = Rows(path), cache or cache_folder()
    rows.check_writable()
    keys = [_key(task.name, scenario_hash(task.scenario), task.seed, difficulty) for task in tasks]
    known = {(each.instance, each.seed): each for each in _references_in(rows, keys)}
    left = [task for task in tasks if not _enough(known.get((task.name, task.seed)), budget)]
    groups = preparations([task.scenario for task in left], difficulty)
    order = sorted(zip(groups, left, strict=True), key=lambda each: each[0])
    if workers > 1:
        for task in {cell: task for (cell, _), task in order}.values():
            _fleet_of(task, difficulty, folder, progress)  # so that no two processes plan the same motions
    work = (
        delayed(_bounded)(task, budget, difficulty, known.get((task.name, task.seed)), folder, policies)
        for _, task in order
    )
    done = len(tasks) - len(left)
    progress("bounding", Count(done, max(1, len(tasks))))
    with worker_processes(max(1, min(workers, len(left)))) as pool:
        for new in pool(work):
            assert isinstance(new, ShiftReference)
            rows.append(_key(new.instance, new.scenario_hash, new.seed, difficulty), asdict(new))
            done += 1
            progress("bounding", Count(done, len(tasks)))
    rows.sort(_place)
    return _references_in(rows, keys)


_fleets = Fleets()
"""Of this process; instances of one cell share a fleet."""


def _fleet_of(task: Instance, difficulty: DifficultyName, folder: Path, progress: Progress = quiet) -> Fleet:
    return _fleets.of(task.scenario, difficulty, RISK, folder, progress)


def _bounded(
    task: Instance,
    budget: Budget,
    difficulty: DifficultyName,
    known: ShiftReference | None,
    folder: Path,
    policies: Sequence[str],
) -> ShiftReference:
    fleet = _fleet_of(task, difficulty, folder)
    try:
        found = reference(
            fleet, task, budget, difficulty=difficulty, known=known.claims if known else (), policies=policies
        )
        if known and known.code == found.code:
            found = replace(found, upper=min(found.upper, known.upper))
        return found
    except ValueError as error:
        raise ScenarioError(f"{task.name}: {error}") from error


def _enough(known: ShiftReference | None, budget: Budget) -> bool:
    if known is None or known.nodes < budget.nodes:
        return False
    if isfinite(budget.seconds):
        return (known.search_s or 0.0) >= 0.9 * budget.seconds
    return known.evaluations >= budget.evaluations


def _place(row: Row) -> list[object]:
    """Sort key: names of instances by their numbers."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", row["instance"])]


def _key(instance: str, scenario: str, seed: int, difficulty: str) -> str:
    return f"{instance} {scenario} {seed} {difficulty}"


def load_references(path: Path) -> list[ShiftReference]:
    """The references in a file.

    Raises:
        FleetError: the file has other rows, or damaged ones.
    """
    rows = Rows(path)
    return _references_in(rows, rows.by_key)


def _references_in(rows: Rows, keys: Iterable[str]) -> list[ShiftReference]:
    with rows.readable():
        return msgspec.convert(rows.some(keys), list[ShiftReference])


SEEDS = 5
"""Seeds of a scenario without a number."""


def tasks_of(names: str, seeds: int | None, first_seed: int) -> list[Instance]:
    """What is to be bounded: a split, or names separated by commas. An instance has one seed.

    Raises:
        FleetError: a name occurs twice, or there are `seeds` and instances only.
    """
    tasks: list[Instance] = []
    cases = suite_of(names, seeds or SEEDS, first_seed)
    if seeds is not None and all("/" in case.name for case in cases):
        raise FleetError(f"Each instance has one seed, its own: leave --seeds {seeds} out.")
    for case in cases:
        if "/" in case.name:
            tasks.append(Instance(case.name, case.scenario, case.seeds[0]))
        else:
            tasks += [Instance(f"{case.name}/{seed}", case.scenario, seed) for seed in case.seeds]
    name, count = Counter(task.name for task in tasks).most_common(1)[0]
    if count > 1:
        raise FleetError(f"The instance '{name}' is given twice.")
    return tasks


HEADS = ("instance", "random", "best start", "reward", "hindsight", "upper bound", "its score", "gap", "CPU s")


def reference_table(references: Sequence[ShiftReference]) -> Table:
    """Every instance, and the mean of each scenario with several; times only if they are known."""
    rows: list[tuple[str, ...]] = []
    several = len({each.difficulty for each in references}) > 1

    def group_of(each: ShiftReference) -> tuple[str, str]:
        return each.instance.rpartition("/")[0], f"@{each.difficulty}" if several else ""

    for scenario, source in dict.fromkeys(map(group_of, references)):
        own = [each for each in references if group_of(each) == (scenario, source)]
        rows += [_cells(f"{each.instance}{source}", each.rule, [each]) for each in own]
        if len(own) > 1:
            rows.append(_cells(f"{scenario}{source}, mean", "", own))
    heads = HEADS if any(each.seconds is not None for each in references) else HEADS[:-1]
    return Table(head=heads, rows=tuple(row[: len(heads)] for row in rows))


def _cells(name: str, rule: str, references: Sequence[ShiftReference]) -> tuple[str, ...]:
    """A row of means."""
    random, *rewards = (
        f"{np.mean([getattr(each, figure) for each in references]):.1f}"
        for figure in ("random", "best_rule", "hindsight", "upper")
    )
    score = np.mean([each.normalised(each.best_rule) for each in references])
    gap = np.mean([each.gap for each in references])
    times = [each.seconds for each in references if each.seconds is not None]
    return name, random, rule, *rewards, f"{score:.3f}", f"{gap:.3f}", f"{np.mean(times):.0f}" if times else ""
