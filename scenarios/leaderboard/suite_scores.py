"""Central policies on a split of the suite: rows of results, and paired differences with trainings as a sample.

`python -m scenarios.leaderboard.suite_scores test --policies random,wsept,FOLDER --out FILE` appends a row for each
policy and instance, and leaves out those that the file has. Steps end where an arm may claim a job, which changes no
result of a central policy and takes a tenth of the time; `thermofleet compare --suite test` has all figures, and the
bus.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from agents.policy import WAIT
from fleet.env.vector import BatchEnv
from scenarios.bounds.references import Reference, load_references
from scenarios.policy_loader import label, policy_at
from scenarios.prepare.fleet import DifficultyName
from scenarios.progress import Count, Progress, quiet
from scenarios.run.outcome import common_figures
from scenarios.run.suite_batches import Ground, ground_of
from scenarios.schema_errors import choose
from scenarios.statistics.means import Interval, interval
from scenarios.suite.splits import Instance, split
from scenarios.trials.plan import seeds_of_instance

Array = np.ndarray
Row = dict[str, object]


def row_of(ground: Ground, policy: str, seed: int) -> Row:
    """The figures of a shift of an instance under a policy."""
    env = BatchEnv(ground.library, 1, seed=[seed], weights=ground.weights, decisions="events", autoreset=False)
    obs, _ = env.reset()
    chooser, reward, over = policy_at(policy, seed), 0.0, False
    while not over:
        vectors, mask = obs["observation"][0], obs["action_mask"][0]
        actions = np.full((1, ground.arms), WAIT)
        if mask[:, 1:-1].any():
            chosen = chooser.act({arm: env.layout.read(vectors[a], mask[a]) for a, arm in enumerate(env.agents)})
            actions[0] = [chosen[arm] for arm in env.agents]
        obs, earned, terminated, truncated, _ = env.step(actions)
        reward += float(earned[0])
        over = bool(terminated[0] | truncated[0])
    shift = ground.library.draw(np.random.SeedSequence(seed))
    tables = ground.library.tables
    value = tables.value[shift.fleet, shift.kind]
    state = env.state
    figures = common_figures(state, 0, value, shift.due_s, tables.dt_s)
    return {
        "policy": label(policy),
        "instance": ground.name,
        "seed": seed,
        "arms": ground.arms,
        "offered": float(value.sum()),
        "reward": reward,
        "peak_c": float(state.peak_c[0].max()),
        **{name: float(number) for name, number in figures.items()},
    }


def write_rows(
    instances: Sequence[Instance],
    policies: Sequence[str],
    out: Path,
    *,
    seeds: int = 1,
    difficulty: DifficultyName = "oracle",
    progress: Progress = quiet,
) -> None:
    """Append the rows of instances that a file does not have yet.

    Args:
        seeds: Shifts of an instance: that of its seed, and those of `thermofleet compare --seeds`.
    """
    known = {(row["policy"], row["instance"], row["seed"]) for row in read(out)} if out.exists() else set()
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("a", encoding="utf-8") as file:
        for number, instance in enumerate(instances):
            progress(instance.name, Count(number, len(instances)))
            wanted = [(policy, seed) for seed in seeds_of_instance(instance.seed, seeds) for policy in policies]
            missing = [each for each in wanted if (label(each[0]), instance.name, each[1]) not in known]
            if not missing:
                continue
            ground = ground_of(instance, difficulty=difficulty)
            for policy, seed in missing:
                file.write(json.dumps(row_of(ground, policy, seed) | {"difficulty": difficulty}) + "\n")
            file.flush()


def read(path: Path) -> list[Row]:
    """The rows of a file."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


Shift = tuple[str, int]
"""Instance and seed."""


