"""Speed-up of `thermofleet compare` from one worker to two, or from one Ray node to two.

    python benchmarks/bench_workers.py [--ray] [--suite test] [--instances 18] [--repeats 3] [--policies …] [--out FILE]

Plans are made before. Each repeat runs the same study with one worker and with two, in turns, and checks that the rows
are equal. The limit in the same run is a loop without shared memory or files, alone and twice at a time: what two
processes gain on this machine now. With `--ray` a worker is a node with one CPU of a local cluster (extra `ray`).
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from scenarios.trials import run_unit
from scenarios.trials.cases import suite_of
from scenarios.trials.contest import run_study
from scenarios.trials.fleets import Fleets
from scenarios.trials.plan import Study

LOOP = "import numpy as np\na = np.ones((64, 64))\nfor _ in range({n}):\n    a = a @ a / 64.0; sum(range(400))"
LOOPS = 300_000


def seconds(function: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def loops(processes: int) -> None:
    """Share the loops among processes that know nothing of each other."""
    code = LOOP.format(n=LOOPS // processes)
    for each in [subprocess.Popen([sys.executable, "-c", code]) for _ in range(processes)]:
        each.wait()


def ray_cluster() -> Callable[[int], str]:
    """Start a local Ray cluster of one node; returned: what gives it a number of nodes, and returns the address."""
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    more: list[Any] = []

    def address(nodes: int) -> str:
        while 1 + len(more) < nodes:
            more.append(cluster.add_node(num_cpus=1))
        while 1 + len(more) > nodes:
            cluster.remove_node(more.pop())
        cluster.wait_for_nodes()
        return cluster.address

    return address


def main() -> None:
    """Measure, and print a JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ray", action="store_true")
    parser.add_argument("--suite", default="test")
    parser.add_argument("--instances", type=int, default=18)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--policies", default="random,round_robin,least_loaded,wspt,wsept,matching")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    cases = suite_of(arguments.suite, 1)[: arguments.instances]
    study = Study(policies=arguments.policies.split(","), cases=cases, difficulties=["blind"])
    address = ray_cluster() if arguments.ray else None
    expected = None
    took: dict[str, list[float]] = {"one": [], "two": [], "loop_one": [], "loop_two": []}
    loads: list[float] = []
    for _ in range(arguments.repeats):
        for workers, name in ((1, "one"), (2, "two")):
            run_unit.fleets = Fleets()  # as in a new process
            rows: list[object] = []

            where = address(workers) if address else None

            def study_it(workers: int = workers, rows: list[object] = rows, where: str | None = where) -> None:
                rows += run_study(study, workers=workers, ray=where)

            took[name].append(seconds(study_it))
            expected = expected or rows
            if rows != expected:
                raise SystemExit("The rows differ between one worker and two.")
            took[f"loop_{name}"].append(seconds(lambda n=workers: loops(n)))
            loads.append(os.getloadavg()[0])
    medians = {name: round(median(values), 2) for name, values in took.items()}
    result = {
        "what": "Ray nodes" if arguments.ray else "processes",
        "shifts": len(expected or ()),
        "repeats": arguments.repeats,
        "median_s": medians,
        "speed_up": round(medians["one"] / medians["two"], 2),
        "limit": round(medians["loop_one"] / medians["loop_two"], 2),
        "cores": os.cpu_count(),
        "load_average": [min(loads), max(loads)],
        "all_s": {name: [round(value, 2) for value in values] for name, values in took.items()},
    }
    print(json.dumps(result))
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        with arguments.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
