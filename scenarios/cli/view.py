"""`thermofleet view`: a shift or a cell in MuJoCo's own viewer, or as a file of other viewers."""

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.cli.options import number
from scenarios.cli.terminal import out_console, progress_bar, say
from scenarios.extras import require_extra
from scenarios.result_folder import check_file, disk_errors

NO_DISPLAY = (
    "MuJoCo's viewer needs a display, and there is none (DISPLAY and WAYLAND_DISPLAY are not set). Use "
    "`thermofleet film RUN` or `--mcap`, or open the run's report.html."
)


def view_command(
    what: Annotated[str, typer.Argument(help="Folder of `thermofleet run`, or a scenario.")],
    speed: Annotated[float, number("Shift seconds per second.", 0.1, 3600)] = 30.0,
    begin: Annotated[float, number("First second of the shift.", 0, 1e9)] = 0.0,
    meshes: Annotated[bool, typer.Option("--meshes", help="Kinova's shells; needs the extra `meshes`.")] = False,
    mcap: Annotated[
        Path | None,
        typer.Option(
            help="Write the run as this file (.mcap) instead, in messages of ROS 2, for Foxglove, Rerun, RViz or "
            "PlotJuggler; needs the extra `mcap`."
        ),
    ] = None,
    gltf: Annotated[
        Path | None,
        typer.Option(
            help="Write the run as this file (.glb) instead, for viewers of augmented reality and of the web; --speed "
            "is that of its animation."
        ),
    ] = None,
    every: Annotated[
        float | None,
        number(
            "Time between two postures in these files, s. Default: as recorded, up to 250,000 postures.", 0.01, 3600
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Play a recorded shift in MuJoCo's viewer, or show the cell of a scenario; close its window to end.

    With --mcap or --gltf the shift is written as a file instead, without a display.
    """
    if mcap is not None or gltf is not None:
        _write_files(what, mcap, gltf, every, speed, overwrite)
        return
    if every is not None:
        raise FleetError("--every is for --mcap and --gltf.")
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise FleetError(NO_DISPLAY)
    import numpy as np

    from fleet.physics.cell_player import CellPlayer
    from scenarios.load import load
    from scenarios.run.stored_run import read_run
    from scenarios.show.film import Film, show_heat

    if (Path(what) / "run.json").exists():
        run = read_run(Path(what))
        film, last_s, began_s = Film(run, meshes=meshes), float(run.telemetry.time_s[-1]), time.monotonic()
        player = film.player

        def update() -> object:
            return film.show(min(begin + speed * (time.monotonic() - began_s), last_s))

    else:
        scenario = load(what)
        robots = [arm.robot() for arm in scenario.arms]
        player = CellPlayer(robots, scenario.places, scenario.fixtures, meshes=meshes)
        home = np.array([robot.home_q for robot in robots])
        ambient_c = np.full(home.shape, 20.0)

        def update() -> object:
            return show_heat(player, home, ambient_c, np.zeros(len(robots)), scenario.limits)

    say(f"Showing '{what}'; close the window to end.", out_console)
    player.open_viewer(update)


def _write_files(
    what: str,
    mcap: Path | None,
    gltf: Path | None,
    every_s: float | None,
    speed: float,
    overwrite: bool,
) -> None:
    wanted = [("mcap", mcap, ".mcap"), ("gltf", gltf, ".glb")]
    files = {name: (path, ending) for name, path, ending in wanted if path is not None}
    extras = {"mcap": ("mcap", "ros2"), "gltf": ("report",)}
    for name, (path, ending) in files.items():
        check_file(path, (ending,), overwrite, f"--{name}")
        for extra in extras[name]:
            require_extra(extra)
    if not (Path(what) / "run.json").exists():
        raise FleetError(f"--mcap and --gltf need the folder of a `thermofleet run` (got '{what}').")
    from scenarios.run.stored_run import read_run
    from scenarios.show.moments import Moments

    moments = Moments(read_run(Path(what)), every_s)
    for name, (path, _) in files.items():
        with progress_bar(kept="") as progress, disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as file:
                if name == "mcap":
                    from scenarios.show.mcap import write_mcap

                    write_mcap(file, moments, progress)
                else:
                    from scenarios.show.gltf import write_gltf

                    write_gltf(file, moments, speed, progress)
        hints = {
            "mcap": f"open it in Foxglove, or: ros2 bag play {path}",
            "gltf": f"{speed:g} × real time; open it in Blender or a web viewer",
        }
        size = f"{path.stat().st_size / 1e6:.1f} MB"
        say(f"Wrote {len(moments.poses)} moments, {size}: {path} ({hints[name]}).", out_console)
