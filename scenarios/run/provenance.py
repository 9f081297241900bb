"""Provenance: twin, training data and calibration of a difficulty, and the version of the code."""

import hashlib
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from fleet.difficulty import DifficultyModel


def provenance(model: DifficultyModel) -> dict[str, Any]:
    """Version of a difficulty model; for a twin also the hash of its training data, and its seed.

    The version is that in `thermofleet twin score`, in the checkpoint's `twin.json` and in the arm's messages.
    """
    fields = {"twin": ("version", "data_hash", "seed"), "saturation": ("version", "data_hash", "jobs", "passed")}
    parts: dict[str, object] = {"twin": getattr(model, "twin", model), "saturation": getattr(model, "saturation", None)}
    found = {name: part for name, part in parts.items() if hasattr(part, "data_hash")}
    return {"version": model.version} | {
        name: {field: getattr(part, field) for field in fields[name]} for name, part in found.items()
    }


PACKAGES = ("fleet", "twin", "agents", "scenarios")


@cache
def code_hash() -> str:
    """Hash of the Python files of the project as they are installed: paths and contents."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        root = Path(str(resources.files(package)))
        for path in sorted(root.rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{package}/{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]