def difference(
    rows: Sequence[Row],
    policies: Sequence[str],
    base: str,
    spans: Mapping[Shift, float] | None = None,
    *,
    sample: bool = False,
) -> tuple[Interval, int]:
    """The mean paired difference of reward of trainings of a policy to a baseline, and the number of instances.

    Args:
        policies: The trainings, or one policy.
        spans: What the reward of a shift is divided by; shifts without are left out. Default: nothing.
        sample: The trainings are a sample, too, crossed with the instances; else the interval is of their mean.
    """
    found = {(row["policy"], _shift(row)): float(row["reward"]) for row in rows}  # pyright: ignore[reportArgumentType]
    shifts = list(dict.fromkeys(_shift(row) for row in rows))
    shifts = [shift for shift in shifts if all((policy, shift) in found for policy in (*policies, base))]
    by_instance: dict[str, list[Array]] = {}
    for shift in shifts:
        if spans is None or shift in spans:
            gains = np.array([found[policy, shift] for policy in policies]) - found[base, shift]
            by_instance.setdefault(shift[0], []).append(gains / (1.0 if spans is None else spans[shift]))
    values = np.array([np.mean(each, axis=0) for each in by_instance.values()]).T
    return interval(values[:, None, :] if sample else values.mean(axis=0)), len(by_instance)


def _shift(row: Row) -> Shift:
    return str(row["instance"]), int(row["seed"])  # pyright: ignore[reportArgumentType]


def table(rows: Sequence[Row], trainings: Sequence[str], base: str, references: Sequence[Reference] = ()) -> str:
    """Markdown: every policy and the trainings together against a baseline, on all sizes of fleets and on new ones.

    Args:
        references: For the difference of normalised scores, on the instances that they are of.
    """
    offered = {_shift(row): float(row["offered"]) for row in rows}  # pyright: ignore[reportArgumentType]
    scores = {
        (each.instance, each.seed): each.hindsight - each.random for each in references if each.hindsight > each.random
    }
    small, large = ([row for row in rows if (float(row["arms"]) > TRAINED_ARMS) is more] for more in (False, True))  # pyright: ignore[reportArgumentType]
    columns = {
        "all instances": (rows, offered),
        f"up to {TRAINED_ARMS} arms": (small, offered),
        "more arms": (large, offered),
        "normalised score": (rows, scores),
    }
    columns = {name: each for name, each in columns.items() if any(_shift(row) in each[1] for row in each[0])}
    counts = [difference(some, trainings, base, spans)[1] for some, spans in columns.values()]
    heads = [f"{name} ({count})" for name, count in zip(columns, counts, strict=True)]
    lines = ["| policy | " + " | ".join(heads) + " | faults |", "|---" * (len(heads) + 2) + "|"]
    groups = {"learned, mean of trainings": list(trainings), "learned, trainings as a sample": list(trainings)}
    groups |= {str(name): [str(name)] for name in dict.fromkeys(row["policy"] for row in rows)}
    for name, policies in groups.items():
        sample = name.endswith("sample")
        cells: list[str] = []
        for some, spans in columns.values():
            found, _ = difference(some, policies, base, spans, sample=sample)
            text = f"{found.mean:+.3f} ({found.low:+.3f} … {found.high:+.3f})"
            cells.append("" if name == base else f"**{text}**" if found.excludes_zero else text)
        faults = np.mean([float(row["faults"]) for row in rows if row["policy"] in policies])  # pyright: ignore[reportArgumentType]
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {faults:.2f} |")
    return "\n".join(lines)


TRAINED_ARMS = 16
"""Most arms of the fleets of the training split."""


def main() -> None:
    """The command of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("split", choices=("train", "validation", "test"))
    parser.add_argument("--policies", required=True, help="names, FILE.py:CLASS or folders, separated by commas")
    parser.add_argument("--difficulty", default="oracle", help="twin, oracle or blind")
    parser.add_argument("--count", type=int, help="only the first instances, which are of all cells in turns")
    parser.add_argument("--seeds", type=int, default=1, help="shifts of every instance")
    parser.add_argument("--least-arms", type=int, default=0, help="only instances with this many arms or more")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--table", help="print differences to this policy instead; --policies are then trainings of one"
    )
    parser.add_argument("--references", type=Path, help="file of `thermofleet bounds`, for normalised scores")
    given = parser.parse_args()
    if given.table:
        references = load_references(given.references) if given.references else ()
        print(table(read(given.out), given.policies.split(","), given.table, references))
        return
    difficulty = choose("difficulty", given.difficulty, DifficultyName)
    instances = [each for each in split(given.split)[: given.count] if len(each.scenario.arms) >= given.least_arms]
    write_rows(instances, given.policies.split(","), given.out, seeds=given.seeds, difficulty=difficulty)


if __name__ == "__main__":
    main()
