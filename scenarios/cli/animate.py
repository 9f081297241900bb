"""`thermofleet animate`: draw one shift of a scenario from above, as a GIF."""

import math
import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agents.registry import NAMES_HELP
from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.cli.options import MAX_SEED, DifficultyOption, RiskOption, ScenarioArg, number
from scenarios.cli.terminal import out_console, progress_bar, say
from scenarios.load import load
from scenarios.policy_loader import label, policy_at, policy_of
from scenarios.progress import Progress
from scenarios.result_folder import check_file, disk_errors
from scenarios.schema_errors import choose

if TYPE_CHECKING:
    import numpy as np

    from fleet.env.render.floor_plan import Pixel
    from scenarios.schema import Scenario

SIZE = "960x640"
SECONDS = 20.0
FRAMES = 240
"""Default number of frames, about."""
MOST_PIXELS = 600_000_000
"""Of all frames together: they stay in memory until the file is written, one byte per pixel."""


def animate_command(
    scenario: ScenarioArg,
    policy: Annotated[str, typer.Option(help=NAMES_HELP)] = "least_difficulty",
    seed: Annotated[int, number("Random seed; same shift as in `thermofleet run`.", 0, MAX_SEED)] = 0,
    out: Annotated[Path | None, typer.Option(help="Output file; default runs/SCENARIO-POLICY-SEED.gif.")] = None,
    every: Annotated[
        int | None, number(f"Decisions between frames; by default chosen for about {FRAMES} frames.", 1, 1_000_000)
    ] = None,
    size: Annotated[str, typer.Option(help="Width x height, px.")] = SIZE,
    seconds: Annotated[
        float, number("Length of the animation, s; the last frame is held 1 s longer.", 1, 3600)
    ] = SECONDS,
    difficulty: DifficultyOption = "twin",
    risk: RiskOption = "rc",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace --out if it exists.")] = False,
) -> None:
    """Simulate one shift and draw it as a GIF: the cell from above, motors coloured by temperature."""
    chosen = load(scenario)
    pixels = _size(size)
    stride = _stride(chosen.ticks, every, pixels, seconds)
    policy_of(policy)
    where = out or Path("runs") / f"{chosen.name}-{label(policy)}-{seed}.gif"
    check_file(where, ".gif", overwrite)
    from scenarios.report.gif import write_gif

    with disk_errors(where):
        where.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar() as progress, disk_errors(where), atomic_path(where) as file:
        frames = _frames(chosen, policy, seed, (difficulty, risk), stride, pixels, progress)
        images, length_s = write_gif(file, frames, seconds)
    say(f"Drew {images} frames, {length_s:.1f} s, {where.stat().st_size / 1e6:.1f} MB: {where}.", out_console)


def _size(asked: str) -> "Pixel":
    from fleet.env.render.floor_plan import LARGEST, SMALLEST

    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", asked)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(low <= px <= high for low, px, high in zip(SMALLEST, size, LARGEST, strict=True)):
        low, high = ("x".join(map(str, limit)) for limit in (SMALLEST, LARGEST))
        raise FleetError(f"--size must be WIDTHxHEIGHT from {low} to {high} (got '{asked}').")
    return size


def _stride(ticks: int, every: int | None, size: "Pixel", seconds: float) -> int:
    """Decisions from frame to frame."""
    from scenarios.report.gif import SHORTEST_S

    most = min(int(seconds / SHORTEST_S), MOST_PIXELS // (size[0] * size[1]))
    least = math.ceil(ticks / (most - 1))
    if every is None:
        return max(least, math.ceil(ticks / FRAMES))
    if every < least:
        raise FleetError(
            f"--every must be {least} or more for {ticks} decisions in {seconds:g} s of {size[0]}x{size[1]} px "
            f"(got {every})."
        )
    return every


def _frames(
    scenario: "Scenario",
    policy: str,
    seed: int,
    models: tuple[str, str],
    stride: int,
    size: "Pixel",
    progress: Progress,
) -> "Iterator[np.ndarray]":
    """Frames of the shift of `thermofleet run` with this seed: its start, every `stride` decisions, its end.

    Args:
        models: What difficulty and risk follow from.
    """
    from fleet.env.render.picture import Picture
    from fleet.env.render.scene import scene_of
    from scenarios.cell_layout import cell_of
    from scenarios.prepare.fleet import DifficultyName, RiskName, env_of, prepare

    difficulty, risk = choose("difficulty", models[0], DifficultyName), choose("risk", models[1], RiskName)
    fleet = prepare(scenario, difficulty=difficulty, risk=risk, progress=progress)
    cell, picture, chosen = cell_of(scenario), Picture(size), policy_at(policy, seed)
    title = f"{scenario.name} · {label(policy)} · seed {seed}"
    env = env_of(fleet)
    try:
        env.reset(seed=seed)
        for decisions in count():
            progress("working", decisions / scenario.ticks)
            if not env.agents or decisions % stride == 0:
                yield picture.frame(scene_of(env.world, env.truth, cell, title=title))
            if not env.agents:
                return
            env.step(chosen.act(env.knowledge()))
    finally:
        env.close()
