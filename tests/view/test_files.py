"""Recorded shifts as files of other viewers, opened by the readers of those, and compared with the telemetry."""

from collections import defaultdict
from pathlib import Path

import mujoco
import numpy as np
import pytest

from fleet.ros2.cdr import read, read_diagnostics, read_joints
from fleet.telemetry import MODES
from scenarios.cli.main import main
from scenarios.run.log import RunLog, open_run
from scenarios.show.film import Film
from scenarios.show.moments import Moments

EVERY_S = 20


def written(run_folder: Path, path: Path) -> Path:
    with pytest.raises(SystemExit) as ended:
        main(["view", str(run_folder), "--mcap", str(path), "--every", "20"])
    assert ended.value.code in (0, None)
    return path


@pytest.fixture(scope="module")
def run(run_folder: Path) -> RunLog:
    return open_run(run_folder)


def hottest_moment(run: RunLog) -> tuple[int, float]:
    """A kept sample at which an arm works and is hot, and its time."""
    kept = Moments(run, EVERY_S).heats
    sample = int(kept[run.readings.temp_c[kept].max(axis=(1, 2)).argmax()])
    return sample, float(run.readings.time_s[sample])


def positions_in_mujoco(run: RunLog, time_s: float) -> np.ndarray:
    """Motors in the world as MuJoCo has them, [arm, joint, 3]."""
    film = Film(run)
    film.show(time_s)
    data, model = film.player.data, film.player.model
    return np.array([[data.site_xpos[model.site(f"{arm}/motor_{j + 1}").id] for j in range(7)] for arm in run.arms])


def along(parents: dict[str, str], poses: dict[str, tuple[list[float], list[float]]], frame: str) -> np.ndarray:
    """Origin of a frame in the world; poses are positions and quaternions w, x, y, z."""
    point = np.zeros(3)
    while frame in parents:
        position, quaternion = poses[frame]
        turned = np.empty(3)
        mujoco.mju_rotVecQuat(turned, point, np.array(quaternion))
        point, frame = turned + position, parents[frame]
    return point


def test_an_mcap_file_has_the_shift_in_messages_of_ros_2(run_folder: Path, run: RunLog, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path = written(run_folder, tmp_path / "shift.mcap")
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
    sample, time_s = hottest_moment(run)
    parents, poses = {}, {}
    for topic in ("/tf_static", "/tf"):
        last = [content for at_s, content in messages[topic] if at_s <= time_s][-1]
        for each in last.transforms:
            move, turn = each.transform.translation, each.transform.rotation
            parents[each.child_frame_id] = each.header.frame_id
            poses[each.child_frame_id] = ([move.x, move.y, move.z], [turn.w, turn.x, turn.y, turn.z])
    expected = positions_in_mujoco(run, time_s)
    spheres = next(content for at_s, content in messages["/motors"] if at_s == time_s).markers
    found = np.array([along(parents, poses, sphere.header.frame_id) for sphere in spheres])
    assert found == pytest.approx(expected.reshape(-1, 3), abs=1e-4)
    hottest, coolest = readings.temp_c[sample].argmax(), readings.temp_c[sample].argmin()
    assert spheres[hottest].scale.x > spheres[coolest].scale.x
    assert spheres[hottest].color.r - spheres[hottest].color.g > spheres[coolest].color.r - spheres[coolest].color.g
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


@pytest.mark.parametrize(
    ("options", "needed"),
    [
        (["--mcap", "shift.bag"], "--mcap must end in .mcap (got 'shift.bag')"),
        (["--mcap", "there.mcap"], "'there.mcap' exists; give another --mcap"),
        (["--every", "5"], "--every is for --mcap and --gltf"),
    ],
)
def test_a_file_that_cannot_be_is_refused(
    run_folder: Path, tmp_path: Path, monkeypatch, capsys, options, needed
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mcap").touch()
    with pytest.raises(SystemExit) as ended:
        main(["view", str(run_folder), *options])
    assert ended.value.code == 2
    assert needed in " ".join(capsys.readouterr().err.split())
