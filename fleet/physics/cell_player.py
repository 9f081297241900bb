"""Shows recorded postures of a cell in MuJoCo: as pictures without a display, or in its viewer."""

# MuJoCo is compiled and ships no type stubs.
# pyright: reportAttributeAccessIssue=false

import threading
from collections.abc import Callable, Sequence
from types import TracebackType

import mujoco
import numpy as np

from fleet.errors import FleetError
from fleet.job import Fixture, Place
from fleet.physics.models import build_cell, payload_bodies, set_payload_balls
from fleet.robot import JOINTS, Robot

Array = np.ndarray

NO_OPENGL = (
    "No OpenGL without a display could be had ({error}). Install EGL or OSMesa (on Debian: libegl1 and "
    "libgl1-mesa-dri, or libosmesa6), or choose one with MUJOCO_GL=egl or MUJOCO_GL=osmesa."
)
FRAME_S = 1 / 30
AZIMUTH_DEG, ELEVATION_DEG = 128.0, -36.0
"""Direction of the camera."""
ROOM_M = 0.12
"""From the middle of a link to what must be seen round it."""
LABEL_M = 0.08
"""From the foot of an arm to its name, away from the arm."""
PLACE_RGB = (0.48, 0.36, 0.65)
"""A place must not look like a warm motor."""


class CellPlayer:
    """A model of a cell that takes any posture.

    Args:
        meshes: Kinova's shells instead of primitives, see `fleet.physics.models.build_cell`.

    Raises:
        FleetError: the meshes are not available.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        places: Sequence[Place] = (),
        fixtures: Sequence[Fixture] = (),
        *,
        meshes: bool = False,
    ) -> None:
        self.model = build_cell(robots, places, fixtures, meshes=meshes)
        self.data = mujoco.MjData(self.model)
        self._payloads = payload_bodies(self.model, robots)
        self._mounts_m = np.array([robot.mount.position_m for robot in robots])
        self.labels_m = self._mounts_m - LABEL_M * np.array([robot.mount.rotation()[:, 2] for robot in robots])
        """Places for the names of the arms, m, [arm, 3]."""
        self._fixed_m = np.array([thing.position_m for thing in (*places, *fixtures)]).reshape(-1, 3)
        self.model.geom("floor").size[:2] = 0.0  # drawn without an edge
        for place in places:
            self.model.site(f"station/{place.name}").rgba[:3] = PLACE_RGB
        sites = [f"{robot.name}/motor_{joint + 1}" for robot in robots for joint in range(JOINTS)]
        self._motors = np.array([self.model.site(name).id for name in sites])
        self.model.site_group[self._motors] = 0

    def show(self, q: Array, motor_rgb: Array, motor_m: Array, payload_kg: Array) -> None:
        """Take postures [arm, joint] in rad and payloads [arm] in kg, with a sphere at each motor.

        Args:
            motor_rgb: Colours of the spheres, 0 to 1, [arm, joint, 3].
            motor_m: Their radius, m, [arm, joint].
        """
        self.data.qpos[:] = q.ravel()
        self.model.site_rgba[self._motors, :3] = motor_rgb.reshape(-1, 3)
        self.model.site_size[self._motors, 0] = motor_m.ravel()
        set_payload_balls(self.model, self._payloads, payload_kg)
        mujoco.mj_forward(self.model, self.data)

    def extent(self, q: Array) -> Array:
        """Points to see, m, [point, 3]: links in postures [sample, arm, joint] in rad, mounts, places and fixtures."""
        points = [self._mounts_m, self._fixed_m]
        for posture in q:
            self.data.qpos[:] = posture.ravel()
            mujoco.mj_kinematics(self.model, self.data)
            points.append(self.data.xpos[1:].copy())
        return np.concatenate(points)

    def open_viewer(self, update: Callable[[], object]) -> None:
        """Show the cell in MuJoCo's viewer until its window is closed; `update` runs before every frame."""
        import mujoco.viewer

        pause = threading.Event()
        with mujoco.viewer.launch_passive(self.model, self.data, show_left_ui=False, show_right_ui=False) as viewer:
            low, high = self._mounts_m.min(axis=0), self._mounts_m.max(axis=0)
            viewer.cam.azimuth, viewer.cam.elevation = AZIMUTH_DEG, ELEVATION_DEG
            viewer.cam.lookat[:] = (low + high) / 2 + (0.0, 0.0, ROOM_M)
            viewer.cam.distance = 2.0 + float(np.ptp(self._mounts_m, axis=0).max())
            while viewer.is_running():
                with viewer.lock():
                    update()
                viewer.sync()
                pause.wait(FRAME_S)


