"""Where a difficulty comes from: which twin, trained on what, calibrated on which past jobs."""

from typing import Any

from fleet.difficulty import DifficultyModel


def provenance(model: DifficultyModel) -> dict[str, Any]:
    """What a recording says of a difficulty model: its version, and for a twin the names of its data and its seed.

    The version is that in `thermofleet twin score`, in the checkpoint's `twin.json` and in the arm's words on the bus;
    the data hash names the content of the training records.
    """
    told: dict[str, Any] = {"version": model.version}
    twin: Any = getattr(model, "twin", model)
    if hasattr(twin, "data_hash"):
        told["twin"] = {"version": twin.version, "data_hash": twin.data_hash, "seed": twin.seed}
    saturation = getattr(model, "saturation", None)
    if saturation is not None:
        told["saturation"] = {
            "version": saturation.version,
            "data_hash": saturation.data_hash,
            "jobs": saturation.jobs,
            "passed": saturation.passed,
        }
    return told
