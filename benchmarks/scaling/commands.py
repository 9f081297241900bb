"""CPU time and memory of `thermofleet show` and `run` for 100 arms, 1 000 jobs and eight hours.

    python -m benchmarks.scaling.commands [--arms 100] [--hours 8] [--jobs 1000] [--out FILE]

`show` runs twice: with an empty cache, when it plans the work of all arms, and again. `run` exchanges messages over
Zenoh, and then in memory. CPU time is that of all threads of the command; memory is the most that it held.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.scaling.hall import hall, toml_of

COMMAND = [sys.executable, "-c", "from scenarios.cli.main import main; main()"]


def measured(arguments: list[str], cache: str) -> dict[str, float]:
    """Wall and CPU seconds and MB of a command."""
    began = time.monotonic()
    environment = os.environ | {"THERMOFLEET_CACHE": cache, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(COMMAND + arguments, stdout=subprocess.DEVNULL, stderr=-1, env=environment)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"thermofleet {' '.join(arguments)} failed: {process.stderr and process.stderr.read()}")
    return {
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "wall_s": round(time.monotonic() - began, 1),
        "most_mb": round(used.ru_maxrss * 1024 / 1e6),
    }


def main() -> None:
    """Measure, and print a JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file, cache = Path(folder) / "hall.toml", str(Path(folder) / "cache")
        file.write_text(toml_of(hall(given.arms, hours=given.hours, jobs=given.jobs, cycles=(100, 200))), "utf-8")
        run = ["run", str(file), "--policy", "matching", "--difficulty", "blind", "--out"]
        commands = {
            "show, plans included": ["show", str(file)],
            "show": ["show", str(file)],
            "run": [*run, str(Path(folder) / "zenoh")],
            "run --bus memory": [*run, str(Path(folder) / "memory"), "--bus", "memory"],
        }
        rows = [{"command": name, **measured(command, cache)} for name, command in commands.items()]
    result = {
        "arms": given.arms,
        "hours": given.hours,
        "jobs": given.jobs,
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "commands": rows,
    }
    print(json.dumps(result))
    if given.out:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
