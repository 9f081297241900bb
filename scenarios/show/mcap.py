"""A recorded shift as MCAP, in messages of ROS 2: for Foxglove, RViz (`ros2 bag play`) and PlotJuggler.

Standard messages need no setting in Foxglove: transforms and markers go to its 3-D panel, temperatures to plots,
`/rosout` to its log, `/diagnostics` to its diagnostics. Joint states and diagnostics have the topics and content of
`thermofleet bus ros2 bridge`. After a jump in time a viewer has the last message of each topic only, so markers of one
topic are always sent together.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any  # rosbags makes its classes at run time

import numpy as np
from mcap.writer import CompressionType, Writer

from fleet.arm.cell import DRUM
from fleet.bus.protocol.messages import State
from fleet.ros2.cdr import (
    DIAGNOSTICS,
    JOINT_STATE,
    definition,
    header,
    message,
    plain_text,
    stamp,
    write,
    write_diagnostics,
    write_joints,
)
from fleet.ros2.conversion import Joints, diagnostics_of, joint_names, plain_name
from fleet.surface import Surface
from fleet.telemetry import MODES
from scenarios.progress import Progress, quiet
from scenarios.show.moments import Moments, ahead, motor_drums

Array = np.ndarray

TRANSFORMS, MARKERS = "tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray"
TEMPERATURE, LOG = "sensor_msgs/msg/Temperature", "rcl_interfaces/msg/Log"
LEVELS = {"info": 20, "warning": 30, "error": 40}
"""Severities of rcl_interfaces/Log."""
CUBE, SPHERE, CYLINDER, TRIANGLES, DELETE = 1, 2, 3, 11, 2
"""Constants of visualization_msgs/Marker."""
WORLD = "world"
NS = 1_000_000_000
LATCHED = "- reliability: 1\n  durability: 1\n  history: 1\n  depth: 1\n"
"""Quality of service of topics that are sent once, for `ros2 bag play`."""
CHUNK_BYTES = 1 << 20
ORIGIN = {"position": (0.0, 0.0, 0.0), "quaternion": (1.0, 0.0, 0.0, 0.0)}


def write_mcap(path: Path, moments: Moments, progress: Progress = quiet) -> None:
    """Write a shift; times count from its beginning."""
    with path.open("wb") as stream:
        file = _McapFile(Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD), moments)
        file.write_once()
        parts = {
            "postures": file.write_poses,
            "temperatures": file.write_heat,
            "payloads": file.write_loads,
            "events": file.write_log,
        }
        for done, (name, write_part) in enumerate(parts.items()):
            progress(f"writing {name}", done / len(parts))
            write_part()
        file.writer.finish()


class _McapFile:
    def __init__(self, writer: Writer, moments: Moments) -> None:
        self.writer, self.moments = writer, moments
        run = moments.run
        self.arms = run.arms
        names = unique_names(self.arms)
        self.frames = [[f"{name}/link_{i}" for i in range(len(moments.model["links"]))] for name in names]
        """Of each link of each arm; the first is its base."""
        self.topics = [f"/{plain_name(run.scenario.name)}/{name}" for name in names]
        """Beginnings of the arms' topics, as `thermofleet bus ros2 bridge` has them."""
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        writer.start(profile="ros2", library="thermofleet")

    def put(self, topic: str, kind: str, time_s: float, content: bytes, qos: str = "") -> None:
        if topic not in self._channels:
            if kind not in self._schemas:
                self._schemas[kind] = self.writer.register_schema(kind, "ros2msg", definition(kind).encode())
            metadata = {"offered_qos_profiles": qos} if qos else {}
            self._channels[topic] = self.writer.register_channel(topic, "cdr", self._schemas[kind], metadata)
        at_ns = round(time_s * NS)
        self.writer.add_message(self._channels[topic], at_ns, content, at_ns)

    def write_once(self) -> None:
        """Mounts, shapes and limits."""
        moments, model = self.moments, self.moments.model
        begin_s = float(moments.run.readings.time_s[0])
        mounts = [
            transform(WORLD, frames[0], arm["position"], arm["quaternion"])
            for arm, frames in zip(model["arms"], self.frames, strict=True)
        ]
        links = self.link_transforms()
        self.put("/tf_static", TRANSFORMS, begin_s, write(message(TRANSFORMS, transforms=mounts), TRANSFORMS), LATCHED)
        self.put("/tf", TRANSFORMS, begin_s, write(message(TRANSFORMS, transforms=links), TRANSFORMS))
        markers = []
        for arm, frames in zip(self.arms, self.frames, strict=True):
            for link, frame in zip(model["links"], frames, strict=True):
                for shape in link["shapes"]:
                    markers += shape_markers(shape, frame, arm, len(markers))
        for group in ("places", "fixtures", "supports"):
            for solid in model[group]:
                kind, size = (TRIANGLES, [1.0] * 3) if "mesh" in solid else (CUBE, solid["size"])
                markers.append(marker(kind, WORLD, group, len(markers), solid, size, solid["colour"]))
                if kind == TRIANGLES:
                    surface = Surface(**model["meshes"][solid["mesh"]])
                    points_m = surface.points_m[surface.corners.ravel()]
                    markers[-1].points = [_point(corner) for corner in points_m.tolist()]
        self.put("/cell", MARKERS, begin_s, write(message(MARKERS, markers=markers), MARKERS), LATCHED)
        for name in ("warning", "error"):
            limit_c = getattr(moments.limits, f"{name}_c")
            for time_s in (begin_s, float(moments.run.readings.time_s[-1])):
                content = message(TEMPERATURE, header=header(time_s), temperature=float(limit_c))
                self.put(f"/limits/{name}", TEMPERATURE, time_s, write(content, TEMPERATURE))

    def link_transforms(self) -> list[Any]:
        """Transforms of the links above the first of each arm, as at the beginning."""
        links = self.moments.model["links"]
        turned = self.moments.link_quaternions(self.moments.run.readings.q[0])
        return [
            transform(frames[link["parent"]], frames[i], link["position"], turned[arm, i])
            for arm, frames in enumerate(self.frames)
            for i, link in enumerate(links)
            if link["parent"] >= 0
        ]

    def write_poses(self) -> None:
        """Joint states, and the transforms of all links of all arms."""
        moments, readings = self.moments, self.moments.run.readings
        names = joint_names(readings.q.shape[2])
        moving = [i for i, link in enumerate(moments.model["links"]) if link["parent"] >= 0]
        stamped = self.link_transforms()
        everything = message(TRANSFORMS, transforms=stamped)
        for sample in moments.poses.tolist():
            time_s = float(readings.time_s[sample])
            quaternions = moments.link_quaternions(readings.q[sample])[:, moving].reshape(-1, 4).tolist()
            now = stamp(time_s)
            for each, (w, x, y, z) in zip(stamped, quaternions, strict=True):
                each.header.stamp = now
                turn = each.transform.rotation
                turn.w, turn.x, turn.y, turn.z = w, x, y, z
            self.put("/tf", TRANSFORMS, time_s, write(everything, TRANSFORMS))
            for arm, topic in enumerate(self.topics):
                values = (tuple(getattr(readings, name)[sample, arm].tolist()) for name in ("q", "qd", "tau"))
                self.put(f"{topic}/joint_states", JOINT_STATE, time_s, write_joints(Joints(time_s, names, *values)))

    def write_heat(self) -> None:
        """Temperatures, the drums of the motors, and diagnostics."""
        moments, readings = self.moments, self.moments.run.readings
        turned = moments.joint_links
        drums = [
            [
                marker(CYLINDER, frames[link], arm, joint, ORIGIN, (0.1,) * 3, (1.0,) * 3)
                for joint, link in enumerate(turned)
            ]
            for arm, frames in zip(self.arms, self.frames, strict=True)
        ]
        everything = message(MARKERS, markers=[drum for arm in drums for drum in arm])
        readout = message(TEMPERATURE)
        heat_s = readings.time_s[moments.heats]
        jobs = [moments.jobs(arm, heat_s) for arm in self.arms]
        fleet = moments.run.scenario.name
        for done, sample in enumerate(moments.heats.tolist()):
            time_s, temp_c = float(heat_s[done]), readings.temp_c[sample].astype(float)
            colours, radii = motor_drums(temp_c, moments.limits)
            now = stamp(time_s)
            statuses: list[Any] = []
            for arm, name in enumerate(self.arms):
                for joint, drum in enumerate(drums[arm]):
                    drum.header.stamp = now
                    drum.scale.x = drum.scale.y = 2 * float(radii[arm, joint])
                    drum.scale.z = DRUM * drum.scale.x
                    drum.color.r, drum.color.g, drum.color.b = colours[arm, joint].tolist()
                    readout.header = header(time_s, self.frames[arm][turned[joint]])
                    readout.temperature = float(temp_c[arm, joint])
                    topic = f"{self.topics[arm]}/joint_{joint + 1}/temperature"
                    self.put(topic, TEMPERATURE, time_s, write(readout, TEMPERATURE))
                state = State(
                    arm=name,
                    tick=sample,
                    time_s=time_s,
                    mode=MODES[readings.mode[sample, arm]],
                    temp_c=tuple(temp_c[arm].tolist()),
                    headroom_k=float(moments.limits.warning_c - temp_c[arm].max()),
                    job=jobs[arm][done],
                )
                statuses += diagnostics_of(fleet, state, None, moments.limits, 0.0, 1.0)
            self.put("/motors", MARKERS, time_s, write(everything, MARKERS))
            self.put("/diagnostics", DIAGNOSTICS, time_s, write_diagnostics(time_s, statuses))

    def write_loads(self) -> None:
        """The balls in the hands, whenever one changes."""
        moments, time_s = self.moments, self.moments.run.readings.time_s
        radii, hand, colour = moments.payload_m, moments.model["hand"], moments.model["load"]["colour"]
        changed = np.flatnonzero(np.any(np.diff(radii, axis=0, prepend=-1.0) != 0.0, axis=1))
        for sample in changed.tolist():
            balls = []
            for arm, (name, radius_m) in enumerate(zip(self.arms, radii[sample].tolist(), strict=True)):
                # The ball touches the flange, whose z axis points out of the hand.
                pose = {"position": ahead(hand, radius_m), "quaternion": hand["quaternion"]}
                ball = marker(SPHERE, self.frames[arm][-1], name, 0, pose, (2 * max(radius_m, 1e-3),) * 3, colour)
                ball.action = 0 if radius_m else DELETE
                ball.header.stamp = stamp(float(time_s[sample]))
                balls.append(ball)
            self.put("/payloads", MARKERS, float(time_s[sample]), write(message(MARKERS, markers=balls), MARKERS))

    def write_log(self) -> None:
        """Events, and the offers behind each award."""
        for entry in self.moments.log():
            line = message(
                LOG,
                stamp=stamp(entry.time_s),
                level=LEVELS[entry.severity],
                name=plain_text(entry.arm or "fleet"),
                msg=plain_text(entry.text),
            )
            self.put("/rosout", LOG, entry.time_s, write(line, LOG))


