"""A recorded shift as a glTF file (.glb): arms that move, and motors as drums in the colour of their temperature.

Viewers of augmented reality and of the web open it: model-viewer, Scene Viewer, three.js, Babylon.js, Blender. The
movement is one animation: a rotation per joint. glTF 2.0 itself cannot animate a colour, and few viewers have the
extension that can (KHR_animation_pointer). So each motor has a drum for every band of `BAND_K` of the colour scale,
and the animation gives all but one the scale 0, which is how the specification hides a node.

Source: Khronos Group, glTF 2.0 specification (ISO/IEC 12113:2022), sections 3.6 (binary data) and 4 (GLB).
"""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any  # plain values of JSON

import numpy as np

from fleet.arm.cell import solid_of
from fleet.env.render.heat import heat_marks
from fleet.robot import JOINTS
from fleet.surface import Surface
from scenarios.progress import Progress, quiet
from scenarios.show.moments import Moments, motor_drums

Array = np.ndarray

BAND_K = 5.0
"""Width of a band of temperatures with one colour and one radius."""
LONGEST_TURN_RAD = 2.0
"""Largest turn of a joint between two keys: a turn of more than π would go the other way round."""
Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Rotation from z up, as here, to y up, as in glTF; x, y, z, w."""
Json = dict[str, Any]

VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
_COMPONENT = {"<f4": 5126, "<u2": 5123, "<u4": 5125}
_TYPE = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
ALIGNMENT = 4


def write_gltf(path: Path, moments: Moments, speed: float, progress: Progress = quiet) -> None:
    """Write a shift.

    Nodes: `ARM`, its links `ARM/link_0` to `ARM/link_7` one below the other, and below each link that a joint turns
    `ARM/motor_J/BAND`; `ARM/payload`, `place/NAME`, `fixture/NAME`, `support/NUMBER`.

    Args:
        speed: Shift seconds per second of the animation.
    """
    file = _GltfFile(moments, speed)
    for index, arm in enumerate(moments.model["arms"]):
        progress("writing arms", index / len(moments.model["arms"]))
        file.add_arm(index, arm)
    file.add_surroundings()
    file.write(path)


class _GltfFile:
    def __init__(self, moments: Moments, speed: float) -> None:
        self.moments, self.buffer, self.speed = moments, Buffer(), speed
        self.nodes: list[Json] = [{"name": "cell", "rotation": Z_UP, "children": []}]
        self.meshes: list[Json] = []
        self.materials: list[Json] = []
        self.channels: list[Json] = []
        self.samplers: list[Json] = []
        time_s = moments.run.readings.time_s
        self._begin_s = float(time_s[0])
        self.pose_s, self.heat_s = self._played(time_s[moments.poses]), self._played(time_s[moments.heats])
        self._shapes = [
            [self._mesh(self._geometry(shape["kind"], shape["size"]), shape["colour"]) for shape in link["shapes"]]
            for link in moments.model["links"]
        ]
        self._ball, self._box = self._geometry("sphere", [1.0]), self._geometry("box", [0.5] * 3)
        self._drum = self._geometry("cylinder", [1.0, moments.model["motor"]["half_length"]])
        self._made: dict[tuple[object, ...], int] = {}
        """Meshes by kind and colour."""
        limits = moments.limits
        marks = heat_marks(limits.warning_c, limits.error_c)
        self._edges_c = np.arange(np.ceil(marks[0] / BAND_K), np.floor(marks[-1] / BAND_K) + 1) * BAND_K

    def _played(self, time_s: Array) -> Array:
        """Times in the animation, s."""
        return (time_s - self._begin_s) / self.speed

    def _geometry(self, kind: str, size: Sequence[float]) -> Json:
        """A primitive without a material."""
        solid = solid_of(kind, size)
        attributes = {
            "POSITION": self.buffer.add(solid.vertices, target=VERTICES, bounds=True),
            "NORMAL": self.buffer.add(solid.vertex_normals, target=VERTICES),
        }
        return {"attributes": attributes, "indices": self.buffer.add(solid.faces.ravel(), target=INDICES)}

    def _mesh(self, geometry: Json, rgba: Sequence[float], *, unlit: bool = False) -> int:
        """Index of a new mesh of one colour (RGB, or RGBA, from 0 to 1, as on a screen)."""
        linear = [((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in rgba[:3]]
        alpha = [*rgba[3:], 1.0][0]
        plain: Json = {"baseColorFactor": [*linear, alpha], "metallicFactor": 0.0, "roughnessFactor": 0.7}
        material: Json = {"pbrMetallicRoughness": plain, "alphaMode": "OPAQUE" if alpha == 1 else "BLEND"}
        self.materials.append(material | ({"extensions": {"KHR_materials_unlit": {}}} if unlit else {}))
        self.meshes.append({"primitives": [geometry | {"material": len(self.materials) - 1}]})
        return len(self.meshes) - 1

    def _once(self, kind: str, geometry: Json, rgba: Sequence[float]) -> int:
        """Index of the mesh of a kind and colour, made at its first use."""
        if (kind, *rgba) not in self._made:
            self._made[kind, *rgba] = self._mesh(geometry, rgba, unlit=kind == "motor")
        return self._made[kind, *rgba]

    def _node(self, parent: int, name: str, given: Mapping[str, Any] | None = None, **more: Any) -> int:
        """Index of a new node; `given` is a pose with a quaternion w, x, y, z."""
        node: Json = {"name": name, **more}
        if given is not None:
            w, x, y, z = given["quaternion"]
            length = float(np.linalg.norm((w, x, y, z)))
            node |= {"translation": list(given["position"]), "rotation": [v / length for v in (x, y, z, w)]}
        self.nodes.append(node)
        self.nodes[parent].setdefault("children", []).append(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def _animate(self, node: int, path: str, time_s: Array, values: Array, interpolation: str) -> None:
        times = self.buffer.add(time_s, bounds=True)
        self.samplers.append({"input": times, "output": self.buffer.add(values), "interpolation": interpolation})
        self.channels.append({"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}})

    def add_arm(self, index: int, arm: Mapping[str, Any]) -> None:
        """Nodes and animations of an arm."""
        moments, readings = self.moments, self.moments.run.readings
        links, name = moments.model["links"], arm["name"]
        root = self._node(0, name, arm)
        q = readings.q[moments.poses, index].astype(float)
        band = np.digitize(readings.temp_c[moments.heats, index], self._edges_c)  # [moment, joint]
        nodes: list[int] = []
        joints = iter(range(JOINTS))
        for i, link in enumerate(links):
            node = self._node(root if link["parent"] < 0 else nodes[link["parent"]], f"{name}/link_{i}", link)
            nodes.append(node)
            for mesh, shape in zip(self._shapes[i], link["shapes"], strict=True):
                self._node(node, f"{name}/link_{i}/{shape['kind']}", shape, mesh=mesh)
            if not link["turns"]:
                continue
            joint = next(joints)
            self._turn(node, i, joint, q[:, joint])
            self._add_motor(node, f"{name}/motor_{joint + 1}", band[:, joint])
        self._add_payload(self._node(nodes[-1], f"{name}/hand", moments.model["hand"]), name, index)

    def _turn(self, node: int, link: int, joint: int, angle_rad: Array) -> None:
        """Animate the rotation of a link by its joint's angles [moment]."""
        time_s, angle_rad = divided(self.pose_s, angle_rad)
        turns = np.diff(angle_rad) != 0
        kept = np.append(True, turns) | np.append(turns, True)  # a resting joint needs its first and last moment only
        q = np.zeros((kept.sum(), JOINTS))
        q[:, joint] = angle_rad[kept]
        rotations = self.moments.link_quaternions(q)[:, link][:, [1, 2, 3, 0]]
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
        self.nodes[node]["rotation"] = rotations[0].tolist()
        if np.ptp(q[:, joint]):
            self._animate(node, "rotation", time_s[kept], rotations, "LINEAR")

    def _add_motor(self, link: int, name: str, band: Array) -> None:
        """One drum per temperature band of a motor; only the current one is visible."""
        for number in np.unique(band).tolist():
            temp_c = float(self._edges_c[0]) + (number - 0.5) * BAND_K
            rgb, radius_m = motor_drums(np.array(temp_c), self.moments.limits)
            mesh = self._once("motor", self._drum, rgb.tolist())
            node = self._node(link, f"{name}/{temp_c:g}", mesh=mesh)
            self._switch(node, self.heat_s, np.where(band == number, float(radius_m), 0.0))

    def _add_payload(self, hand: int, name: str, index: int) -> None:
        radius_m, rgb = self.moments.payload_m[:, index][self.moments.poses], self.moments.model["load"]["colour"]
        if not radius_m.any():
            return
        node = self._node(hand, f"{name}/payload", mesh=self._once("payload", self._ball, rgb))
        changed = self._switch(node, self.pose_s, radius_m)
        centres = np.zeros((len(changed), 3))
        centres[:, 2] = radius_m[changed]
        self.nodes[node]["translation"] = centres[0].tolist()
        if len(changed) > 1:
            self._animate(node, "translation", self.pose_s[changed], centres, "STEP")

    def _switch(self, node: int, time_s: Array, radius_m: Array) -> Array:
        """Give a node radii [moment] in steps; returns the moments at which they change."""
        changed = np.flatnonzero(np.diff(radius_m, prepend=np.nan))
        scales = np.repeat(radius_m[changed, None], 3, axis=1)
        self.nodes[node]["scale"] = scales[0].tolist()
        if len(changed) > 1:
            self._animate(node, "scale", time_s[changed], scales, "STEP")
        return changed

    def add_surroundings(self) -> None:
        """Places, fixtures, and what carries the arms."""
        model = self.moments.model
        for group in ("places", "fixtures", "supports"):
            for solid in model[group]:
                name, scale = f"{group[:-1]}/{solid['name']}", solid["size"]
                if "mesh" in solid:
                    surface, scale = Surface(**model["meshes"][solid["mesh"]]), [1.0] * 3
                    geometry = {  # without normals, viewers draw flat triangles
                        "attributes": {"POSITION": self.buffer.add(surface.points_m, target=VERTICES, bounds=True)},
                        "indices": self.buffer.add(surface.corners.ravel(), target=INDICES),
                    }
                    mesh = self._mesh(geometry, solid["colour"])
                else:
                    mesh = self._once("box", self._box, solid["colour"])
                self._node(0, name, solid, mesh=mesh, scale=scale)

    def write(self, path: Path) -> None:
        run, limits = self.moments.run, self.moments.limits
        about = {
            "scenario": run.scenario.name,
            "policy": run.card["policy"],
            "seed": run.card["seed"],
            "shift_seconds_per_second": self.speed,
            "begin_s": self._begin_s,
            "band_k": BAND_K,
            "warning_c": limits.warning_c,
            "error_c": limits.error_c,
        }
        content: Json = {
            "asset": {"version": "2.0", "generator": "thermofleet", "extras": about},
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"name": run.scenario.name, "nodes": [0]}],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": self.materials,
        }
        if self.channels:
            content["animations"] = [{"name": "shift", "channels": self.channels, "samplers": self.samplers}]
        self.buffer.write(path, content)


