"""Cards of trainings and of trained policies, and whether trainings have one recipe."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fleet.errors import FleetError

OPTION_OF = {"prepared": "--instances", "judges": "--validation-instances", "algorithm": "--algo"}
"""Options of `thermofleet train` whose setting has another name in a card."""
POLICIES = ("pairs.json", "policy.json")
"""Cards of trained policies (`agents.learned.policy.CARD` needs PyTorch)."""
RESULTS = ("seed", "teacher", "iterations", "env_steps", "validation", "validation_reward")
"""Entries of these cards in which trainings of one recipe differ."""


def check_recipe(pattern: str, folders: Sequence[Path]) -> None:
    """Check that trained policies, which can be loaded, are trainings of one recipe.

    Raises:
        FleetError: they differ in more than the seed.
    """
    first, *others = (_recipe(folder) for folder in folders)
    for folder, other in zip(folders[1:], others, strict=True):
        for name in (*first, *other):
            if first.get(name) != other.get(name):
                shown = OPTION_OF.get(name, name)
                raise FleetError(
                    f"'{pattern}' matches trainings that differ in more than their seed: '{folders[0]}' has {shown} = "
                    f"{first.get(name)!r}, '{folder}' {other.get(name)!r}. Give a pattern for each, or their names."
                )


def _recipe(folder: Path) -> dict[str, Any]:
    """The settings in the card of a trained policy (Any: JSON values)."""
    card = next(folder / name for name in POLICIES if (folder / name).is_file())
    settings = {"algorithm": "evolution"} | settings_of(json.loads(card.read_text(encoding="utf-8")))
    return {name: value for name, value in settings.items() if name not in RESULTS}


def settings_of(card: dict[str, Any]) -> dict[str, Any]:
    """The entries of a card, with those of its configuration among them (Any: JSON values)."""
    return card | card.get("config", {}) | {"config": None}
