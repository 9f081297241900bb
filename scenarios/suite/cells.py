"""The cells of the suite: arms, stations and trade. Many instances share a cell, and no two splits do.

What needs preparation belongs to the cell: its plans, its space, its twins. Instances differ in what arrives, in the
ambient temperature, in faults and in the bus.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

from scenarios.schema import SPLITS, ArmSpec, SplitName
from scenarios.suite.layouts import Layout, LayoutName, layout_of
from scenarios.suite.trades import TradeName

JUDGED = SPLITS[1:]
"""On which policies are judged."""
Unlike = Literal["alike", "usual", "mixed"]
SPREAD: dict[Unlike, float] = {"alike": 0.2, "usual": 0.7, "mixed": 0.7}
"""`spread.scale` of the arms."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell and the number of its instances."""

    name: str
    split: SplitName
    layout: LayoutName
    arms: int
    trade: TradeName
    stations: int = 2
    """In each group between two neighbours."""
    unlike: Unlike = "usual"
    """alike and usual: deviations by chance, small or as among Gen3 arms. mixed: besides, some arms are worn, some cool
    badly, one has a fan, and some carry less."""
    pitch_m: float = 0.8
    front_m: float = 0.4
    hours: float = 2.0
    slots: int = 24
    instances: int = 17
    seed: int = 0
    """Of the arms' deviations: one with which every idle arm stays near or below the warning limit."""

    @property
    def stations_per_arm(self) -> float:
        """Stations of the cell over its arms."""
        return len(layout(self).places) / self.arms


@lru_cache(maxsize=64)
def layout(cell: Cell) -> Layout:
    """Arms and stations of a cell."""
    plain = layout_of(cell.layout, cell.arms, cell.stations, pitch_m=cell.pitch_m, front_m=cell.front_m)
    if cell.unlike != "mixed":
        return plain
    return replace(plain, arms=tuple(_altered(arm, i) for i, arm in enumerate(plain.arms)))


def _altered(arm: ArmSpec, number: int) -> ArmSpec:
    """The arm as a mixed fleet has it: every eighth has a fan, and so on."""
    match number % 8:
        case 1 | 6:
            return replace(arm, wear=0.6)
        case 2 | 5:
            return replace(arm, cooling_factor=0.8)
        case 3:
            return replace(arm, cooling="forced_air")
        case 4:
            return replace(arm, payload_limit_kg=1.5)
        case _:
            return arm


def _cells(split: SplitName, *cells: Cell) -> tuple[Cell, ...]:
    return tuple(replace(cell, split=split) for cell in cells)


def _of(layout: LayoutName, arms: int, trade: TradeName, **more: object) -> Cell:
    return Cell(name=f"{layout}_{arms}_{trade}", split="train", layout=layout, arms=arms, trade=trade, **more)  # pyright: ignore[reportArgumentType]


CELLS: tuple[Cell, ...] = (
    *_cells(
        "train",
        _of("bench", 4, "screwdriving", seed=1100),
        _of("line", 4, "palletising", seed=101, unlike="mixed"),
        _of("ring", 4, "gluing", seed=102, stations=3),
        _of("gantry", 4, "machine_tending", seed=103),
        _of("wall_ceiling", 4, "polishing", seed=2104, unlike="mixed"),
        _of("line", 2, "inspection", seed=3105),
        _of("ring", 6, "kitting", seed=4106, stations=3, unlike="mixed"),
        _of("bench", 6, "gluing", seed=107, stations=3, unlike="alike"),
        _of("line", 8, "machine_tending", seed=108, unlike="mixed"),
        _of("gantry", 3, "assembly", seed=109, stations=3),
        _of("wall_ceiling", 6, "inspection", seed=5110),
        _of("ring", 16, "assembly", seed=35111, hours=1.0, slots=48, instances=13, unlike="mixed"),
    ),
    *_cells(
        "validation",
        _of("bench", 4, "assembly", seed=200, stations=3, pitch_m=0.82, instances=38),
        _of("line", 6, "gluing", seed=20201, pitch_m=0.78, unlike="mixed", instances=38),
        _of("ring", 5, "machine_tending", seed=10202, stations=3, unlike="mixed", instances=38),
        _of("gantry", 4, "palletising", seed=203, pitch_m=0.78, instances=38),
        _of("wall_ceiling", 4, "kitting", seed=204, stations=3, unlike="alike", instances=38),
        _of("line", 16, "polishing", seed=5205, hours=1.0, slots=48, instances=10),
    ),
    *_cells(
        "test",
        _of("bench", 4, "polishing", seed=3300, stations=3, pitch_m=0.78, unlike="mixed", instances=30),
        _of("line", 5, "assembly", seed=301, pitch_m=0.79, stations=3, instances=30),
        _of("ring", 6, "gluing", seed=28302, pitch_m=0.82, unlike="mixed", instances=30),
        _of("gantry", 5, "inspection", seed=9303, pitch_m=0.79, unlike="mixed", instances=30),
        _of("wall_ceiling", 4, "machine_tending", seed=304, front_m=0.42, instances=30),
        _of("bench", 8, "palletising", seed=3305, pitch_m=0.79, stations=3, instances=24),
        _of("line", 16, "kitting", seed=29306, pitch_m=0.79, hours=1.0, slots=48, unlike="mixed", instances=12),
        _of("ring", 32, "gluing", seed=4307, pitch_m=0.82, hours=1.0, slots=64, unlike="mixed", instances=8),
        _of("line", 64, "screwdriving", seed=29308, pitch_m=0.79, hours=1.0, slots=96, instances=6),
    ),
    # No other split has cells of these sizes.
    *_cells(
        "sizes",
        _of("line", 7, "gluing", seed=400, instances=4),
        _of("ring", 7, "palletising", seed=5401, stations=3, instances=4),
        _of("gantry", 9, "machine_tending", seed=60402, unlike="mixed", instances=4),
        _of("wall_ceiling", 9, "screwdriving", seed=1403, instances=4),
        _of("bench", 10, "kitting", seed=76404, hours=1.0, slots=48, unlike="mixed", instances=4),
        _of("line", 11, "polishing", seed=9405, hours=1.0, slots=48, instances=4),
        _of("ring", 12, "inspection", seed=6406, hours=1.0, slots=48, instances=4),
        _of("gantry", 12, "assembly", seed=9407, stations=3, hours=1.0, slots=48, instances=4),
        _of("wall_ceiling", 14, "palletising", seed=3408, hours=1.0, slots=48, instances=4),
        _of("line", 20, "machine_tending", seed=356409, hours=1.0, slots=64, unlike="mixed", instances=4),
        _of("bench", 20, "gluing", seed=11410, stations=3, hours=1.0, slots=64, instances=4),
        _of("ring", 24, "polishing", seed=6411, hours=1.0, slots=64, instances=4),
    ),
)