def divided(time_s: Array, angle_rad: Array) -> tuple[Array, Array]:
    """Times and angles, [moment], with further moments within turns of more than `LONGEST_TURN_RAD`."""
    parts = np.ceil(np.abs(np.diff(angle_rad)) / LONGEST_TURN_RAD).astype(int)
    if parts.max(initial=0) <= 1:
        return time_s, angle_rad
    ends_s = zip(time_s, time_s[1:], np.maximum(parts, 1).tolist(), strict=False)
    within = [np.linspace(a, b, n, endpoint=False) for a, b, n in ends_s]
    finer_s = np.concatenate([*within, time_s[-1:]])
    return finer_s, np.interp(finer_s, time_s, angle_rad)


class Buffer:
    """The buffer of a file, filled array by array."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: Array, *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array and return the index of its accessor.

        Args:
            values: [element] or [element, component], of 1, 3 or 4 components; float32, uint16 or, for large indices,
                uint32 in the file.
            target: `VERTICES` or `INDICES`; None for animations.
            bounds: State least and largest values, which positions and times of animations need.
        """
        kind = ("<u2" if values.max() < np.iinfo("<u2").max else "<u4") if values.dtype.kind in "iu" else "<f4"
        packed = np.ascontiguousarray(values, dtype=kind)
        raw = packed.tobytes()
        padded = raw + b"\0" * (-len(raw) % ALIGNMENT)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.size, "byteLength": len(raw)}
        self.views.append(view if target is None else view | {"target": target})
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _COMPONENT[kind],
            "count": len(packed),
            "type": _TYPE[packed.shape[1] if packed.ndim > 1 else 1],
        }
        if bounds:
            columns = packed.reshape(len(packed), -1)
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        self._parts.append(padded)
        self.size += len(padded)
        return len(self.accessors) - 1

    def write(self, path: Path, content: dict[str, Any]) -> None:
        """Write the file.

        Args:
            content: Its JSON part, without buffers, views and accessors.
        """
        whole = content | {
            "buffers": [{"byteLength": self.size}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % ALIGNMENT)
        length = 12 + 8 + len(text) + 8 + self.size
        with path.open("wb") as file:
            file.write(struct.pack("<III", _MAGIC, _VERSION, length))
            file.write(struct.pack("<II", len(text), _JSON) + text)
            file.write(struct.pack("<II", self.size, _BIN))
            file.writelines(self._parts)
