"""Cells that several tables of results share, and the files that they are made from."""

import json
import math
from pathlib import Path
from typing import Any  # JSON values


def difference(mean: float, low: float | None, high: float | None, digits: int = 1) -> str:
    """`**−6.0 (−10.4 … −2.5)**`: a difference with its interval, bold if that excludes 0; else the mean."""
    text = signed(mean, digits)
    if low is None or high is None or math.isnan(low + high):
        return text
    text += f" ({signed(low, digits)} … {signed(high, digits)})"
    return bold_if(low > 0 or high < 0, text)


def bold_if(shown: bool, text: str) -> str:
    """The text, bold where a difference is shown."""
    return f"**{text}**" if shown else text


def signed(value: float, digits: int = 1) -> str:
    """A number with its sign."""
    return f"{value:+.{digits}f}".replace("-", "−")


def read_json(path: Path) -> Any:
    """The content of a file of results."""
    return json.loads(path.read_text(encoding="utf-8"))
