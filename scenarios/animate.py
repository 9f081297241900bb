"""`thermofleet animate`: one shift of a scenario as a GIF, seen from above."""

import math
import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.rules import RULES
from fleet.errors import FleetError
from scenarios.load import load
from scenarios.policies import label, policy_at, policy_of
from scenarios.terminal import Progress, out_console, progress_bar, say

if TYPE_CHECKING:
    from fleet.env.allocation_v0 import AllocationEnv
    from fleet.env.floor_plan import Pixel
    from scenarios.scenario import Scenario

SIZE = "960x640"
SECONDS = 20.0
FRAMES = 240
"""As many as a GIF gets unless told otherwise."""
MOST_PIXELS = 600_000_000
"""In all frames together: they are kept in memory until the file is written, a byte each."""


def animate_command(
    scenario: Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")],
    policy: Annotated[
        str, typer.Option(help=f"{', '.join(RULES)}, an own FILE.py:CLASS, or a folder of train.")
    ] = "least_difficulty",
    seed: Annotated[int, typer.Option(help="As in `thermofleet run`: the same shift.")] = 0,
    out: Annotated[Path | None, typer.Option(help="The file; default runs/SCENARIO-POLICY-SEED.gif.")] = None,
    every: Annotated[
        int | None, typer.Option(help=f"Decisions from frame to frame; default so that there are about {FRAMES}.")
    ] = None,
    size: Annotated[str, typer.Option(help="Width x height, px.")] = SIZE,
    seconds: Annotated[
        float, typer.Option(help="How long the film lasts; its last frame stands a second more.")
    ] = SECONDS,
    difficulty: Annotated[str, typer.Option(help="What scores the plans: twin, blind or oracle.")] = "twin",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace --out if it is there.")] = False,
) -> None:
    """Work one shift of a scenario and draw it: a GIF of the cell, motors in the colour of their temperature."""
    chosen = load(scenario)
    if seed < 0:
        raise FleetError(f"--seed must be 0 or more (got {seed}).")
    if not 1.0 <= seconds <= 3600.0:
        raise FleetError(f"--seconds must be from 1 to 3600 (got {seconds:g}).")
    pixels = _size(size)
    stride = _stride(chosen.ticks, every, pixels, seconds)
    policy_of(policy)
    where = out or Path("runs") / f"{chosen.name}-{label(policy)}-{seed}.gif"
    from scenarios.gif import new_gif, write_gif

    with new_gif(where, overwrite=overwrite) as file, progress_bar() as progress:
        frames = list(_frames(chosen, policy, seed, difficulty, stride, pixels, progress))
        progress("writing", 0.0)
        lasts_s = write_gif(file, frames, seconds)
    megabytes = where.stat().st_size / 1e6
    say(f"Drew {len(frames)} frames, {lasts_s:.1f} s, {megabytes:.1f} MB: {where}.", out_console)


def _size(asked: str) -> "Pixel":
    from fleet.env.floor_plan import LARGEST, SMALLEST

    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", asked)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(low <= px <= high for low, px, high in zip(SMALLEST, size, LARGEST, strict=True)):
        low, high = ("x".join(map(str, limit)) for limit in (SMALLEST, LARGEST))
        raise FleetError(f"--size must be WIDTHxHEIGHT from {low} to {high} (got '{asked}').")
    return size


def _stride(ticks: int, every: int | None, size: "Pixel", seconds: float) -> int:
    """Decisions from frame to frame."""
    from scenarios.gif import SHORTEST_S

    most = min(int(seconds / SHORTEST_S), MOST_PIXELS // (size[0] * size[1]))
    fewest = math.ceil(ticks / (most - 1))
    if every is None:
        return max(fewest, math.ceil(ticks / FRAMES))
    if every < fewest:
        raise FleetError(
            f"--every must be {fewest} or more for {ticks} decisions in {seconds:g} s of {size[0]}x{size[1]} px "
            f"(got {every})."
        )
    return every


def _frames(
    scenario: "Scenario", policy: str, seed: int, difficulty: Any, stride: int, size: "Pixel", progress: Progress
) -> Iterator[Any]:
    """The frames of a shift as indexed images: its beginning, every so many decisions, and its end."""
    from fleet.env.picture import picture
    from fleet.env.scene import scene_of
    from scenarios.build import env_of, prepare
    from scenarios.cell import cell_of
    from scenarios.gif import Palette

    fleet = prepare(scenario, difficulty=difficulty, progress=progress)
    cell, palette = cell_of(scenario), None
    title = f"{scenario.name} · {label(policy)} · seed {seed}"
    env = env_of(fleet)
    try:
        for decisions in _shift(env, policy, seed):
            progress("working", decisions / scenario.ticks)
            if env.agents and decisions % stride:
                continue
            scene = scene_of(env.world, env.truth, cell, title=title)
            palette = palette or Palette(scene, size)
            yield palette.indexed(picture(scene, size))
    finally:
        env.close()


def _shift(env: "AllocationEnv", policy: str, seed: int) -> Iterator[int]:
    """Work the shift that `thermofleet run` works with this seed; decisions made, after the reset and every step."""
    chosen = policy_at(policy, seed)
    env.reset(seed=seed)
    yield 0
    for decisions in count(1):
        if not env.agents:
            return
        env.step(chosen.act(env.knowledge()))
        yield decisions
