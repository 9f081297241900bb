"""Optional libraries: which extra of thermofleet installs each."""

from importlib.util import find_spec

from fleet.errors import FleetError, install

EXTRAS = {
    "cli": ("rich", "typer"),
    "twin": ("joblib", "sklearn", "torch"),
    "bus": ("apsw", "zenoh"),
    "tls": ("cryptography",),
    "report": ("jinja2", "matplotlib", "pandas", "PIL", "plotly", "pyarrow", "trimesh"),
    "film": ("av",),
    "gateway": ("starlette", "uvicorn"),
    "learn": ("tensordict", "torchrl"),
    "mcap": ("mcap",),
    "meshes": ("mujoco_menagerie",),
    "onnx": ("onnx", "onnxruntime"),
    "ray": ("ray",),
    "ros2": ("rosbags",),
    "xlsx": ("openpyxl",),
}
"""Top-level modules of the libraries of each extra."""


class MissingExtra(FleetError):
    """An optional library is not installed; names the extra that installs it."""


def require_extra(extra: str) -> None:
    """Check that the libraries of an extra are installed, before any slow work.

    Raises:
        MissingExtra: one is not; names the extra.
    """
    for library in EXTRAS[extra]:
        if find_spec(library) is None:
            raise MissingExtra(_sentence(library, extra))


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """A sentence that names the extra of a library that could not be imported; None if no extra has it."""
    library = (error.name or "").partition(".")[0]
    for extra, libraries in EXTRAS.items():
        if library in libraries:
            return _sentence(library, extra)
    return None


def _sentence(library: str, extra: str) -> str:
    return f"This needs the library '{library}', which is not installed: {install(extra)}."
