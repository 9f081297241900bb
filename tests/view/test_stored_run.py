"""A run read from its folder, its films, and its files for other viewers."""

import base64
import gzip
import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet.errors import FleetError
from fleet.events import Event
from fleet.ros2.cdr import read, read_diagnostics, read_joints
from fleet.telemetry import MODES, Telemetry
from scenarios.run.log import RunLog, open_run, telemetry_table
from scenarios.show.film import Film, Shot, times
from scenarios.show.moments import Moments
from scenarios.show.page import packed


def unpacked(text: str) -> dict[str, tuple[dict, np.ndarray]]:
    """Every array of a playback with its entry in the list, decoded as its docstring says."""
    raw = gzip.decompress(base64.b64decode(text))
    head, _, body = raw.partition(b"\n")
    out, at = {}, 0
    for entry in json.loads(head):
        count = int(np.prod(entry["shape"]))
        steps = np.frombuffer(body, "<i2", count, at).reshape(entry["shape"]).astype(np.int64)
        at += 2 * count
        out[entry["name"]] = entry, np.cumsum(steps, axis=-1).astype(np.int16) * entry["scale"]
    assert at == len(body)
    return out


def test_the_readings_are_those_of_the_file(run: RunLog, run_folder: Path) -> None:
    again = telemetry_table(run.readings, list(run.arms))
    assert again.drop_columns(["arm", "mode"]).equals(
        pq.read_table(run_folder / "telemetry.parquet").drop_columns(["arm", "mode"])
    )
    assert {job.job for job in run.jobs} >= {event.job for event in run.events if event.job}
    awards = [event for event in run.events if event.kind == "award"]
    assert len(run.offers) == len(awards) * len(run.arms)
    assert [(o.time_s, o.job, o.arm) for o in run.offers if o.awarded] == [(e.time_s, e.job, e.arm) for e in awards]


def test_a_page_gets_the_shift_within_its_resolution(run: RunLog) -> None:
    readings = run.readings
    arrays = unpacked(packed(readings))
    for name, resolution in (("q", 0.51e-3), ("temp_c", 0.051)):
        entry, values = arrays[name]
        stride = round(entry["step_s"] / float(readings.time_s[1] - readings.time_s[0]))
        np.testing.assert_allclose(np.moveaxis(values, -1, 0), getattr(readings, name)[::stride], atol=resolution)


def test_an_absent_arm_keeps_its_last_posture() -> None:
    q = np.tile(np.arange(6.0)[:, None, None], (1, 2, 7))
    q[2:4, 1] = q[0, 0] = np.nan
    still = np.zeros_like(q)
    readings = Telemetry(np.arange(6.0), np.ones((6, 2), int), q, still, still, still, still)
    arrays = unpacked(packed(readings))
    np.testing.assert_allclose(arrays["q"][1][1, 0], [0, 1, 1, 1, 4, 5])
    np.testing.assert_allclose(arrays["q"][1][0, 0], [1, 1, 2, 3, 4, 5])
    assert arrays["mode"][1].tolist() == [[-1, 1, 1, 1, 1, 1], [1, 1, -1, -1, 1, 1]]


NO_RUN = "no complete folder of `thermofleet run`"


def cut_short(file: Path) -> None:
    file.write_bytes(b"PAR1 cut short")


def without_rows(file: Path) -> None:
    pq.write_table(pq.read_table(file).slice(0, 0), file)


def of_a_ghost(events: Path) -> None:
    table = pq.read_table(events)
    ghosts = pa.array(["ghost"] * table.num_rows)
    pq.write_table(table.set_column(table.column_names.index("arm"), "arm", ghosts), events)


def of_an_earlier_environment(card: Path) -> None:
    card.write_text(card.read_text(encoding="utf-8").replace('"allocation_v2"', '"allocation_v1"'), encoding="utf-8")


