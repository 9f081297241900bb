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
AZIMUTH_DEG, ELEVATION_DEG, ABOVE_M = 128.0, -36.0, 0.35
"""Direction of the camera, and the height above the mounts at which it looks."""


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

    def camera(self) -> mujoco.MjvCamera:
        """A camera that sees the whole cell."""
        camera = mujoco.MjvCamera()
        low, high = self._mounts_m.min(axis=0), self._mounts_m.max(axis=0)
        camera.lookat[:] = (low + high) / 2 + (0.0, 0.0, ABOVE_M)
        camera.distance = 1.2 + 1.05 * max(1.0, *(high - low))
        camera.azimuth, camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
        return camera

    def open_viewer(self, update: Callable[[], object]) -> None:
        """Show the cell in MuJoCo's viewer until its window is closed; `update` runs before every frame."""
        import mujoco.viewer

        pause = threading.Event()
        with mujoco.viewer.launch_passive(self.model, self.data) as viewer:
            while viewer.is_running():
                with viewer.lock():
                    update()
                viewer.sync()
                pause.wait(FRAME_S)


class CellCamera:
    """Takes pictures of a cell without a display; a context manager.

    Raises:
        FleetError: OpenGL is not available.
    """

    def __init__(self, player: CellPlayer, width: int, height: int) -> None:
        model = player.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 0
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each OpenGL backend has errors of its own
            raise FleetError(NO_OPENGL.format(error=error or type(error).__name__)) from error
        self._player, self._camera = player, player.camera()

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
