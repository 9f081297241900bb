"""A window for the frames of an environment; without a display it says so once and shows nothing."""

import logging
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

DPI = 100
NO_WINDOW = (
    "There is no window to show the fleet in (%s). Use render_mode='rgb_array' for the frames, or "
    "`thermofleet animate SCENARIO` for a GIF."
)


class Window:
    """Shows one frame after the other, through matplotlib, which is loaded with the first of them.

    A window that the user closed stays closed. A copy or pickle has a window of its own, not yet open.
    """

    def __init__(self, title: str = "thermofleet") -> None:
        self._title = title
        self._figure: Any = None
        self._shown: Any = None
        self._over = False
        """Closed by the user, or never to be had."""

    def show(self, frame: np.ndarray) -> bool:
        """Put a frame, uint8 [height, width, 3], into the window; whether somebody can see it."""
        if self._figure is not None and not self._is_open():
            self._over = True
        if self._over:
            return False
        if self._figure is None:
            self._figure = self._opened(frame)
        if self._figure is None:
            self._over = True
            return False
        self._shown.set_data(frame)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()
        return True

    def close(self) -> None:
        """Close the window; the next frame opens a new one."""
        if self._figure is not None:
            import matplotlib.pyplot as plt

            plt.close(self._figure)
        self._figure, self._shown, self._over = None, None, False

    def __getstate__(self) -> dict[str, Any]:
        return {"_title": self._title, "_figure": None, "_shown": None, "_over": False}

    def _opened(self, frame: np.ndarray) -> Any:
        """A matplotlib figure in a window, or None where there can be none."""
        import matplotlib
        import matplotlib.pyplot as plt
        from matplotlib.backends.registry import BackendFilter, backend_registry

        try:
            backend = matplotlib.get_backend()  # where none was chosen, the first that has a display, else agg
            if backend.lower() not in map(str.lower, backend_registry.list_builtin(BackendFilter.INTERACTIVE)):
                log.warning(NO_WINDOW, f"matplotlib's backend is {backend}")
                return None
            height, width = frame.shape[:2]
            figure = plt.figure(num=self._title, figsize=(width / DPI, height / DPI), dpi=DPI)
        except ImportError as error:  # a chosen backend whose toolkit or display is missing
            log.warning(NO_WINDOW, str(error))
            return None
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        self._shown = axes.imshow(frame)
        manager = figure.canvas.manager
        assert manager is not None
        manager.show()
        return figure

    def _is_open(self) -> bool:
        import matplotlib.pyplot as plt

        return bool(plt.fignum_exists(self._figure.number))
