"""Compute the suite anew: python -m benchmarks.freeze_suite [CELL …]. What is frozen must not change any more.

Time loads are computed for the named cells, and for those without any; then all manifests are written. It plans every
cell (minutes) and needs no twins.
"""

import json
import sys
from pathlib import Path

from fleet.job import Job
from scenarios.prepare.fleet import prepare, world_of
from scenarios.prepare.load_factor import load_factor
from scenarios.spec.jobs import works_of
from scenarios.spec.schema import SPLITS, JobStream
from scenarios.suite.instances import CELLS, TRADES, Axes, SuiteCell, scenario_of
from scenarios.suite.splits import drawn_rows, line_of

FOLDER = Path(__file__).parents[1] / "scenarios" / "suite"
PLAIN = Axes(
    heat="warm", due="usual", arrivals="poisson", precedence="none", air="warm", faults="attended", bus="perfect"
)


def time_loads_of(cell: SuiteCell) -> tuple[float, float]:
    """Time load of one job of each stream and payload, of the tasks that heat and of the others."""
    scenario = scenario_of(cell.name, cell, PLAIN, 0, (1.0, 1.0))
    fleet = prepare(scenario, difficulty="blind")
    jobs: dict[bool, list[Job]] = {True: [], False: []}
    heats = {task.name: task.heats for task in TRADES[cell.trade]}
    for stream in scenario.jobs:
        jobs[heats[_task_of(stream)]] += [
            Job(name=f"{stream.name}-{i}", work=work, repetitions=round(sum(stream.repetitions) / 2), release_s=0.0,
                due_s=stream.due_s, value=stream.value)
            for i, work in enumerate(works_of(scenario, stream))
        ]  # fmt: skip
    heating, rest = (load_factor(world_of(fleet, jobs[kind])[0]).time for kind in (True, False))
    return round(heating, 5), round(rest, 5)


def _task_of(stream: JobStream) -> str:
    return stream.name.rpartition("_")[0]


def main(names: list[str]) -> None:
    """Compute the time loads of cells, and write the manifests."""
    path = FOLDER / "time_loads.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for cell in CELLS:
        if cell.name in names or cell.name not in known:
            known[cell.name] = time_loads_of(cell)
            lines = ",\n".join(f' "{each}": {json.dumps(loads)}' for each, loads in known.items())
            path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
            print(cell.name, known[cell.name], flush=True)
    for name in SPLITS:
        text = "".join(line_of(row) + "\n" for row in drawn_rows(name))
        (FOLDER / f"{name}.jsonl").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
