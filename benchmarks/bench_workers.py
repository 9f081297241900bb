"""Speed-up of `thermofleet compare` from one worker to two, or from one Ray node to two.

    python -m benchmarks.bench_workers [--ray] [--suite test] [--instances 18] [--repeats 3] [--policies …] [--out FILE]

Plans are made before. Each repeat runs the same study with one worker and with two, in turns, and checks that the rows
are equal. The limit in the same run is a loop without shared memory or files, alone and twice at a time: what two
processes gain on this machine now. With `--ray` a worker is a node with one CPU of a local cluster (extra `ray`).
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from statistics import median

os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.harness import options, seconds
from scenarios.evaluate import runner
from scenarios.evaluate.runner import run_study
from scenarios.evaluate.sources import Fleets
from scenarios.evaluate.study import Study, suite_of

LOOP = "import numpy as np\na = np.ones((64, 64))\nfor _ in range({n}):\n    a = a @ a / 64.0; sum(range(400))"
LOOPS = 300_000


def loops(processes: int) -> None:
    """Share the loops among processes that know nothing of each other."""
    code = LOOP.format(n=LOOPS // processes)
    for each in [subprocess.Popen([sys.executable, "-c", code]) for _ in range(processes)]:
        each.wait()


@contextmanager
def ray_cluster(nodes: int) -> Iterator[str]:
    """A local Ray cluster of nodes with one CPU each; its address."""
    import ray  # pyright: ignore[reportMissingImports]
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        for _ in range(nodes - 1):
            cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        ray.init(cluster.address, log_to_driver=False)
        yield cluster.address
    finally:
        ray.shutdown()
        cluster.shutdown()


def main() -> None:
    """Measure, and print a JSON object."""
    policies = "random,round_robin,least_loaded,wspt,wsept,matching"
    arguments = options(__doc__, ray=False, suite="test", instances=18, repeats=3, policies=policies, out=Path)
    cases = suite_of(arguments.suite, 1)[: arguments.instances]
    study = Study(policies=arguments.policies.split(","), cases=cases, difficulties=["blind"])
    expected = None
    took: dict[str, list[float]] = {"one": [], "two": [], "loop_one": [], "loop_two": []}
    loads: list[float] = []
    for _ in range(arguments.repeats):
        for workers, name in ((1, "one"), (2, "two")):
            runner.fleets = Fleets()  # as in a new process
            with ray_cluster(workers) if arguments.ray else nullcontext() as where:
                began_s = time.perf_counter()
                rows = run_study(study, workers=workers, ray=where)
                took[name].append(time.perf_counter() - began_s)
            expected = expected or rows
            if rows != expected:
                raise SystemExit("The rows differ between one worker and two.")
            took[f"loop_{name}"].append(seconds(partial(loops, workers), time.perf_counter))
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
