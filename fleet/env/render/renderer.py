"""Frames of an environment, as arrays or in a window. matplotlib is loaded with the first frame."""

import logging
from typing import TYPE_CHECKING

import numpy as np

from fleet.engine.state import State
from fleet.engine.world import World
from fleet.env.render.scene import CellMap, scene_of
from fleet.errors import FleetError, install

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

DPI = 100
NO_WINDOW = (
    "There is no display to show the fleet on (%s). Use render_mode='rgb_array' for the frames, or "
    "`thermofleet run SCENARIO` and `thermofleet view RUN --out FILE.mp4` for a film."
)


class Renderer:
    """Renders states of one environment. A copy or pickle has no window yet.

    Args:
        cell: Positions of arms and stations; a grid if not given.
    """

    def __init__(self, cell: CellMap | None = None) -> None:
        self._cell = cell
        self._figure: Figure | None = None
        self._closed = False
        """Whether the user closed the window, or there is no display."""

    def frame(self, world: World, state: State) -> np.ndarray:
        """Env 0 as uint8 [height, width, 3].

        Raises:
            FleetError: matplotlib is not installed.
        """
        try:
            from fleet.env.render.picture import draw
        except ImportError as error:
            raise FleetError(f"Rendering needs matplotlib: {install('report')}.") from error
        return draw(scene_of(world, state, self._cell))

    def show(self, frame: np.ndarray) -> bool:
        """Show a frame, uint8 [height, width, 3], in the window; return whether there is a window.

        The first frame opens the window. A window that the user closed stays closed. Without a display a warning is
        logged once.
        """
        import matplotlib.pyplot as plt

        if self._figure is not None and not plt.fignum_exists(self._figure.number):  # pyright: ignore
            self._closed = True
        if not self._closed and self._figure is None:
            self._figure = self._open(frame)
            self._closed = self._figure is None
        if self._closed or self._figure is None:
            return False
        self._figure.axes[0].images[0].set_data(frame)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()
        return True

    def close(self) -> None:
        """Close the window; the next frame opens a new one."""
        if self._figure is not None:
            import matplotlib.pyplot as plt

            plt.close(self._figure)
        self._figure, self._closed = None, False

    def __reduce__(self) -> tuple[type["Renderer"], tuple[CellMap | None]]:
        return Renderer, (self._cell,)

    def _open(self, frame: np.ndarray) -> "Figure | None":
        """A matplotlib window, or None without a display."""
        import matplotlib
        import matplotlib.pyplot as plt
        from matplotlib.backends.registry import BackendFilter, backend_registry

        try:
            backend = matplotlib.get_backend()  # if none was chosen, the first one with a display, else agg
            if backend.lower() not in map(str.lower, backend_registry.list_builtin(BackendFilter.INTERACTIVE)):
                log.warning(NO_WINDOW, f"matplotlib's backend is {backend}")
                return None
            height, width = frame.shape[:2]
            figure = plt.figure(num="thermofleet", figsize=(width / DPI, height / DPI), dpi=DPI)
        except ImportError as error:  # a chosen backend whose toolkit or display is missing
            log.warning(NO_WINDOW, str(error))
            return None
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.imshow(frame)
        if figure.canvas.manager is not None:
            figure.canvas.manager.show()
        return figure
