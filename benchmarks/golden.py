"""Record the results of the simulator, and compare two records: a check for changes that must not alter behaviour.

    python -m benchmarks.golden record FOLDER        # every scenario, policy and seed; about 20 minutes of one core
    python -m benchmarks.golden compare OLD NEW      # every difference, the largest of each kind

A record contains numbers, not hashes, because two correct implementations may differ in the last bits. Times and
readings are compared within `TOLERANCE`, names and counts exactly. Telemetry is recorded once a minute.
"""

import argparse
import contextlib
import importlib
import io
import json
import sys
import tempfile
import tomllib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq

if TYPE_CHECKING:  # imported from the code under test when it runs
    from scenarios.spec.options import DifficultyName

SCENARIOS = ("quickstart", "active_waiting", "heat_wave")
POLICIES = ("random", "round_robin", "coolest_first", "least_difficulty", "consensus", "wspt", "wspt_cool")
SEEDS = (0, 1, 2, 3, 4, 10000, 10001)
DIFFICULTIES: tuple["DifficultyName", ...] = ("blind", "twin")
STEPS = 200
EVERY_S = 60.0
TOLERANCE = 1e-6


def thermofleet(*argv: str) -> str:
    """Run a command of this checkout in this process; return its output."""
    entry = tomllib.loads(Path("pyproject.toml").read_text())["project"]["scripts"]["thermofleet"]
    module, _, name = entry.partition(":")
    main = getattr(importlib.import_module(module), name)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), patch.object(sys, "argv", ["thermofleet", *argv]):
        try:
            main()
        except SystemExit as stop:
            if stop.code not in (0, None):
                raise RuntimeError(f"thermofleet {' '.join(argv)} exited with {stop.code}.") from stop
    return printed.getvalue()


def record(folder: Path) -> None:
    """Write the record of this checkout into a folder; existing files are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    for scenario in SCENARIOS:
        for difficulty in DIFFICULTIES:
            _once(folder / f"rollout-{scenario}-{difficulty}.npz", partial(_rollouts, scenario, difficulty))
            _once(folder / f"compare-{scenario}-{difficulty}.npz", partial(_comparison, scenario, difficulty))
            for policy in POLICIES:
                for seed in SEEDS:
                    name = f"run-{scenario}-{difficulty}-{policy}-{seed}"
                    arguments = (scenario, difficulty, policy, seed, "memory", "profile")
                    _once(folder / f"{name}.npz", lambda a=arguments: _run(*a))
            name = f"run-{scenario}-{difficulty}-zenoh"
            _once(
                folder / f"{name}.npz", lambda s=scenario, d=difficulty: _run(s, d, "wspt_cool", 0, "zenoh", "profile")
            )
    name = "run-quickstart-blind-mujoco"
    _once(folder / f"{name}.npz", lambda: _run("quickstart", "blind", "round_robin", 0, "memory", "mujoco"))
    name = "run-active_waiting-twin-channel"
    lossy = ("--loss", "0.3", "--delay-s", "20")
    _once(folder / f"{name}.npz", lambda: _run("active_waiting", "twin", "consensus", 0, "memory", "profile", *lossy))


def _once(path: Path, make: Any) -> None:
    if path.exists():
        return
    draft = path.with_name(f".{path.name}")
    with draft.open("wb") as out:
        np.savez_compressed(out, **make())
    draft.rename(path)
    print(path.name, flush=True)


def _run(scenario: str, difficulty: str, policy: str, seed: int, bus: str, plant: str, *more: str) -> dict[str, Any]:
    """Return events, readings once a minute, and metrics of a recorded shift."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        thermofleet(
            "run", scenario, "--policy", policy, "--seed", str(seed), "--difficulty", difficulty, "--bus", bus,
            "--plant", plant, "--out", str(out), "--json", *more,
        )  # fmt: skip
        events = pq.read_table(out / "events.parquet").to_pylist()
        telemetry = pq.read_table(out / "telemetry.parquet")
        run = json.loads((out / "run.json").read_text())
    kept = np.isclose(np.asarray(telemetry["time_s"]) % EVERY_S, 0.0)
    columns = [name for name in telemetry.column_names if name not in ("arm", "mode")]
    return {
        "event_names": np.array([f"{e['kind']} {e['arm']} {e['job']} {e['joint']}" for e in events]),
        "event_numbers": np.array([[e["time_s"], e["value"]] for e in events]).reshape(-1, 2),
        "event_reasons": np.array([e["reason"] for e in events]),
        "modes": np.array(telemetry["mode"].to_pylist())[kept],
        **{f"readings {name}": np.asarray(telemetry[name])[kept] for name in columns},
        **{f"metrics {name}": np.array(value) for name, value in _flat(run["metrics"])},
        "metrics reward": np.array(run["reward"]),
    }


