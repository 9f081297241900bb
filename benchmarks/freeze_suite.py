"""Calibrate cells and write the manifests: python -m benchmarks.freeze_suite [CELL …] [--check].

Existing files are frozen: the output must equal them.

The named cells, and those without any calibration, are calibrated; then all manifests are written. It plans every cell
and needs no twins. With --check it calibrates nothing, and plays `wspt` on other seeds of each cell and level.

Calibration: the duration of a job of each task is the mean over able arms, payloads, and fewest and most repetitions.
The ambient temperature of a level is that at which `wspt` has the level's expected number of faults: bisection on
few shifts, then interpolation between the means of four times as many at three temperatures, all with the same seeds.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

from fleet.seeding import shift_seeds
from scenarios.evaluate.rollout import outcomes
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.spec.jobs import alternatives_of, draw_jobs
from scenarios.spec.parse import hash_of, scenario_hash
from scenarios.spec.schema import SPLITS, SplitName, SurpriseKind
from scenarios.suite.instances import (
    CELLS,
    COOL_C,
    FAULTS,
    Axes,
    Calibration,
    Level,
    SuiteCell,
    Surprising,
    calibrations,
    layout,
    scenario_of,
    tasks_of,
)
from scenarios.suite.splits import Instance, ManifestLine, instance_of, line_of

FOLDER = Path(__file__).parents[1] / "scenarios" / "suite"
DRAWS, SHIFTS = 12, 8
"""Draws of the axes, and shifts of each, that an expected number of faults is the mean of."""
LOWEST_C, HIGHEST_C, STEP_C = 4.0, 36.0, 0.6
"""Ambient temperatures that are tried, and how close the bisection comes."""
APART_C = 8.0
"""Most by which a level is warmer than the one below, if that is enough."""
COOLER_K = 7.0
"""Least by which the level cool is cooler than warm."""
TOLERANCE = 0.25
"""Share by which the faults of a level may differ on other seeds."""
SUITE = 37
"""Seed of all draws of the suite."""
DIGITS = 3
"""Decimals of times in a hash of jobs, s: the last bits of a logarithm differ between platforms."""
SURPRISE_EVERY = 3
"""In one of three instances something surprises the arms."""
OFTEN = {"arrivals": "waves", "faults": "attended", "bus": "perfect"}
"""Values that half of all instances have; all others are equally frequent."""


def draw_axes(rng: np.random.Generator, heat: Level, surprises: Sequence[Surprising] = ("nothing",)) -> Axes:
    """Values sampled independently, but for the level of heat.

    Args:
        surprises: One of these surprises the arms.
    """
    values: dict[str, Any] = {}  # literals of several types
    for name, kind in get_type_hints(Axes).items():
        if name == "surprise":
            break
        choices = list(get_args(kind))
        weights = np.array([len(choices) - 1.0 if choice == OFTEN.get(name) else 1.0 for choice in choices])
        values[name] = choices[int(rng.choice(len(choices), p=weights / weights.sum()))]
    return Axes(**{**values, "heat": heat}, surprise=surprises[int(rng.integers(len(surprises)))])


def surprises_in(cell: SuiteCell) -> tuple[Surprising, ...]:
    """Kinds of surprises that a cell can have: without a fan none stops."""
    fans = any(arm.cooling == "forced_air" for arm in layout(cell).arms)
    return tuple(kind for kind in get_args(SurpriseKind) if fans or kind != "fan")


def drawn_rows(name: SplitName) -> Iterator[ManifestLine]:
    """Sample the lines of a split again, in turns from each of its cells."""
    cells = [cell for cell in CELLS if cell.split == name]
    turns = range(max(cell.instances for cell in cells))
    levels = list(FAULTS)
    chosen = [(turn, cell) for turn in turns for cell in cells if turn < cell.instances]
    for number, (turn, cell) in enumerate(chosen):
        entropy = np.random.SeedSequence([SUITE, SPLITS.index(name), number])
        seed = int(entropy.generate_state(1)[0])
        heat = levels[0 if cell.asks == "light_work" else turn % len(levels)]
        surprised = (turn + cells.index(cell)) % SURPRISE_EVERY == 0
        surprises = surprises_in(cell) if surprised else ("nothing",)
        axes = draw_axes(np.random.default_rng(entropy.spawn(1)[0]), heat, surprises)
        row = ManifestLine(f"{name}/{number:04d}", cell.name, axes, seed, "", "", 0)
        made = instance_of(row)
        jobs = jobs_content(made)
        yield replace(row, scenario=scenario_hash(made.scenario), jobs=hash_of(jobs), count=len(jobs))


def jobs_content(made: Instance) -> list[Any]:
    """The jobs of an instance's shift as JSON values, in order of release."""
    jobs = draw_jobs(made.scenario, shift_seeds(np.random.SeedSequence(made.seed))[0])
    return [
        [job.name, job.work.kind, [work.stations for work in job.works], job.work.payload_kg, job.repetitions,
         round(job.release_s, DIGITS), round(job.due_s, DIGITS), job.value, job.after, job.expires]
        for job in jobs
    ]  # fmt: skip


