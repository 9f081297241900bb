"""What the measurements share: options, processes and their cost, and times beside a peer in the same run.

Each measurement is a module of a checkout: `python -m benchmarks.NAME`. Medians and ratios of calls that alternate
depend least on what else the machine does; absolute times need its load beside them.
"""

import json
import math
import multiprocessing
import os
import platform
import statistics
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any  # defaults of options, and values of JSON

import numpy as np

from fleet.files import atomic_path

PATIENCE_S = 120.0
"""Longest wait for a process to start or to end."""
CHROMIUM = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options of a browser without a graphics card."""


def options(description: str | None, *arguments: str, **wanted: Any) -> Namespace:
    """The values of the command line.

    Args:
        arguments: Those of the wanted that are arguments without a name.
        wanted: The default of each option, alone or with a sentence of help. False is a switch, a list takes several
            values, and a type stands for an option without a default.
    """
    parser = ArgumentParser(description=description, formatter_class=RawDescriptionHelpFormatter)
    for name, each in wanted.items():
        default, text = each if isinstance(each, tuple) else (each, "")
        flag, more = f"--{name.replace('_', '-')}", dict[str, Any]()
        text = text.replace("%", "%%")
        if isinstance(default, type):
            more = {"type": default, "help": text}
        elif default is False:
            more = {"action": "store_true", "help": text}
        else:
            several = isinstance(default, list)
            shown = " ".join(map(str, default)) if several else str(default)
            more = {"type": type(default[0] if several else default), "default": default}
            more |= {"help": f"{text} [{shown}]".strip(), "nargs": "+" if several else None}
        if name in arguments:
            flag, more["nargs"] = name, None if isinstance(default, type) else more["nargs"] or "?"
        parser.add_argument(flag, **more)
    return parser.parse_args()


def print_json(result: Mapping[str, Any], out: Path | None = None) -> None:
    """Print a result, and write it to a file if one is given."""
    text = json.dumps(result, indent=1, ensure_ascii=False)
    print(text)
    if out is not None:
        write_text(out, text + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file of results in one step, and make its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as draft:
        draft.write_text(text, encoding="utf-8")


def machine() -> dict[str, object]:
    """The machine, and how busy it is."""
    cpus = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in cpus.open() if "model name" in line] if cpus.exists() else []
    processor = names[0] if names else platform.machine()
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
    }


def seconds(call: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Duration of a call by a clock, s; CPU time of this process by default."""
    start_s = clock()
    call()
    return clock() - start_s


def in_turns(
    calls: Mapping[str, Callable[[], object]],
    runs: int,
    *,
    warm_up: int = 1,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, list[float]]:
    """Duration of each call in every run, s: in each run every call once, after some runs that do not count."""
    took: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(warm_up + runs):
        for name, call in calls.items():
            took[name].append(seconds(call, clock))
    return {name: column[warm_up:] for name, column in took.items()}


COPIES = 4
"""Pairs of arrays that copies rotate over, as `BatchEnv` rotates its observations."""


def observed_bytes(observation: Any) -> int:
    """Bytes of all arrays and tensors in an observation of nested dicts and sequences; a repeated axis counts once."""
    if isinstance(observation, Mapping):
        observation = tuple(observation.values())
    if isinstance(observation, tuple | list):
        return sum(map(observed_bytes, observation))
    if isinstance(observation, np.ndarray):
        sizes = zip(observation.shape, observation.strides, strict=True)
        return observation.itemsize * math.prod(size for size, stride in sizes if stride)
    return observation.nbytes


def step_figures(window: Callable[[], tuple[int, Any]], envs: int, agents: int, windows: int = 3) -> dict[str, float]:
    """Speed of an env beside `np.copyto` of its observations: medians of windows, after one that does not count.

    Args:
        window: Does some steps; returns their number and the last observation of all envs.
        envs: Number of envs that take a step together.
        agents: Number of agents in an env.
    """
    rates: list[float] = []
    copied: list[float] = []
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    size = 0
    for _ in range(windows + 1):
        begin_s = time.process_time()
        steps, observation = window()
        rates.append(envs * steps / (time.process_time() - begin_s))
        size = observed_bytes(observation)
        pairs = pairs or [(np.ones(size, np.uint8), np.ones(size, np.uint8)) for _ in range(COPIES)]
        begin_s, copies = time.process_time(), 0
        while (took_s := time.process_time() - begin_s) < 0.2:
            for _ in range(20):
                for target, source in pairs:
                    np.copyto(target, source)
            copies += 20 * COPIES
        copied.append(size * copies / took_s)
    rate, observed = statistics.median(rates[1:]), size / envs
    return {
        "envs": envs,
        "agents": agents,
        "steps_per_s": rate,
        "ns_per_agent_step": 1e9 / (rate * agents),
        "observed_bytes": observed,
        "observed_gb_per_s": rate * observed / 1e9,
        "copied_gb_per_s": statistics.median(copied[1:]) / 1e9,
    }


def quantiles(values: list[float], *shares: float) -> list[float]:
    """Median, and the value at each of some further shares."""
    ordered = sorted(values)
    return [
        statistics.median(ordered),
        *(ordered[min(len(ordered) - 1, int(share * len(ordered)))] for share in shares),
    ]


def cells(values: list[float], *, scale: float = 1.0, width: int = 10, digits: int = 2) -> str:
    """Numbers of a row, aligned to the right."""
    return "".join(f"{scale * value:>{width}.{digits}f}" for value in values)


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, user and system, all threads, s (proc_pid_stat(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def status_of(pid: int | str = "self") -> dict[str, str]:
    """The fields of /proc/PID/status, such as `Threads`."""
    return dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())


def rss_mb(pid: int | str = "self", *, peak: bool = False) -> float:
    """Resident memory of a process, MB; the largest so far with `peak`."""
    return int(status_of(pid)["VmHWM" if peak else "VmRSS"].split()[0]) * 1024 / 1e6


def pss_mb(pid: int) -> float:
    """Proportional set size of a process, MB."""
    shares = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in shares if line.startswith("Pss:")) * 1024 / 1e6


@contextmanager
def spawned(target: Callable[..., None], *arguments: object) -> Iterator[Connection]:
    """A separate process that calls `target(pipe, *arguments)`; yields the other end of its pipe.

    At the end it gets a message; the target then returns.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=target, args=(there, *arguments), daemon=True)
    process.start()
    try:
        yield here
    finally:
        with suppress(OSError):  # it has ended already
            here.send("end")
        process.join(PATIENCE_S)


def route(pipe: Connection, tls: Any = None) -> None:
    """Run a router, for `spawned`: sends its endpoint and the id of its process."""
    from fleet.bus.router import Router

    with Router(tls=tls) as router:
        pipe.send((router.endpoint, os.getpid()))
        pipe.recv()


def received(pipe: Connection) -> Any:
    """The next message of a process; AssertionError if none comes in time."""
    assert pipe.poll(PATIENCE_S), "a process did not start in time"
    return pipe.recv()