@pytest.mark.parametrize(
    ("damage", "file", "says"),
    [
        (cut_short, "jobs.parquet", NO_RUN),
        (cut_short, "telemetry.parquet", NO_RUN),
        (cut_short, "run.json", NO_RUN),
        (lambda card: card.write_text("[6]"), "run.json", NO_RUN),
        (without_rows, "telemetry.parquet", "has no rows"),
        (of_a_ghost, "events.parquet", "No arm 'ghost'"),
        (
            of_an_earlier_environment, "run.json",
            r"is a run of format 6 in allocation_v1; this version reads 6 in allocation_v2\.",
        ),
    ],
)  # fmt: skip
def test_a_damaged_run_is_refused_in_words(run_folder: Path, tmp_path: Path, damage, file: str, says: str) -> None:
    copied = shutil.copytree(run_folder, tmp_path / "run")
    damage(copied / file)
    with pytest.raises(FleetError, match=says):
        open_run(copied)


def test_the_report_written_anew_is_the_same(run_folder: Path, tmp_path: Path, thermofleet) -> None:
    thermofleet("report", run_folder, "--out", tmp_path / "again.html").succeeded()
    assert (tmp_path / "again.html").read_bytes() == (run_folder / "report.html").read_bytes()


FILM = "from scenarios.cli.main import main; main()"


def film(run: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", FILM, "view", str(run), "--out", str(out), *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ | {"MUJOCO_GL": "egl"})


def has_egl() -> bool:
    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16).close()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=os.environ | {"MUJOCO_GL": "egl"})
    return done.returncode == 0


def test_the_cell_takes_the_recorded_postures_and_heat(run: RunLog) -> None:
    shown, readings = Film(run), run.readings
    model, data = shown.player.model, shown.player.data
    hottest = int(readings.temp_c.max(axis=(1, 2)).argmax())
    temp_c, mode = shown.show(float(readings.time_s[hottest]))
    assert data.qpos == pytest.approx(readings.q[hottest].ravel())
    assert mode.tolist() == readings.mode[hottest].tolist()
    motors = [model.site(f"{arm}/motor_{j + 1}").id for arm in run.arms for j in range(7)]
    red = model.site_rgba[motors, 0] - model.site_rgba[motors, 1]
    size = model.site_size[motors, 0]
    assert model.site_size[motors, 1] == pytest.approx(0.8 * size)
    assert (model.site_type[motors] == mujoco.mjtGeom.mjGEOM_CYLINDER).all()  # pyright: ignore[reportAttributeAccessIssue]
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


@pytest.mark.ci_slow
def test_the_camera_holds_every_posture_and_sees_no_edge_of_the_floor(run_folder: Path) -> None:
    if not has_egl():
        pytest.skip("this machine has no EGL")
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
def test_the_pictures_follow_the_clock(run: RunLog, begin_s: float, end_s: float) -> None:
    at_s = times(run, Shot(begin_s=begin_s, end_s=end_s, speed=60, fps=30))
    assert np.diff(at_s) == pytest.approx(2.0)
    assert at_s[0] >= begin_s
    assert at_s[-1] <= end_s
    with pytest.raises(FleetError, match="has readings from"):
        times(run, Shot(begin_s=1e8))


@pytest.mark.ci_slow
@pytest.mark.parametrize("kind", ["mp4", "webm", "gif"])
def test_a_film_can_be_read_by_ffmpeg_and_shows_the_heat(
    run: RunLog, run_folder: Path, tmp_path: Path, kind: str
) -> None:
    if not has_egl():
        done = film(run_folder, tmp_path / f"shift.{kind}", "--size", "320x240")
        assert "No OpenGL without a display" in done.stderr
        pytest.skip("this machine has no EGL")
    import av

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


EVERY_S = 20


def along(parents: dict[str, str], poses: dict[str, tuple[list[float], list[float]]], frame: str) -> np.ndarray:
    """Origin of a frame in the world; poses are positions and quaternions w, x, y, z."""
    point = np.zeros(3)
    while frame in parents:
        position, quaternion = poses[frame]
        turned = np.empty(3)
        mujoco.mju_rotVecQuat(turned, point, np.array(quaternion))
        point, frame = turned + position, parents[frame]
    return point


