"""Sentence of docs/compare.md: shifts whose reward depends on the processor."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from scenarios.studies.page_tables.cells import read_json

SAME = 1e-9
"""Share of a reward within which it counts as the same: decisions were, and sums were rounded in another order."""


def processor_tables(file: Path) -> dict[str, Callable[[], str]]:
    """Text by the name in its mark.

    Args:
        file: Of `benchmarks/processors.py`.
    """
    return {"processors": lambda: processor_sentence(read_json(file))}


def processor_sentence(measured: dict[str, Any]) -> str:
    """How many shifts have another reward, and how far apart the others are."""
    policies = " and ".join(f"`{name}`" for name in measured["policies"])
    share = measured["largest_share"]
    apart = "all are equal to the last bit" if not share else f"the others differ by at most {share:.0e} of the reward"
    return (
        f"{measured['instances']} instances of the test split, {policies}: {len(measured['other_reward'])} of "
        f"{measured['shifts']} shifts have a reward that differs by more than {SAME:g} of it; {apart}."
    )
