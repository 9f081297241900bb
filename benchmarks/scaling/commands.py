"""CPU time and memory of `thermofleet show` and `run` for 100 arms, 1 000 jobs and eight hours.

    python -m benchmarks.scaling.commands [--arms 100] [--hours 8] [--jobs 1000] [--out FILE]

`show` runs twice: with an empty cache, when it plans the work of all arms, and again. `run` exchanges messages over
Zenoh, and then in memory. CPU time is that of all threads of the command; memory is the most that it held.
"""

import os
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.harness import machine, options, print_json
from benchmarks.scaling.hall import hall, toml_of
from scenarios.live.fleet_processes import PROGRAM


def measured(arguments: list[str], cache: str) -> dict[str, float]:
    """Wall and CPU seconds and MB of a command."""
    began = time.monotonic()
    environment = os.environ | {"THERMOFLEET_CACHE": cache, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.DEVNULL, stderr=-1, env=environment)
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
    given = options(__doc__, arms=100, hours=8.0, jobs=1000, out=Path)
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
    print_json({"arms": given.arms, "hours": given.hours, "jobs": given.jobs, **machine(), "commands": rows}, given.out)


if __name__ == "__main__":
    main()