def test_a_break_of_several_arms_is_one_line_of_the_log_of_a_file(run: RunLog) -> None:
    events = [Event(time_s=60.0, kind="break", arm=arm, reason="tea") for arm in run.arms[:3]]
    events += [Event(time_s=90.0, kind="break_end", arm=arm, reason="tea") for arm in run.arms[:3]]
    other = Event(time_s=75.0, kind="break", arm=run.arms[3], reason="service")
    lines = list(Moments(replace(run, events=(*events, other), offers=())).log())
    first, second, third, fourth = run.arms
    assert [(line.time_s, line.arm, line.text) for line in lines] == [
        (60.0, f"{first}, {second} and {third}", "break: tea"),
        (75.0, fourth, "break: service"),
        (90.0, f"{first}, {second} and {third}", "break end: tea"),
    ]


@pytest.mark.ci_slow
def test_an_mcap_file_has_the_shift_in_messages_of_ros_2(
    run_folder: Path, run: RunLog, motors_in_mujoco, thermofleet, tmp_path: Path
) -> None:
    from mcap.reader import make_reader

    path = tmp_path / "shift.mcap"
    thermofleet("view", run_folder, "--out", path, "--every", EVERY_S).succeeded()
    messages: dict[str, list[tuple[float, object]]] = defaultdict(list)
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            content = message.data if channel.topic.endswith("joint_states") else read(message.data, schema.name)
            if channel.topic == "/diagnostics":
                content = read_diagnostics(message.data)
            messages[channel.topic].append((message.log_time / 1e9, content))
    readings, moments = run.readings, Moments(run, EVERY_S)
    for index, arm in enumerate(run.arms):
        joints = [read_joints(payload) for _, payload in messages[f"/quickstart/{arm}/joint_states"]]
        assert np.array([each.q for each in joints]) == pytest.approx(readings.q[moments.poses, index])
        assert np.array([each.tau for each in joints]) == pytest.approx(readings.tau[moments.poses, index])
        for joint in range(7):
            heat = messages[f"/quickstart/{arm}/joint_{joint + 1}/temperature"]
            assert [time_s for time_s, _ in heat] == pytest.approx(readings.time_s[moments.heats])
            assert [each.temperature for _, each in heat] == pytest.approx(readings.temp_c[moments.heats, index, joint])
    sample = int(moments.heats[readings.temp_c[moments.heats].max(axis=(1, 2)).argmax()])
    time_s = float(readings.time_s[sample])
    parents, poses = {}, {}
    for topic in ("/tf_static", "/tf"):
        last = [content for at_s, content in messages[topic] if at_s <= time_s][-1]
        for each in last.transforms:
            move, turn = each.transform.translation, each.transform.rotation
            parents[each.child_frame_id] = each.header.frame_id
            poses[each.child_frame_id] = ([move.x, move.y, move.z], [turn.w, turn.x, turn.y, turn.z])
    drums = next(content for at_s, content in messages["/motors"] if at_s == time_s).markers
    found = np.array([along(parents, poses, drum.header.frame_id) for drum in drums])
    assert found == pytest.approx(motors_in_mujoco(time_s).reshape(-1, 3), abs=1e-4)
    shapes = [(drum.type, drum.scale.z / drum.scale.x, drum.scale.y / drum.scale.x) for drum in drums]
    assert shapes == [pytest.approx((3, 0.8, 1.0))] * len(drums)  # cylinders along z
    hottest, coolest = readings.temp_c[sample].argmax(), readings.temp_c[sample].argmin()
    assert drums[hottest].scale.x > drums[coolest].scale.x
    assert drums[hottest].color.r - drums[hottest].color.g > drums[coolest].color.r - drums[coolest].color.g
    statuses = {each.hardware: each for each in dict(messages["/diagnostics"])[time_s]}
    for index, arm in enumerate(run.arms):
        assert dict(statuses[f"quickstart/{arm}"].values)["mode"] == MODES[readings.mode[sample, index]]
    log = [(at_s, line.name, line.msg) for at_s, line in messages["/rosout"]]
    for kind in ("award", "fault"):
        assert [(at_s, arm) for at_s, arm, text in log if text.startswith(kind)] == [
            (pytest.approx(event.time_s), event.arm) for event in run.events if event.kind == kind
        ]
    awards = sum(event.kind == "award" for event in run.events)
    assert sum(text.startswith("offers for ") for *_, text in log) == awards > 0
    assert [each.temperature for _, each in messages["/limits/error"]] == [run.scenario.limits.error_c] * 2


