"""The window for frames, and the warning without a display."""

import logging
import pickle
import subprocess
import sys

import numpy as np
import pytest

from fleet.engine.state import initial
from fleet.env.render.picture import Renderer
from fleet.errors import FleetError

BLACK = np.zeros((240, 320, 3), np.uint8)


def test_without_a_display_it_warns_once_and_continues(monkeypatch, caplog) -> None:
    monkeypatch.setattr("matplotlib.get_backend", lambda: "agg")
    window = Renderer()
    with caplog.at_level(logging.WARNING):
        assert [window.show(BLACK) for _ in range(3)] == [False] * 3
        assert window.show(BLACK + 255) is False
    assert len(caplog.messages) == 1
    assert "render_mode='rgb_array'" in caplog.messages[0]
    assert "thermofleet film" in caplog.messages[0]
    window.close()
    pickle.loads(pickle.dumps(window))


def test_a_window_follows_the_frames_until_it_is_closed(monkeypatch) -> None:
    """Use matplotlib's canvas in place of a window."""
    import matplotlib.pyplot as plt
    from matplotlib.backend_bases import FigureManagerBase

    monkeypatch.setattr("matplotlib.get_backend", lambda: "TkAgg")
    monkeypatch.setattr(FigureManagerBase, "show", lambda self: None)
    plt.switch_backend("agg")
    window = Renderer(title="test")
    assert window.show(BLACK)
    assert window.show(BLACK + 255)
    (figure,) = map(plt.figure, plt.get_fignums())
    assert (figure.axes[0].images[0].get_array() == 255).all()
    assert figure.get_size_inches().tolist() == [3.2, 2.4]
    copied = pickle.loads(pickle.dumps(window))
    plt.close(figure)  # as a user does
    assert not window.show(BLACK)
    assert plt.get_fignums() == []
    window.close()
    assert window.show(BLACK)
    window.close()
    copied.close()
    assert plt.get_fignums() == []


def test_matplotlib_is_loaded_for_frames_alone() -> None:
    code = (
        "import sys; import fleet.env.allocation_v1, fleet.env.render.picture; "
        "print([m for m in ('matplotlib', 'PIL', 'torch', 'mujoco', 'zenoh', 'tkinter') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == "[]"


def test_without_matplotlib_the_error_names_the_extra(monkeypatch, small) -> None:
    world, _ = small.shop([[small.job("a", small.work("bench"))]])
    monkeypatch.setitem(sys.modules, "fleet.env.render.picture", None)
    with pytest.raises(FleetError, match=r"pip install -e '\.\[report\]'"):
        Renderer().frame(world, initial(world))