def unique_names(arms: Sequence[str]) -> list[str]:
    """Names of the arms with the characters of ROS 2; a number tells equal ones apart."""
    names: list[str] = []
    for number, arm in enumerate(arms):
        name = plain_name(arm)
        names.append(f"{name}_{number}" if name in names else name)
    return names


def transform(parent: str, child: str, position: Sequence[float], quaternion: Sequence[float] | Array) -> Any:
    """A geometry_msgs/TransformStamped; the quaternion is w, x, y, z."""
    return message(
        "geometry_msgs/msg/TransformStamped",
        header=header(0.0, parent),
        child_frame_id=child,
        transform=message(
            "geometry_msgs/msg/Transform",
            translation=message("geometry_msgs/msg/Vector3", **_xyz(position)),
            rotation=_turn(quaternion),
        ),
    )


def marker(
    kind: int, frame: str, group: str, number: int, pose: Any, size: Sequence[float], colour: Sequence[float]
) -> Any:
    """A visualization_msgs/Marker that follows its frame, until it is replaced; full lengths in m, RGB or RGBA."""
    red, green, blue, alpha = [*map(float, colour), 1.0][:4]
    return message(
        "visualization_msgs/msg/Marker",
        header=header(0.0, frame),
        ns=plain_text(group),
        id=number,
        type=kind,
        pose=message(
            "geometry_msgs/msg/Pose",
            position=_point(pose["position"]),
            orientation=_turn(pose["quaternion"]),
        ),
        scale=message("geometry_msgs/msg/Vector3", **_xyz(size)),
        color=message("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
        frame_locked=True,
    )


def shape_markers(shape: Any, frame: str, group: str, number: int) -> list[Any]:
    """Markers of a shape of a link; a capsule is a cylinder between two spheres."""
    kind, size, colour = shape["kind"], shape["size"], shape["colour"]
    if kind == "box":
        return [marker(CUBE, frame, group, number, shape, [2 * half for half in size], colour)]
    across = 2 * size[0]
    if kind == "sphere":
        return [marker(SPHERE, frame, group, number, shape, (across,) * 3, colour)]
    parts = [marker(CYLINDER, frame, group, number, shape, (across, across, 2 * size[1]), colour)]
    if kind == "capsule":
        for i, end in enumerate((-size[1], size[1]), 1):
            pose = {"position": ahead(shape, end), "quaternion": shape["quaternion"]}
            parts.append(marker(SPHERE, frame, group, number + i, pose, (across,) * 3, colour))
    return parts


def _point(values: Sequence[float]) -> Any:
    return message("geometry_msgs/msg/Point", **_xyz(values))


def _xyz(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _turn(quaternion: Sequence[float] | Array) -> Any:
    return message("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", map(float, quaternion), strict=True)))