WRONG = {
    "view RUN --out shift.bag": "--out must end in .mp4, .webm, .gif, .mcap, .glb (got 'shift.bag')",
    "view RUN --out there.mcap": "'there.mcap' exists; give another --out",
    "view RUN --every 5": "--every is for --out FILE.mcap and FILE.glb",
    "view RUN --out shift.mp4 --size 641x480": "--size must be WIDTHxHEIGHT, even numbers",
    "view RUN --out shift.mp4 --speed 0.1 --fps 60": "Raise --speed",
    "view RUN --out all.glb --end 60": "--end is for the viewer and films; .glb files hold the whole shift",
    "view RUN": "MuJoCo's viewer needs a display",
    "view quickstart": "MuJoCo's viewer needs a display",
    "view nowhere": "There is neither a folder nor a scenario 'nowhere'. Allowed: active_waiting,",
    "view nowhere --out shift.glb": "There is neither a folder nor a scenario 'nowhere'.",
    "view nowhere.toml": "There is no scenario file 'nowhere.toml'.",
    "view quikstart": "nor a scenario 'quikstart'; did you mean 'quickstart'?",
    "report RUN --out r.csv": "--out must end in .html (got",
    "report RUN --out r": "--out must end in .html (got",
    "report fleet": "is of `thermofleet up`: give",
    "report study": "is of `thermofleet compare`: open its index.html in a browser.",
    "report nowhere": "There is no folder 'nowhere'. Give the folder of a run or of a recording.",
    "report nowhere --trace fault": "There is no folder 'nowhere'.",
    "report RUN nowhere": "There is no folder 'nowhere'.",
    "report RUN fleet": "must be of `thermofleet run`",
    "report RUN RUN": "given twice",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_shown_is_refused_in_a_sentence(run_folder, tmp_path, monkeypatch, thermofleet, words) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "fleet" / "recording").mkdir(parents=True)
    (tmp_path / "study").mkdir()
    for file in ("there.mcap", "fleet/fleet.json", "study/study.json"):
        (tmp_path / file).touch()
    assert thermofleet(*(run_folder if word == "RUN" else word for word in words.split())).refused(WRONG[words])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fleet", "study", "there.mcap"]


def test_runs_side_by_side_are_one_page_and_one_table(run_folder: Path, thermofleet, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    again = shutil.copytree(run_folder, tmp_path / "again")
    for ending in ("html", "csv", "xlsx"):
        thermofleet("report", run_folder, again, "--out", tmp_path / f"two.{ending}").succeeded()
    page = (tmp_path / "two.html").read_text(encoding="utf-8")
    assert "2 runs of quickstart" in page
    assert "The runs differ in nothing. All have the same jobs." in page
    sheet = openpyxl.load_workbook(tmp_path / "two.xlsx").active
    cells = {row[0]: row[1:] for row in sheet.iter_rows(values_only=True)}
    lines = [line.split(",") for line in (tmp_path / "two.csv").read_text(encoding="utf-8").splitlines()]
    assert cells[None] == ("run", "again", "difference")
    metrics = open_run(run_folder).metrics
    assert cells["jobs finished"] == (metrics.finished, metrics.finished, 0)
    assert ["jobs finished", str(metrics.finished), str(metrics.finished), "0"] in lines