def _comparison(scenario: str, difficulty: str) -> dict[str, Any]:
    """Return every number of `compare --json`."""
    printed = thermofleet("compare", scenario, "--difficulty", difficulty, "--policies", ",".join(POLICIES), "--json")
    return {f"compare {name}": np.array(value) for name, value in _flat(json.loads(printed)["figures"])}


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in values.items():
        rows += _flat(value, f"{prefix}{name} ") if isinstance(value, dict) else [(f"{prefix}{name}", value)]
    return rows


def _rollouts(scenario: str, difficulty: "DifficultyName") -> dict[str, Any]:
    """Return observations, masks, rewards and infos of the single env and of a batch under random legal actions."""
    import scenarios

    out: dict[str, Any] = {}
    env = scenarios.make_env(scenario, difficulty=difficulty)
    rng = np.random.default_rng(7)
    observations, infos = env.reset(seed=5)
    rows: dict[str, list[Any]] = {"vectors": [], "masks": [], "rewards": [], "infos": []}
    for _ in range(STEPS):
        actions = {a: int(rng.choice(np.flatnonzero(o["action_mask"]))) for a, o in observations.items()}
        observations, rewards, _, _, infos = env.step(actions)
        rows["vectors"].append([o["observation"] for o in observations.values()])
        rows["masks"].append([o["action_mask"] for o in observations.values()])
        rows["rewards"].append(list(rewards.values()))
        rows["infos"].append([[float(v) for v in info.values()] for info in infos.values()])
    env.close()
    out |= {f"single {name}": np.array(values) for name, values in rows.items()}
    batch = scenarios.make_batch(scenario, num_envs=16, seed=5, difficulty=difficulty)
    seen, _ = batch.reset()
    rows = {"vectors": [], "masks": [], "rewards": [], "infos": []}
    for _ in range(STEPS):
        mask = seen["action_mask"]
        actions = (rng.random(mask.shape) * mask).argmax(axis=-1)
        seen, reward, _, _, info = batch.step(actions)
        rows["vectors"].append(env.layout.join(seen["shared"], seen["own"]))
        rows["masks"].append(seen["action_mask"].copy())
        rows["rewards"].append(reward)
        rows["infos"].append([info["jobs_done"], info["faults"].sum(axis=1), info["peak_c"].max(axis=1)])
    return out | {f"batch {name}": np.array(values) for name, values in rows.items()}


def compare(old: Path, new: Path) -> int:
    """Print the differences between two records; return the number of files that differ."""
    differing, worst = 0, {}
    names = sorted(p.name for p in old.glob("*.npz"))
    for name in names:
        if not (new / name).exists():
            print(f"{name}: missing")
            differing += 1
            continue
        one, other = np.load(old / name), np.load(new / name)
        differences = [text for key in one.files if (text := _difference(key, one, other, worst))]
        if differences:
            differing += 1
            print(f"{name}:", "; ".join(differences[:6]), f"(+{len(differences) - 6})" if len(differences) > 6 else "")
    print(f"{differing} of {len(names)} files differ")
    for key, size in sorted(worst.items()):
        print(f"  {key:<28} largest difference {size:.3g}")
    return differing


def _difference(key: str, old: Any, new: Any, worst: dict[str, float]) -> str:
    if key not in new.files:
        return f"{key} missing"
    a, b = old[key], new[key]
    if a.shape != b.shape:
        return f"{key} {a.shape} -> {b.shape}"
    if a.dtype.kind in "US":
        return "" if (a == b).all() else f"{key} differ in {(a != b).sum()}, first {a[a != b][0]!r} -> {b[a != b][0]!r}"
    one, other = a.astype(float), b.astype(float)
    if not (np.isnan(one) == np.isnan(other)).all():
        return f"{key} NaN in other places"
    size = float(np.nanmax(np.abs(one - other), initial=0.0))
    kind = " ".join(key.split()[:2])
    worst[kind] = max(worst.get(kind, 0.0), size)
    scale = max(1.0, float(np.nanmax(np.abs(one), initial=0.0)))
    return f"{key} by {size:.3g}" if size > TOLERANCE * scale else ""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("record", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    chosen = parser.parse_args()
    sys.path.insert(0, str(Path.cwd()))
    if chosen.command == "record":
        record(chosen.folders[0])
    else:
        sys.exit(bool(compare(*chosen.folders)))
