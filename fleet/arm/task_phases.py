"""Phases of a task: where the arm moves, how it stops there, and with what payload."""

from collections.abc import Iterator
from dataclasses import dataclass

from fleet.job import Place, Work

GRASP_S = 0.5
"""Time to close or open the hand around a hold, whose `dwell_s` is the length of the hold itself."""


@dataclass(frozen=True)
class TaskStop:
    """A posture in which the arm stops: at a place, or retracted from it."""

    place: Place
    retracted: bool


@dataclass(frozen=True)
class Segment:
    """A move to a stop (None is home), or a pause there."""

    to: TaskStop | None
    pause_s: float = 0.0
    """0 for a move."""
    carries: bool = False
    presses: bool = False


@dataclass(frozen=True)
class TaskPhases:
    """Segments of a plan's three phases; each phase begins where the previous one ends, the first at home."""

    approach: tuple[Segment, ...]
    cycle: tuple[Segment, ...]
    retreat: tuple[Segment, ...]

    def __iter__(self) -> Iterator[tuple[Segment, ...]]:
        """Approach, cycle, retreat."""
        return iter((self.approach, self.cycle, self.retreat))

    def previous_stops(self) -> dict[TaskStop, TaskStop | None]:
        """For every stop, in the order of the first visit: the stop from which it is first reached (None is home).

        The arm only ever moves along these edges, in both directions, so that no joint winds up from cycle to cycle.
        """
        previous: dict[TaskStop, TaskStop | None] = {}
        here: TaskStop | None = None
        for segment in (*self.approach, *self.cycle, *self.retreat):
            if segment.to is not None:
                previous.setdefault(segment.to, here)
            here = segment.to
        return previous

    def paths(self) -> dict[tuple[TaskStop | None, TaskStop | None], bool]:
        """Stops (None is home) between which the arm moves, in the order of the first time, and whether it ever
        carries between them; a stop with itself where the arm carries in a pause."""
        paths: dict[tuple[TaskStop | None, TaskStop | None], bool] = {}
        here: TaskStop | None = None
        for segment in (*self.approach, *self.cycle, *self.retreat):
            path = (segment.to, here) if (segment.to, here) in paths else (here, segment.to)
            if segment.carries or segment.to != here:
                paths[path] = paths.get(path, False) or segment.carries
            here = segment.to
        return paths


def task_phases(work: Work) -> TaskPhases:
    """Moves and pauses of a work. The hand carries the payload from the end of the grasp to the end of the release.

    A sort moves straight from place to place. A hold grasps in the approach and releases in the retreat. A press has
    its payload, if any, for as long as it presses.
    """
    first, above = (TaskStop(work.places[0], retracted) for retracted in (False, True))
    second, above_second = (TaskStop(work.places[-1], retracted) for retracted in (False, True))
    match work.kind:
        case "pick_place":
            return TaskPhases(
                approach=(Segment(above),),
                cycle=(
                    Segment(first),
                    Segment(first, pause_s=work.dwell_s),
                    Segment(above, carries=True),
                    Segment(above_second, carries=True),
                    Segment(second, carries=True),
                    Segment(second, pause_s=work.dwell_s, carries=True),
                    Segment(above_second),
                    Segment(above),
                ),
                retreat=(Segment(None),),
            )
        case "sort":
            return TaskPhases(
                approach=(Segment(above), Segment(first)),
                cycle=(
                    Segment(first, pause_s=work.dwell_s),
                    Segment(second, carries=True),
                    Segment(second, pause_s=work.dwell_s, carries=True),
                    Segment(first),
                ),
                retreat=(Segment(above), Segment(None)),
            )
        case "hold":
            grasp = Segment(first, pause_s=GRASP_S)
            release = Segment(first, pause_s=GRASP_S, carries=True)
            return TaskPhases(
                approach=(Segment(above), Segment(first), grasp),
                cycle=(Segment(first, pause_s=work.dwell_s, carries=True),),
                retreat=(release, Segment(above), Segment(None)),
            )
        case "press":
            return TaskPhases(
                approach=(Segment(above), Segment(first)),
                cycle=(Segment(first, pause_s=work.dwell_s, carries=True, presses=True),),
                retreat=(Segment(above), Segment(None)),
            )
