"""`thermofleet view`: a shift or a cell in MuJoCo's own viewer."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import os
import sys
import threading
import time
from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli.options import number
from scenarios.cli.terminal import out_console, say

FRAME_S = 1 / 30
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
    import mujoco.viewer
    import numpy as np

    from fleet.physics.cell_player import CellPlayer
    from scenarios.load import load
    from scenarios.run.stored_run import read_run
    from scenarios.view.film import Film

    pause = threading.Event()
    if (Path(what) / "run.json").exists():
        run = read_run(Path(what))
        film = Film(run, meshes=meshes)
        player, last_s = film.player, float(run.telemetry.time_s[-1])
    else:
        scenario, film, last_s = load(what), None, 0.0
        robots = [arm.robot() for arm in scenario.arms]
        player = CellPlayer(robots, scenario.places, scenario.fixtures, limits=scenario.limits, meshes=meshes)
        home = np.array([robot.home_q for robot in robots])
        player.show(home, np.full(home.shape, 20.0), np.zeros(len(robots)))
    say(f"Showing '{what}'; close the window to end.", out_console)
    with mujoco.viewer.launch_passive(player.model, player.data) as viewer:
        began_s = time.monotonic()
        while viewer.is_running():
            at_s = begin + speed * (time.monotonic() - began_s)
            if film is not None:
                with viewer.lock():
                    film.show(min(at_s, last_s))
            viewer.sync()
            pause.wait(FRAME_S)
