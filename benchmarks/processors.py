"""Shifts computed with the instructions of an older processor: how many have another reward.

    python -m benchmarks.processors [--instances 5] [--policies wsept,auction] [--out docs/results/processors.json]

Plans and shifts are made anew twice, in empty caches: with all that this processor can do, and with what a processor
of 2008 can (x86-64-v2: no AVX, no fused multiply-add) in NumPy, OpenBLAS, the C library and compiled code.
`--instances` is the number of each cell of the test split with at most `--arms` arms.
"""

import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import pyarrow.parquet as parquet

from benchmarks.harness import options, print_json
from benchmarks.result_tables import SAME
from scenarios.suite.splits import instance, manifest

COMPARE = [sys.executable, "-m", "scenarios", "compare", "--difficulty", "oracle", "--workers", "1"]
OLDER = {
    "NUMBA_CPU_NAME": "nehalem",
    "NUMBA_CPU_FEATURES": "",
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX",
}


def rewards(instances: list[str], policies: str, folder: Path, setting: dict[str, str]) -> dict[tuple[str, str], float]:
    """Reward of every instance and policy, by these."""
    out = folder / "out"
    caches = {"THERMOFLEET_CACHE": str(folder / "cache"), "XDG_CACHE_HOME": str(folder / "compiled")}
    command = [*COMPARE, "--suite", ",".join(instances), "--policies", policies, "--out", str(out)]
    subprocess.run(
        command, env=os.environ | caches | setting | {"OMP_NUM_THREADS": "1"}, check=True, stdout=subprocess.DEVNULL
    )
    rows = parquet.read_table(out / "results.parquet").to_pylist()
    return {(row["instance"], row["policy"]): row["reward"] for row in rows}


def main() -> None:
    """Measure, and print a JSON object."""
    given = options(__doc__, instances=5, arms=16, policies="wsept,auction", out=Path)
    if platform.machine() != "x86_64":
        raise SystemExit(f"Needs an x86-64 processor, whose instructions it switches off (this: {platform.machine()}).")
    cells: dict[str, list[str]] = {}
    for row in manifest("test"):
        cells.setdefault(row.cell, []).append(row.name)
    small = [names for names in cells.values() if len(instance(names[0]).scenario.arms) <= given.arms]
    chosen = [name for names in small for name in names[: given.instances]]
    with tempfile.TemporaryDirectory() as folder:
        found = []
        for name, setting in (("present", {}), ("older", OLDER)):
            own = Path(folder) / name
            own.mkdir(mode=0o700)
            found.append(rewards(chosen, given.policies, own, setting))
    present, older = found
    apart = {key: abs(older[key] - reward) / max(abs(reward), 1.0) for key, reward in present.items()}
    result = {
        "instances": len(chosen),
        "policies": given.policies.split(","),
        "shifts": len(apart),
        "other_reward": sorted(" ".join(key) for key, share in apart.items() if share > SAME),
        "largest_share": max(apart.values()),
    }
    print_json(result, given.out)


if __name__ == "__main__":
    main()
