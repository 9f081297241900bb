"""Films of a recorded shift."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.run.log import open_run
from scenarios.show.film import Film, Shot, times

FILM = "from scenarios.cli.main import main; main()"


def film(run: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", FILM, "film", str(run), "--out", str(out), *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ | {"MUJOCO_GL": "egl"})


def has_egl() -> bool:
    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).close()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=os.environ | {"MUJOCO_GL": "egl"})
    return done.returncode == 0


def test_the_cell_takes_the_recorded_postures_and_heat(run_folder: Path) -> None:
    run = open_run(run_folder)
    shown, readings = Film(run), run.readings
    model, data = shown.player.model, shown.player.data
    hottest = int(readings.temp_c.max(axis=(1, 2)).argmax())
    temp_c, mode = shown.show(float(readings.time_s[hottest]))
    assert data.qpos == pytest.approx(readings.q[hottest].ravel())
    assert mode.tolist() == readings.mode[hottest].tolist()
    motors = [model.site(f"{arm}/motor_{j + 1}").id for arm in run.arms for j in range(7)]
    red = model.site_rgba[motors, 0] - model.site_rgba[motors, 1]
    size = model.site_size[motors, 0]
    for shows in (red, size):
        assert shows[temp_c.argmax()] > shows[temp_c.argmin()]
    shown.show(float(readings.time_s[hottest : hottest + 2].mean()))
    assert data.qpos == pytest.approx(readings.q[hottest : hottest + 2].mean(axis=0).ravel())


SEEN = """
import sys, numpy as np
from pathlib import Path
from fleet.arm.cell import CellCamera
from scenarios.run.log import open_run
from scenarios.show.film import Film
run = open_run(Path(sys.argv[1]))
film, t = Film(run), run.readings
row, arm, joint = np.unravel_index(t.temp_c.argmax(), t.temp_c.shape)
points = film.player.extent(film.postures(t.time_s))
film.show(float(t.time_s[row]))
motors = film.player.data.site_xpos[[film.player.model.site(f"{run.arms[arm]}/motor_{j + 1}").id for j in range(7)]]
with CellCamera(film.player, 640, 360, points, top=0.2, bottom=0.1) as camera:
    picture, places, (x, y) = camera.picture(), camera.pixels(points), camera.pixels(motors)[joint]
red, green, _ = picture[round(y), round(x)].astype(int)
print(*places.min(axis=0), *places.max(axis=0), red - green, picture.max(axis=2).min())
"""


@pytest.mark.skipif(not has_egl(), reason="this machine has no EGL")
def test_the_camera_holds_every_posture_and_sees_no_edge_of_the_floor(run_folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SEEN, str(run_folder)],
        capture_output=True, text=True, timeout=300, env=os.environ | {"MUJOCO_GL": "egl"},
    )  # fmt: skip
    left, upper, right, lower, redness, darkest = map(float, done.stdout.split())
    assert min(left, 640 - right) > 0
    assert upper > 0.2 * 360
    assert lower < 0.9 * 360
    assert min(left, 640 - right) < 40 or min(upper - 72, 324 - lower) < 40  # and it is no farther than it must be
    assert redness > 80  # the hottest motor is where `pixels` says
    assert darkest > 10


@pytest.mark.parametrize(("begin_s", "end_s"), [(0.0, 1e9), (600.0, 700.0)])
def test_the_pictures_follow_the_clock(run_folder: Path, begin_s: float, end_s: float) -> None:
    run = open_run(run_folder)
    at_s = times(run, Shot(begin_s=begin_s, end_s=end_s, speed=60, fps=30))
    assert np.diff(at_s) == pytest.approx(2.0)
    assert at_s[0] >= begin_s
    assert at_s[-1] <= end_s
    with pytest.raises(FleetError, match="has readings from"):
        times(run, Shot(begin_s=1e8))


@pytest.mark.parametrize(
    ("name", "options", "needed"),
    [
        ("shift.avi", [], "--out must end in .mp4, .webm, .gif"),
        ("shift.mp4", ["--size", "641x480"], "--size must be WIDTHxHEIGHT, even numbers"),
        ("shift.mp4", ["--speed", "0.1", "--fps", "60"], "Raise --speed"),
    ],
)
def test_a_film_that_cannot_be_is_refused(run_folder: Path, tmp_path: Path, name, options, needed) -> None:
    done = film(run_folder, tmp_path / name, *options)
    assert done.returncode == 2
    assert needed in " ".join(done.stderr.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["mp4", "webm", "gif"])
def test_a_film_can_be_read_by_ffmpeg_and_shows_the_heat(run_folder: Path, tmp_path: Path, kind: str) -> None:
    if not has_egl():
        done = film(run_folder, tmp_path / f"shift.{kind}", "--size", "320x240")
        assert "No OpenGL without a display" in done.stderr
        pytest.skip("this machine has no EGL")
    import av

    run = open_run(run_folder)
    hottest_s = float(run.readings.time_s[run.readings.temp_c.max(axis=(1, 2)).argmax()])
    options = ["--size", "480x270", "--speed", "60", "--fps", "10"]
    span = ["--begin", f"{hottest_s - 60}", "--end", f"{hottest_s}"]
    done = film(run_folder, tmp_path / f"shift.{kind}", *options, *span)
    assert done.returncode == 0, done.stderr
    with av.open(str(tmp_path / f"shift.{kind}")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == 11
    assert pictures[0].shape == (270, 480, 3)
    last = pictures[-1][60:220].astype(int)
    orange = (last[..., 0] > 150) & (last[..., 2] < 90)  # warm motors, and nothing else in the cell
    assert orange.sum() > 50
