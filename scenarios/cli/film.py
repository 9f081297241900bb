"""`thermofleet film`: a film of a recorded shift, rendered without a display."""

import os
import re
import sys
from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.cli.options import number
from scenarios.cli.terminal import out_console, progress_bar, say
from scenarios.progress import Count
from scenarios.result_folder import check_file, disk_errors

ENDINGS = (".mp4", ".webm", ".gif")
SMALLEST, LARGEST = 160, 3840
"""Width and height, px."""
MOST_FRAMES = 100_000
MOST_GIF_PIXELS = 600_000_000
"""Of all frames of a GIF together: they stay in memory until the file is written."""


def film_command(
    run: Annotated[Path, typer.Argument(help="Folder of `thermofleet run`.")],
    out: Annotated[Path, typer.Option(help="Output file: .mp4, .webm or .gif.")] = Path("shift.mp4"),
    speed: Annotated[float, number("Shift seconds per second of the film.", 0.1, 3600)] = 120.0,
    fps: Annotated[int, number("Pictures per second.", 1, 60)] = 30,
    size: Annotated[str, typer.Option(help="Width x height, px; even numbers.")] = "1280x720",
    begin: Annotated[float, number("First second of the shift.", 0, 1e9)] = 0.0,
    end: Annotated[float | None, number("Last second of the shift; by default its end.", 0, 1e9)] = None,
    meshes: Annotated[bool, typer.Option("--meshes", help="Kinova's shells; needs the extra `meshes`.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace --out if it exists.")] = False,
) -> None:
    """Film a recorded shift: the arms move, their motors coloured by temperature."""
    suffix = out.suffix.lower()
    check_file(out, ENDINGS, overwrite)
    width, height = _size(size)
    if sys.platform.startswith("linux"):  # MuJoCo chooses its OpenGL when it is loaded, and the default needs a display
        os.environ.setdefault("MUJOCO_GL", "egl")
    from scenarios.run.stored_run import read_run
    from scenarios.show.film import Shot, frames, times, write_film

    shot = Shot(
        speed=speed,
        fps=fps,
        width=width,
        height=height,
        begin_s=begin,
        end_s=float("inf") if end is None else end,
        meshes=meshes,
    )
    stored = read_run(run)
    at_s = times(stored, shot)
    most = min(MOST_FRAMES, MOST_GIF_PIXELS // (width * height)) if suffix == ".gif" else MOST_FRAMES
    if len(at_s) > most:
        raise FleetError(
            f"The film would have {len(at_s)} pictures; at most {most} are possible in this size. Raise --speed (now "
            f"{speed:g}), lower --fps (now {fps}), or choose a part with --begin and --end."
        )
    with progress_bar() as progress, disk_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)

        def counted():
            for number, picture in enumerate(frames(stored, shot, at_s), 1):
                progress("filming", Count(number, len(at_s)))
                yield picture

        with atomic_path(out) as file:
            count = write_film(file, suffix[1:], counted(), shot)
    length_s, megabytes = count / fps, out.stat().st_size / 1e6
    say(f"Filmed {count} pictures, {length_s:.1f} s, {megabytes:.1f} MB: {out}.", out_console)


def _size(asked: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", asked)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(SMALLEST <= px <= LARGEST and px % 2 == 0 for px in size):
        raise FleetError(
            f"--size must be WIDTHxHEIGHT, even numbers from {SMALLEST} to {LARGEST} (got '{asked}'), as in 1280x720."
        )
    return size
