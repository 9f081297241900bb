"""A recorded shift as a file of the Rerun viewer (`rerun FILE.rrd`), written by its SDK, with a layout."""

# The extra `rerun` is too large for `dev`, so that its types are unknown to most.
# pyright: reportMissingImports=false

from collections.abc import Sequence
from pathlib import Path
from typing import Any  # archetypes of Rerun

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from fleet.env.render.heat import heat_colour
from fleet.robot import JOINTS
from fleet.telemetry import MODES
from scenarios.progress import Progress, quiet
from scenarios.view.moments import Moments, ahead, motor_spheres

Array = np.ndarray

APPLICATION, TIMELINE = "thermofleet", "shift"
MOST_PLOTS = 6
"""Arms with a plot of their own: those with the hottest motors."""
JOINT_COLOURS = (
    (76, 120, 168),
    (245, 133, 24),
    (84, 162, 75),
    (178, 121, 162),
    (157, 117, 93),
    (114, 183, 178),
    (90, 90, 90),
)
PLACE_COLOUR, FIXTURE_COLOUR, LOAD_COLOUR = (242, 140, 25), (140, 128, 110), (64, 115, 180)
PLACE_M = 0.015
LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


def write_rerun(path: Path, moments: Moments, progress: Progress = quiet) -> None:
    """Write a shift.

    Entities: `cell/ARM/link_0/…/link_7` have the transforms and shapes of the links, `motor` below a link its motor's
    sphere; `temperature/ARM`, `angle/ARM`, `velocity/ARM`, `torque/ARM` one value per joint; `mode/ARM`, `job/ARM`
    change in time; `events/ARM` are the log, `temperature/limits` the warning and the error limit.
    """
    recording = rr.RecordingStream(APPLICATION)
    recording.save(path, default_blueprint=layout(moments))
    file = _File(recording, moments)
    file.write_once()
    arms = moments.run.arms
    for index, arm in enumerate(arms):
        progress("writing arms", index / len(arms))
        file.write_arm(index, arm)
    progress("writing events", 1.0)
    file.write_log()
    try:
        recording.flush()
        recording.disconnect()
    except RuntimeError as error:  # its writer has ended, for want of space as a rule, and says no more
        raise OSError(f"{error} (the disk may be full)") from error


def layout(moments: Moments) -> rrb.Blueprint:
    """The cell beside the temperatures, modes and events."""
    run = moments.run
    peak_c = run.telemetry.temp_c.max(axis=(0, 2))
    hottest = sorted(np.argsort(-peak_c)[:MOST_PLOTS].tolist())
    limits = entity("temperature", "limits")
    plots = [
        rrb.TimeSeriesView(
            name=f"{run.arms[i]}: motor temperatures, °C",
            origin="/temperature",
            contents=[entity("temperature", run.arms[i]), limits],
            plot_legend=rrb.PlotLegend(visible=number == 0),  # the same in every plot
        )
        for number, i in enumerate(hottest)
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(name="cell", origin="/cell"),
            rrb.Vertical(
                rrb.Grid(*plots, grid_columns=2 if len(plots) > 3 else 1),
                rrb.StateTimelineView(name="modes", origin="/mode"),
                rrb.TextLogView(name="events", origin="/events"),
                row_shares=[4, 1, 2],
            ),
            column_shares=[3, 2],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
    )


def entity(*parts: str) -> str:
    """Path of an entity; every sign in a part is kept."""
    return rr.new_entity_path(list(parts))


