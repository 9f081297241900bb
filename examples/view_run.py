"""Play a recorded shift in MuJoCo's viewer, with motors coloured by their temperature.

    thermofleet run quickstart --out runs/one
    python examples/view_run.py runs/one --speed 30
    MUJOCO_GL=egl python examples/view_run.py runs/one --png cell.png --at 1800    # one picture, without a display

Needs a folder of `thermofleet run`. The viewer's own buttons move the camera; closing its window ends the program.
"""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import argparse
import json
import threading
import time
from pathlib import Path

import msgspec
import mujoco
import mujoco.viewer
import numpy as np
import pyarrow.parquet as pq

from fleet.env.render.heat import heat_colour
from fleet.errors import FleetError
from fleet.physics.models import build_cell
from fleet.robot import JOINTS
from scenarios.run.run_folder import check_format
from scenarios.schema import Scenario

FRAME_S = 1 / 30
MOTOR_M = 0.058


class Player:
    """Puts a model of the cell into the recorded postures."""

    def __init__(self, run):
        card = json.loads((run / "run.json").read_text(encoding="utf-8"))
        check_format(card, run)
        self.scenario = msgspec.convert(card["scenario"], Scenario)
        robots = [arm.robot() for arm in self.scenario.arms]
        self.model = build_cell(robots, self.scenario.places, self.scenario.fixtures)
        self.data = mujoco.MjData(self.model)
        table = pq.read_table(run / "telemetry.parquet")
        self.time_s = table["time_s"].to_numpy()[:: len(robots)]
        self.q, self.temp_c = (
            np.stack([table[f"{name}_{joint + 1}"].to_numpy() for joint in range(JOINTS)], axis=-1).reshape(
                len(self.time_s), len(robots) * JOINTS
            )
            for name in ("q", "temp_c")
        )
        sites = [f"{robot.name}/motor_{joint + 1}" for robot in robots for joint in range(JOINTS)]
        self.motors = [self.model.site(name).id for name in sites]
        self.model.site_size[self.motors], self.model.site_group[self.motors] = MOTOR_M, 0

    def show(self, at_s):
        """Show the cell at a time of the shift."""
        row = min(int(np.searchsorted(self.time_s, at_s)), len(self.time_s) - 1)
        before = max(row - 1, 0)
        share = np.interp(at_s, self.time_s[[before, row]], (0.0, 1.0)) if row else 1.0
        self.data.qpos[:] = (1 - share) * self.q[before] + share * self.q[row]
        limits = self.scenario.limits
        self.model.site_rgba[self.motors, :3] = heat_colour(self.temp_c[row], limits.warning_c, limits.error_c)
        mujoco.mj_forward(self.model, self.data)


def main():
    """Play the shift, or write one picture."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("--speed", type=float, default=30.0, help="shift seconds per second")
    parser.add_argument("--at", type=float, default=0.0, help="first second of the shift to show")
    parser.add_argument("--png", type=Path, help="write one picture instead")
    given = parser.parse_args()
    try:
        player = Player(given.run)
    except (OSError, ValueError, KeyError, TypeError, FleetError) as error:
        parser.error(f"cannot play '{given.run}': {error}")
    if given.png:
        from PIL import Image

        player.show(given.at)
        with mujoco.Renderer(player.model, 480, 640) as renderer:
            renderer.update_scene(player.data)
            Image.fromarray(renderer.render()).save(given.png)
        return
    pause = threading.Event()
    with mujoco.viewer.launch_passive(player.model, player.data) as viewer:
        began_s, at_s = time.monotonic(), given.at
        while viewer.is_running() and at_s < player.time_s[-1]:
            at_s = given.at + given.speed * (time.monotonic() - began_s)
            with viewer.lock():
                player.show(at_s)
            viewer.sync()
            pause.wait(FRAME_S)


if __name__ == "__main__":
    main()