class CellCamera:
    """Takes pictures of a cell without a display; a context manager.

    Args:
        points_m: What must be seen, [point, 3], as `CellPlayer.extent` gives it.
        top, bottom: Shares of the picture's height that are kept free at its edges.

    Raises:
        FleetError: OpenGL is not available.
    """

    def __init__(
        self, player: CellPlayer, width: int, height: int, points_m: Array, *, top: float = 0.0, bottom: float = 0.0
    ) -> None:
        model = player.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 0
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each OpenGL backend has errors of its own
            raise FleetError(NO_OPENGL.format(error=error or type(error).__name__)) from error
        self._player, self._size = player, np.array((width, height))
        self._tangent = np.tan(np.radians(model.vis.global_.fovy) / 2)
        azimuth, elevation = np.radians((AZIMUTH_DEG, ELEVATION_DEG))
        ahead = np.array((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
        right = np.array((np.sin(azimuth), -np.cos(azimuth), 0.0))
        self._axes = np.stack((right, np.cross(right, ahead), ahead))
        x, y, depth = self._axes @ points_m.T
        across = self._tangent * width / height
        sides, heights = _slopes(across, 0.0, 0.0), _slopes(self._tangent, bottom, top)
        # The nearest camera whose picture holds every point: each edge of the picture is a plane through the camera.
        distance = max(_least(x, depth, *sides), _least(y, depth, *heights))
        at = [_middle(v, depth + distance, *slopes) for v, slopes in ((x, sides), (y, heights))]
        self._eye = np.array((*at, -distance))
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation, self._camera.distance = AZIMUTH_DEG, ELEVATION_DEG, 1.0
        self._camera.lookat[:] = self._eye @ self._axes + ahead

    def pixels(self, points_m: Array) -> Array:
        """Where points [point, 3] in m are in the picture: px from its left and its upper edge, [point, 2]."""
        x, y, depth = self._axes @ points_m.T - self._eye[:, None]
        return (np.stack((x, -y)) / (depth * self._tangent) * self._size[1] / 2 + self._size[:, None] / 2).T

    def __enter__(self) -> "CellCamera":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()

    def picture(self) -> Array:
        """The cell as it stands, uint8 [height, width, 3]."""
        self._renderer.update_scene(self._player.data, self._camera)
        for slow in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[slow] = 0
        return self._renderer.render()


def _slopes(tangent: float, low: float, high: float) -> tuple[float, float]:
    """Slopes of the lower and the upper edge of a view, whose parts `low` and `high` of the picture stay free."""
    return tangent * (2.0 * low - 1.0), tangent * (1.0 - 2.0 * high)


def _least(across: Array, depth: Array, low: float, high: float) -> float:
    """Least distance at which all points are between two slopes, wherever the camera is across."""
    room = max(0.0, float((across + ROOM_M - depth * high).max() - (across - ROOM_M - depth * low).min()))
    return max(0.3, room / (high - low), ROOM_M * 2 - float(depth.min()))


def _middle(across: Array, ahead: Array, low: float, high: float) -> float:
    """The camera's place across, so that as much room is left on both sides."""
    return float((across + ROOM_M - ahead * high).max() + (across - ROOM_M - ahead * low).min()) / 2
