"""Provenance of a difficulty: twin, training data and calibration."""

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
