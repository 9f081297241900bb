"""Breaks: times in which arms take no jobs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from fleet.errors import check_between, check_names
from fleet.job import BOUNDS


@dataclass(frozen=True, kw_only=True)
class Break:
    """A time in which arms take no jobs, such as a break of their operators or maintenance.

    In a scenario file, `begin` and `end` may take the place of the times in seconds: as in a job table, `h:mm` from the
    begin of the shift, with `shift_begin` a time of day; then the break recurs on the `weekdays`, by default every day.
    """

    name: str
    begin_s: float
    """Seconds from the begin of the shift; an arm takes no jobs from the next decision on."""
    end_s: float
    arms: tuple[str, ...] = ()
    """Their names; (): all arms."""
    finish: Literal["cycle", "job"] = "cycle"
    """What an arm at work still finishes: the present cycle, and gives the job back, or the job."""

    def __post_init__(self) -> None:
        most_s = BOUNDS["due_s"].high
        check_between(self, -most_s, most_s, "begin_s", "end_s")
        if self.begin_s >= self.end_s:
            raise ValueError(f"Break.end_s must be after begin_s (got {self.begin_s:.15g}, {self.end_s:.15g})")
        check_names(self, "name", "arms")


def breaks_of(breaks: Sequence[Break], arm: str) -> tuple[Break, ...]:
    """The breaks of one arm."""
    return tuple(each for each in breaks if not each.arms or arm in each.arms)


def break_at(breaks: Sequence[Break], time_s: float) -> Break | None:
    """The break at a time: of several, one that lets no job be finished, then the longest."""
    now = [each for each in breaks if each.begin_s <= time_s < each.end_s]
    return min(now, key=lambda each: (each.finish == "job", -each.end_s), default=None)


def break_in_s(breaks: Sequence[Break], time_s: float) -> float | None:
    """Time until the next break begins, s; 0 during one, None without any."""
    return min((max(0.0, each.begin_s - time_s) for each in breaks if each.end_s > time_s), default=None)
