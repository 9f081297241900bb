"""How long-running functions report their progress."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the name of the present stage and the fraction of it that is done, 0 to 1."""

COUNTED = "computing "
"""Prefix of a stage name that counts what is left. Without a progress bar, each such name is printed."""


def quiet(stage: str, fraction: float) -> None:
    """Ignore all progress."""
