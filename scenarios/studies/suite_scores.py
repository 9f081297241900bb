"""Central policies on a split of the suite: rows of results, and paired differences with trainings as a sample.

`python -m scenarios.studies.suite_scores test --policies random,wsept,FOLDER --out FILE` appends a row for each policy
and instance, and leaves out those that the file has. Steps end where an arm may claim a job, which changes no result of
a central policy and takes a tenth of the time; `thermofleet compare --suite test` has all figures, and the bus.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agents.policy import WAIT
from fleet.env.vector import BatchEnv
from scenarios.policy_loader import label, policy_at
from scenarios.prepare.fleet import DifficultyName
from scenarios.progress import Count, Progress, quiet
from scenarios.run.outcome import common_figures
from scenarios.run.suite_batches import Ground, ground_of
from scenarios.schema_errors import choose
from scenarios.statistics.means import Interval, interval
from scenarios.suite.splits import split

Row = dict[str, object]


def row_of(ground: Ground, policy: str) -> Row:
    """The figures of the shift of an instance under a policy."""
    env = BatchEnv(ground.library, 1, seed=[ground.seed], weights=ground.weights, decisions="events", autoreset=False)
    obs, _ = env.reset()
    chooser, reward, over = policy_at(policy, ground.seed), 0.0, False
    while not over:
        vectors, mask = obs["observation"][0], obs["action_mask"][0]
        actions = np.full((1, ground.arms), WAIT)
        if mask[:, 1:-1].any():
            chosen = chooser.act({arm: env.layout.read(vectors[a], mask[a]) for a, arm in enumerate(env.agents)})
            actions[0] = [chosen[arm] for arm in env.agents]
        obs, earned, terminated, truncated, _ = env.step(actions)
        reward += float(earned[0])
        over = bool(terminated[0] | truncated[0])
    shift = ground.library.draw(np.random.SeedSequence(ground.seed))
    tables = ground.library.tables
    value = tables.value[shift.fleet, shift.kind]
    state = env.state
    figures = common_figures(state, 0, value, shift.due_s, tables.dt_s)
    return {
        "policy": label(policy),
        "instance": ground.name,
        "seed": ground.seed,
        "arms": ground.arms,
        "offered": float(value.sum()),
        "reward": reward,
        "peak_c": float(state.peak_c[0].max()),
        **{name: float(number) for name, number in figures.items()},
    }


def write_rows(
    split_name: str,
    policies: Sequence[str],
    out: Path,
    *,
    count: int | None = None,
    difficulty: DifficultyName = "oracle",
    progress: Progress = quiet,
) -> None:
    """Append the rows of a split that a file does not have yet."""
    known = {(row["policy"], row["instance"]) for row in read(out)} if out.exists() else set()
    out.parent.mkdir(parents=True, exist_ok=True)
    instances = split(split_name)[:count]
    with out.open("a", encoding="utf-8") as file:
        for number, instance in enumerate(instances):
            progress(instance.name, Count(number, len(instances)))
            missing = [policy for policy in policies if (label(policy), instance.name) not in known]
            if not missing:
                continue
            ground = ground_of(instance, difficulty=difficulty)
            for policy in missing:
                file.write(json.dumps(row_of(ground, policy) | {"difficulty": difficulty}) + "\n")
            file.flush()


def read(path: Path) -> list[Row]:
    """The rows of a file."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def difference(
    rows: Sequence[Row], policies: Sequence[str], base: str, *, figure: str = "reward", relative: bool = False
) -> tuple[Interval, int]:
    """The mean paired difference of trainings of a policy to a baseline, and the number of instances.

    Trainings and instances are both samples, crossed; a single training counts as fixed.

    Args:
        policies: The trainings, or one policy.
        relative: Per value of all jobs of the instance, so that large fleets do not count more.
    """
    found = {(row["policy"], row["instance"]): row for row in rows}
    names = list(dict.fromkeys(row["instance"] for row in rows))
    names = [name for name in names if all((policy, name) in found for policy in (*policies, base))]

    def values(policy: str) -> list[float]:
        each = [found[policy, name] for name in names]
        return [float(row[figure]) / (float(row["offered"]) if relative else 1.0) for row in each]  # pyright: ignore[reportArgumentType]

    table = np.array([values(policy) for policy in policies]) - np.array(values(base))
    return interval(table[:, None, :] if len(table) > 1 else table[0]), len(names)


def table(rows: Sequence[Row], trainings: Sequence[str], base: str) -> str:
    """Markdown: every policy and the trainings together against a baseline, on all sizes of fleets and on new ones."""
    policies = list(dict.fromkeys(str(row["policy"]) for row in rows))
    sizes = {"all": (0, LARGEST), f"up to {TRAINED_ARMS} arms": (0, TRAINED_ARMS), "more": (TRAINED_ARMS + 1, LARGEST)}
    lines = ["| policy | " + " | ".join(f"{name}: share of the value | reward" for name in sizes) + " | faults |"]
    lines.append("|---" * (2 * len(sizes) + 2) + "|")
    groups = {"learned, all trainings": list(trainings), **{name: [name] for name in policies if name != base}}
    for label_, names in groups.items():
        cells: list[str] = []
        for low, high in sizes.values():
            some = [row for row in rows if low <= float(row["arms"]) <= high]  # pyright: ignore[reportArgumentType]
            for relative in (True, False):
                found, _ = difference(some, names, base, relative=relative)
                digits = 3 if relative else 1
                text = f"{found.mean:+.{digits}f} ({found.low:+.{digits}f} … {found.high:+.{digits}f})"
                cells.append(f"**{text}**" if found.excludes_zero else text)
        faults = np.mean([float(row["faults"]) for row in rows if row["policy"] in names])  # pyright: ignore[reportArgumentType]
        lines.append(f"| `{label_}` | " + " | ".join(cells) + f" | {faults:.2f} |")
    return "\n".join(lines)


TRAINED_ARMS, LARGEST = 16, 10_000
"""Most arms of the fleets of the training split, and more than any fleet has."""


def main() -> None:
    """The command of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("split", choices=("train", "validation", "test"))
    parser.add_argument("--policies", required=True, help="names, FILE.py:CLASS or folders, separated by commas")
    parser.add_argument("--difficulty", default="oracle", help="twin, oracle or blind")
    parser.add_argument("--count", type=int, help="only the first instances, which are of all cells in turns")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--table", help="print differences to this policy instead; --policies are then trainings of one"
    )
    given = parser.parse_args()
    if given.table:
        print(table(read(given.out), given.policies.split(","), given.table))
        return
    difficulty = choose("difficulty", given.difficulty, DifficultyName)
    write_rows(given.split, given.policies.split(","), given.out, count=given.count, difficulty=difficulty)


if __name__ == "__main__":
    main()
