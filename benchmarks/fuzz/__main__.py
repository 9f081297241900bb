"""Coverage-guided fuzzing of every parser: `python -m benchmarks.fuzz [TARGET …] [--inputs N]`; needs atheris.

Each target runs in a process of its own (libFuzzer ends its process). The corpus grows in out/fuzz/TARGET, and an input
that a parser does not handle is kept in tests/fuzz_cases/TARGET, where `make test` parses it again.
"""

import argparse
import subprocess
import sys
import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
CORPUS, CASES = ROOT / "out" / "fuzz", ROOT / "tests" / "fuzz_cases"
LONGEST, INPUT_S, MEMORY_MB = 60_000, 10, 2048
"""Bytes of an input; seconds and memory that one input may take."""


def main() -> int:
    """Fuzz targets one after the other; the exit code is the number of targets that failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", help="Default: all.")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="Of all targets together.")
    parser.add_argument("--seed", type=int, default=0, help="0 draws one.")
    parser.add_argument("--run", default="", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.run:
        fuzz(chosen.run, chosen.inputs, chosen.seed)
        return 0
    from benchmarks.fuzz.targets import TARGETS

    if find_spec("atheris") is None:
        parser.error("Fuzzing needs atheris: `make fuzz` installs it.")
    failed = 0
    for name in chosen.targets or TARGETS:
        inputs = round(chosen.inputs * TARGETS[name].share)
        start_s = time.monotonic()
        command = [sys.executable, "-m", "benchmarks.fuzz", "--run", name, "--inputs", str(inputs)]
        done = subprocess.run(
            [*command, "--seed", str(chosen.seed)], stderr=subprocess.PIPE, text=True, errors="replace", check=False
        )
        failed += done.returncode != 0
        corpus = len(list((CORPUS / name).iterdir()))
        took_s = time.monotonic() - start_s
        outcome = "ok" if done.returncode == 0 else f"FAILED, see {CASES / name}"
        print(f"{name:<12}{inputs:>9} inputs {took_s:>6.0f} s  corpus {corpus:>6}  {outcome}", flush=True)
        if done.returncode:
            print(done.stderr[-4000:])
    return failed


def fuzz(name: str, inputs: int, seed: int) -> None:
    """Fuzz one target; does not return."""
    atheris: Any = import_module("atheris")  # without types
    with atheris.instrument_imports(include=["fleet", "scenarios", "twin", "tomllib"]):
        from benchmarks.fuzz.targets import TARGETS
    target = TARGETS[name]
    corpus, cases = CORPUS / name, CASES / name
    for place in (corpus, cases):
        place.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(target.seeds()):
        target.parse(data)
        (corpus / f"seed-{number}").write_bytes(data)
    options = [f"-runs={inputs}", f"-max_len={LONGEST}", f"-timeout={INPUT_S}", f"-rss_limit_mb={MEMORY_MB}"]
    options += [f"-seed={seed}", "-verbosity=0", "-print_final_stats=1", f"-artifact_prefix={cases}/"]
    atheris.Setup([sys.argv[0], *options, str(corpus), str(cases)], target.parse)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
