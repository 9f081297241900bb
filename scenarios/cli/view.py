"""`thermofleet view`: a shift or a cell in MuJoCo's own viewer."""

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli.options import number
from scenarios.cli.terminal import out_console, say

NO_DISPLAY = (
    "MuJoCo's viewer needs a display, and there is none (DISPLAY and WAYLAND_DISPLAY are not set). Use "
    "`thermofleet film RUN`, or open the run's report.html."
)


def view_command(
    what: Annotated[str, typer.Argument(help="Folder of `thermofleet run`, or a scenario.")],
    speed: Annotated[float, number("Shift seconds per second.", 0.1, 3600)] = 30.0,
    begin: Annotated[float, number("First second of the shift.", 0, 1e9)] = 0.0,
    meshes: Annotated[bool, typer.Option("--meshes", help="Kinova's shells; needs the extra `meshes`.")] = False,
) -> None:
    """Play a recorded shift in MuJoCo's viewer, or show the cell of a scenario; close its window to end."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise FleetError(NO_DISPLAY)
    import numpy as np

    from fleet.physics.cell_player import CellPlayer
    from scenarios.load import load
    from scenarios.run.stored_run import read_run
    from scenarios.view.film import Film, show_heat

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
