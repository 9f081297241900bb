"""The two CSV formats of logs: their columns, units, and conversion to SI."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.robot import JOINTS
from twin.logs.recording import CONTINUOUS, READINGS
from twin.logs.table import Damage, Table, out_of_range

Array = np.ndarray

TEMP_RANGE_C = (-40.0, 200.0)
"""Range of a motor's temperature sensor; values outside are faults or kelvin."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """Column names and units of a CSV format."""

    name: str
    time: str
    """Column of the time, s."""
    groups: tuple[str, ...]
    """Prefix of the column names of each of `READINGS`."""
    factors: tuple[float, ...]
    """Factor of each group to SI and our signs."""
    turns: bool
    """Whether angles run from 0° to 360°, so that −0.1° reads 359.9°."""
    first_joint: int
    required: int
    """Number of required groups; of the others, all joints or none."""

    def columns(self, group: str, joints: int = JOINTS) -> list[str]:
        """Column names of a group, joint by joint."""
        return [f"{group}_{self.first_joint + j}" for j in range(joints)]


GEN3 = Format(
    name="Gen3 log",
    time="Time (s)",
    groups=("Pos", "Velocity", "Torque", "Current", "Temp"),
    # The drive reports the torque that the joint feels: against gravity_torque of the model its slope is −1 over the
    # 34 logs (docs/logs.md), while the current has the sign of the torque that the motor makes.
    factors=(np.pi / 180, np.pi / 180, -1.0, 1.0, 1.0),
    turns=True,
    first_joint=0,
    required=5,
)
PLAIN = Format(
    name="plain log",
    time="time_s",
    groups=READINGS,
    factors=(1.0,) * len(READINGS),
    turns=False,
    first_joint=1,
    required=3,
)


def format_of(names: Sequence[str]) -> Format:
    """The format with this time column.

    Raises:
        ValueError: there is no time column of a known format.
    """
    for layout in (GEN3, PLAIN):
        if layout.time in names:
            return layout
    hint = " Columns are separated by commas, numbers have a decimal point." if any(";" in n for n in names) else ""
    raise ValueError(
        f"is not a log: its first line begins with '{','.join(names)[:40]}', where a Gen3 log has '{GEN3.time}' "
        f"and a plain one '{PLAIN.time}'.{hint}"
    )


def check_columns(layout: Format, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """The groups of a format that a log has, and its columns that belong to no group.

    Raises:
        ValueError: columns are missing, or the arm has another number of joints.
    """
    of_group = [name.rpartition("_")[0] for name in names if name.rpartition("_")[2].isdigit()]
    counts = {group: of_group.count(group) for group in layout.groups}
    groups = [g for i, g in enumerate(layout.groups) if i < layout.required or counts[g]]
    joints = {counts[g] if set(layout.columns(g, counts[g])) <= set(names) else 0 for g in groups}
    if len(joints) == 1 and joints not in ({JOINTS}, {0}):
        raise ValueError(f"has {joints.pop()} joints; only logs of a Gen3, which has {JOINTS}, can be read.")
    wanted = [layout.time, *(column for g in groups for column in layout.columns(g))]
    missing = [column for column in wanted if column not in names]
    if missing:
        raise ValueError(f"lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)} of a {layout.name}.")
    return groups, [name for name in names if name not in wanted]


def channels(layout: Format, groups: Sequence[str], table: Table) -> dict[str, Array]:
    """The groups of a table in SI with our signs, each [row, joint]; a Gen3's angles within half a turn of zero."""
    readings: dict[str, Array] = {}
    for channel, group, factor in zip(READINGS, layout.groups, layout.factors, strict=True):
        if group in groups:
            readings[channel] = (
                table.values[:, [table.names.index(column) for column in layout.columns(group)]] * factor
            )
    if layout.turns:
        readings["q"] = (readings["q"] + np.pi) % (2 * np.pi) - np.pi
    return readings


def implausible_readings(layout: Format, readings: dict[str, Array], where: Array) -> list[Damage]:
    """Rows with readings that no Gen3 can have, mostly because of another unit.

    Args:
        readings: Channels in SI, [row, joint].
        where: Line of each row, [row].
    """
    damage: list[Damage] = []
    if not layout.turns:
        # Beyond half a turn a joint with end stops has passed them.
        q = np.where(np.isin(np.arange(JOINTS), CONTINUOUS), 0.0, readings["q"])
        reason = "joint {joint} at {value:.5g} is beyond its stops; q is in rad"
        damage += out_of_range(q, where, (-np.pi, np.pi), reason)
    if "temp_c" in readings:
        reason = "joint {joint} at {value:.5g} is not a motor temperature in °C"
        damage += out_of_range(readings["temp_c"], where, TEMP_RANGE_C, reason)
    return damage
