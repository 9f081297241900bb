"""Hash of a scenario."""

import hashlib
import json
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from scenarios.schema import Scenario


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
