"""Tables of docs/env.md: the observation field by field and the reward terms, from the code that makes them."""

from dataclasses import fields
from math import prod

from fleet.bus.contract import descriptions
from fleet.env.observation import FIELDS, Layout
from fleet.env.reward import RewardWeights

_SHAPES = {(): "1", ("joint",): "7", ("slot",): "K", ("peer",): "n − 1", ("peer", "slot"): "(n − 1) × K"}
_EXAMPLE = Layout(arms=4, slots=8)


def field_rows() -> list[tuple[str, ...]]:
    """Every field in its order: name, its places in the vector of four arms and eight slots, shape, unit, range,
    meaning."""
    rows: list[tuple[str, ...]] = []
    for field, start in zip(FIELDS, _EXAMPLE.starts, strict=True):
        last = start + prod(_EXAMPLE.shape(field)) - 1
        rows.append(
            (
                f"`{field.name}`",
                str(start) if last == start else f"{start}–{last}",
                _SHAPES[field.axes],
                field.unit,
                f"{_number(field.low)} … {_number(field.high)}",
                field.text,
            )
        )
    return rows


def reward_rows() -> list[tuple[str, ...]]:
    """Every term: its name in the infos, its weight where the scenario names none, and what it is for."""
    told = descriptions(RewardWeights)
    return [
        (f"`reward_{f.name}`", _number(getattr(RewardWeights, f.name)), told[f.name]) for f in fields(RewardWeights)
    ]


def _number(value: float) -> str:
    return f"{value:.15g}".replace("-", "−")