class _File:
    def __init__(self, recording: rr.RecordingStream, moments: Moments) -> None:
        self.recording, self.moments = recording, moments
        readings = moments.run.telemetry
        self.pose_s, self.heat_s = readings.time_s[moments.poses], readings.time_s[moments.heats]
        self.paths = [self._link_paths(arm) for arm in moments.run.arms]

    def _link_paths(self, arm: str) -> list[list[str]]:
        paths: list[list[str]] = []
        for i, link in enumerate(self.moments.model["links"]):
            above = ["cell", arm] if link["parent"] < 0 else paths[link["parent"]]
            paths.append([*above, f"link_{i}"])
        return paths

    def send(self, path: Sequence[str], time_s: Array, columns: Any) -> None:
        self.recording.send_columns(entity(*path), [rr.TimeColumn(TIMELINE, duration=time_s)], columns)

    def still(self, path: Sequence[str], *archetypes: Any) -> None:
        self.recording.log(entity(*path), *archetypes, static=True)

    def write_once(self) -> None:
        """Shapes, places, fixtures and limits."""
        model, limits = self.moments.model, self.moments.limits
        self.still(["cell"], rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for arm, paths in zip(model["arms"], self.paths, strict=True):
            self.still(["cell", arm["name"]], pose(arm))
            for link, path in zip(model["links"], paths, strict=True):
                for i, shape in enumerate(link["shapes"]):
                    self.still([*path, f"shape_{i}"], solid(shape))
            self.still([*paths[-1], "payload"], pose(model["hand"]))
        for place in model["places"]:
            box = rr.Boxes3D(
                half_sizes=[[PLACE_M] * 3], colors=[PLACE_COLOUR], fill_mode="solid", labels=[place["name"]]
            )
            self.still(["cell", "places", place["name"]], pose(place), box)
        for box in model["fixtures"]:
            shape = rr.Boxes3D(sizes=[box["size"]], colors=[FIXTURE_COLOUR], fill_mode="solid")
            self.still(["cell", "fixtures", box["name"]], pose(box), shape)
        ends_s = self.moments.run.telemetry.time_s[[0, -1]]
        values_c = (limits.warning_c, limits.error_c)
        colours = np.rint(255 * heat_colour(np.array(values_c), *values_c)).astype(np.uint8)
        self.still(["temperature", "limits"], rr.SeriesLines(names=["warning limit", "error limit"], colors=colours))
        self.values(["temperature", "limits"], ends_s, np.tile(values_c, (2, 1)))

    def values(self, path: Sequence[str], time_s: Array, values: Array) -> None:
        """Plot values [moment, series]."""
        columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
        self.send(path, time_s, columns)

    def write_arm(self, index: int, arm: str) -> None:
        """Postures, temperatures, modes and jobs of an arm."""
        moments, readings = self.moments, self.moments.run.telemetry
        links, paths = moments.model["links"], self.paths[index]
        q = readings.q[moments.poses, index]
        turned = moments.link_quaternions(q)[..., [1, 2, 3, 0]].astype(np.float32)  # Rerun: x, y, z, w
        temp_c = readings.temp_c[moments.heats, index].astype(float)
        colours, radii = motor_spheres(temp_c, moments.limits)
        rgb = np.rint(255 * colours).astype(np.uint8)
        joints = iter(range(JOINTS))
        for i, (link, path) in enumerate(zip(links, paths, strict=True)):
            if not link["turns"]:
                self.still(path, pose(link))
                continue
            places = np.tile(link["position"], (len(q), 1))
            self.send(path, self.pose_s, rr.Transform3D.columns(translation=places, quaternion=turned[:, i]))
            joint = next(joints)
            sphere = rr.Points3D.columns(
                positions=np.zeros((len(temp_c), 3)), colors=rgb[:, joint], radii=radii[:, joint]
            )
            self.send([*path, "motor"], self.heat_s, sphere)
        self._write_payload(index, paths[-1])
        names = [f"joint {joint + 1}" for joint in range(JOINTS)]
        lines = rr.SeriesLines(names=names, colors=list(JOINT_COLOURS))
        for name, time_s, values in (
            ("temperature", self.heat_s, temp_c),
            ("angle", self.pose_s, q),
            ("velocity", self.pose_s, readings.qd[moments.poses, index]),
            ("torque", self.pose_s, readings.tau[moments.poses, index]),
        ):
            self.still([name, arm], lines)
            self.values([name, arm], time_s, values)
        self._states("mode", arm, readings.time_s, [MODES[mode] for mode in readings.mode[:, index]])
        self._states("job", arm, readings.time_s, moments.jobs(arm, readings.time_s))

    def _states(self, name: str, arm: str, time_s: Array, states: Sequence[str]) -> None:
        """Send text where it changes."""
        kept = [i for i, state in enumerate(states) if i == 0 or state != states[i - 1]]
        self.send([name, arm], time_s[kept], rr.StateChange.columns(state=[states[i] or "none" for i in kept]))

    def _write_payload(self, index: int, path: Sequence[str]) -> None:
        radius_m = self.moments.payload_m[:, index]
        changed = np.flatnonzero(np.diff(radius_m, prepend=-1.0))
        sizes = radius_m[changed].astype(np.float32)
        centres = np.stack([np.zeros_like(sizes), np.zeros_like(sizes), sizes], axis=1)
        ball = rr.Points3D.columns(positions=centres, radii=sizes, colors=np.tile(LOAD_COLOUR, (len(sizes), 1)))
        self.send([*path, "payload"], self.moments.run.telemetry.time_s[changed], ball)

    def write_log(self) -> None:
        """Events, and the offers behind each award."""
        entries: dict[str, list[Any]] = {}
        for entry in self.moments.log():
            entries.setdefault(entry.arm or "fleet", []).append(entry)
        for arm, own in entries.items():
            columns = rr.TextLog.columns(text=[e.text for e in own], level=[LEVELS[e.severity] for e in own])
            self.send(["events", arm], np.array([e.time_s for e in own]), columns)


def pose(given: Any) -> rr.Transform3D:
    """Transform of a pose of a cell model."""
    return rr.Transform3D(translation=given["position"], quaternion=turn(given["quaternion"]))


def solid(shape: Any) -> Any:
    """A shape of a link, filled."""
    kind, size = shape["kind"], shape["size"]
    colour = {"colors": [[round(255 * part) for part in shape["colour"]]], "fill_mode": "solid"}
    at, turned = [shape["position"]], {"quaternions": [turn(shape["quaternion"])]}
    if kind == "box":
        return rr.Boxes3D(half_sizes=[size], centers=at, **turned, **colour)
    if kind == "sphere":
        return rr.Ellipsoids3D(half_sizes=[[size[0]] * 3], centers=at, **colour)
    if kind == "cylinder":
        return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], centers=at, **turned, **colour)
    begin = ahead(shape, -size[1])  # a capsule of Rerun begins at its place
    return rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=[begin], **turned, **colour)


def turn(quaternion: Sequence[float]) -> rr.Quaternion:
    """A quaternion w, x, y, z in the order of Rerun."""
    return rr.Quaternion(xyzw=[*quaternion[1:], quaternion[0]])
