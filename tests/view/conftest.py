"""A recorded shift with a hot arm, shared by the tests that show it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scenarios.run.log import RunLog, open_run
from scenarios.show.film import Film
from tests.commands import call


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shift") / "run"
    options = ["--policy", "round_robin", "--seed", 11, "--difficulty", "blind", "--bus", "memory"]
    assert call("run", "quickstart", *options, "--out", folder) == 0
    return folder


@pytest.fixture(scope="session")
def run(run_folder: Path) -> RunLog:
    return open_run(run_folder)


@pytest.fixture(scope="session")
def motors_in_mujoco(run: RunLog) -> Callable[[float], np.ndarray]:
    """Positions of the motors in the world at a time, as MuJoCo has them, [arm, joint, 3]."""
    film = Film(run)
    data, model = film.player.data, film.player.model
    sites = np.array([[model.site(f"{arm}/motor_{j + 1}").id for j in range(7)] for arm in run.arms])

    def positions(time_s: float) -> np.ndarray:
        film.show(time_s)
        return data.site_xpos[sites]

    return positions