def minutes_of(cell: SuiteCell) -> tuple[dict[str, float], Fleet]:
    """Mean duration of a job of each task, min, and the fleet."""
    some = Calibration(
        dict.fromkeys([task.name for task in tasks_of(cell)], 10.0), dict.fromkeys(get_args(Level), 25.0)
    )
    axes = replace(draw_axes(np.random.default_rng(0), "cool"), arrivals="poisson")
    fleet = prepare(scenario_of(cell.name, cell, axes, 0, some), difficulty="blind")
    minutes: dict[str, list[float]] = {}
    for stream in fleet.scenario.jobs:
        task = next(task.name for task in tasks_of(cell) if stream.name.startswith(task.name))
        for payload_kg in stream.payload_kg:
            works = alternatives_of(fleet.scenario, stream, payload_kg)
            for arm in fleet.arms:
                for repetitions in stream.repetitions:
                    offered = arm.offers(*works)[repetitions]
                    minutes.setdefault(task, []).extend(plan.duration_s(repetitions) / 60.0 for plan, _ in offered[:1])
    return {task: round(float(np.mean(each)), 3) for task, each in minutes.items()}, fleet


def faults_of(
    cell: SuiteCell, known: Calibration, level: Level, fleet: Fleet, first_seed: int, draws: int = DRAWS
) -> np.ndarray:
    """Faults of `wspt` in shifts of a level, [draw · shift]; of many arms, half as many draws."""
    draws = draws // 2 if cell.arms > 8 else draws
    counts: list[float] = []
    for draw in range(draws):
        axes = draw_axes(np.random.default_rng([first_seed, draw]), level)
        scenario = scenario_of(cell.name, cell, axes, first_seed + draw, known)
        own = prepare(scenario, difficulty="blind", like=fleet)
        seeds = range(first_seed + SHIFTS * draw, first_seed + SHIFTS * (draw + 1))
        counts += [each.faults for each in outcomes(own, "wspt", seeds)]
    return np.array(counts)


def calibrated(cell: SuiteCell) -> Calibration:
    """Durations of the tasks, and the ambient temperature of each level."""
    minutes, fleet = minutes_of(cell)
    ambient_c: dict[Level, float] = {"cool": COOL_C}
    if cell.asks == "light_work":
        return Calibration(minutes, ambient_c)

    def is_cooler(level: Level, air_c: float) -> bool:
        tried = Calibration(minutes, {**ambient_c, level: air_c})
        return bool(faults_of(cell, tried, level, fleet, 1_000_000).mean() < FAULTS[level])

    def found(level: Level, air_c: float) -> float:
        """Where four times as many shifts have the level's faults, by interpolation around a temperature."""
        tried_c = air_c + STEP_C * np.array([-1.5, 0.0, 1.5])
        known = [Calibration(minutes, {**ambient_c, level: float(each)}) for each in tried_c]
        means = [faults_of(cell, each, level, fleet, 1_000_000, 4 * DRAWS).mean() for each in known]
        slope, offset = np.polyfit(tried_c, means, 1)
        return float(np.clip((FAULTS[level] - offset) / slope, *tried_c[[0, -1]]))

    low_c = LOWEST_C
    for level in list(FAULTS)[1:]:
        high_c = HIGHEST_C if level == "warm" else min(HIGHEST_C, low_c + APART_C)
        if high_c < HIGHEST_C and is_cooler(level, high_c):
            low_c, high_c = high_c, HIGHEST_C
        while high_c - low_c > STEP_C:
            middle_c = (low_c + high_c) / 2.0
            low_c, high_c = (middle_c, high_c) if is_cooler(level, middle_c) else (low_c, middle_c)
        low_c = found(level, (low_c + high_c) / 2.0)
        ambient_c[level] = round(low_c, 2)
    ambient_c["cool"] = round(min(COOL_C, ambient_c["warm"] - COOLER_K), 2)
    return Calibration(minutes, ambient_c)


def check(cells: Sequence[SuiteCell]) -> bool:
    """Print the faults of every cell and level on other seeds; whether all are as expected."""
    right = True
    print(f"{'cell':32s}{'asks':14s}" + "".join(f"{level:>22s}" for level in FAULTS))
    for cell in cells:
        _, fleet = minutes_of(cell)
        texts: list[str] = []
        for level in calibrations()[cell.name].ambient_c:
            wanted = FAULTS[level]
            found = faults_of(cell, calibrations()[cell.name], level, fleet, 2_000_000, 2 * DRAWS)
            mean, error = float(found.mean()), float(found.std() / np.sqrt(len(found)))
            fits = abs(mean - wanted) <= max(TOLERANCE * wanted, 0.02)
            right &= fits
            ambient_c = calibrations()[cell.name].ambient_c[level]
            texts.append(f"{mean:.2f} ± {error:.2f}{' ' if fits else '!'}({ambient_c:.1f} °C)")
        print(f"{cell.name:32s}{cell.asks:14s}" + "".join(f"{text:>22s}" for text in texts), flush=True)
    return right


def main(names: list[str]) -> int:
    """Calibrate cells, and write the manifests; or check."""
    cells = [cell for cell in CELLS if cell.name in names] or list(CELLS)
    if "--check" in names:
        return 0 if check(cells) else 1
    path = FOLDER / "calibration.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known = {cell.name: known[cell.name] for cell in CELLS if cell.name in known}
    for cell in CELLS:
        if cell.name in names or cell.name not in known:
            known[cell.name] = asdict(calibrated(cell))
            lines = ",\n".join(f' "{each}": {json.dumps(own)}' for each, own in known.items())
            path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
            print(cell.name, known[cell.name], flush=True)
    calibrations.cache_clear()
    for name in SPLITS:
        text = "".join(line_of(row) + "\n" for row in drawn_rows(name))
        (FOLDER / f"{name}.jsonl").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
