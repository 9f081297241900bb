"""Provenance: twin, training data and calibration of a difficulty, the scenario, and the version of the code."""

import hashlib
import json
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from fleet.difficulty import DifficultyModel
from scenarios.schema import Scenario


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


def scenario_hash(scenario: Scenario) -> str:
    """Hash of what is no default in a scenario, so that a new field with a default does not change it."""
    return hash_of(scenario_content(scenario))


def scenario_content(value: Any) -> Any:
    """What is no default in a dataclass, at every depth (hence Any): a new field with a default changes no hash."""
    if isinstance(value, tuple):
        return [scenario_content(item) for item in value]
    if not is_dataclass(value):
        return value
    content: dict[str, Any] = {}
    for field in fields(value):
        given = getattr(value, field.name)
        default = field.default_factory() if field.default_factory is not MISSING else field.default
        if given != default:
            content[field.name] = scenario_content(given)
    return content


def hash_of(content: Any) -> str:
    """Hash of JSON values (hence Any)."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


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
