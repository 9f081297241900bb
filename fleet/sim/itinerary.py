"""What a hand does for each kind of work: from stop to stop, when it carries and when it presses."""

from dataclasses import dataclass

from fleet.job import Place, Work

GRASP_S = 0.5
"""Closing or opening the hand around a hold, whose `dwell_s` is the length of the hold itself."""
HOME = "home"


@dataclass(frozen=True)
class Stop:
    """A named standstill: a place, or where the hand backs off from it."""

    place: Place
    backed_off: bool


@dataclass(frozen=True)
class Leg:
    """Move to a stop (None is home), or stay there for some time."""

    to: Stop | None
    stay_s: float = 0.0
    """Zero: a move."""
    carries: bool = False
    presses: bool = False


@dataclass(frozen=True)
class Itinerary:
    """The legs of the three phases of a plan; each phase begins where the one before ends, the first at home."""

    approach: tuple[Leg, ...]
    cycle: tuple[Leg, ...]
    retreat: tuple[Leg, ...]

    @property
    def phases(self) -> tuple[tuple[Leg, ...], ...]:
        """Approach, cycle, retreat."""
        return (self.approach, self.cycle, self.retreat)

    def tree(self) -> dict[Stop, Stop | None]:
        """Every stop, in the order of the first visit, with the stop from which it is first reached (None is home).

        The arm only ever goes along these edges, to and fro, so that no joint winds up from cycle to cycle.
        """
        parents: dict[Stop, Stop | None] = {}
        here: Stop | None = None
        for leg in (*self.approach, *self.cycle, *self.retreat):
            if leg.to is not None:
                parents.setdefault(leg.to, here)
            here = leg.to
        return parents


def itinerary(work: Work) -> Itinerary:
    """Stops and legs of a work. The payload hangs from the end of the grasp to the end of the release.

    A sort goes straight from place to place. A hold grasps in the approach and lets go in the retreat; a press has
    its payload, if any, for as long as it presses.
    """
    first = Stop(work.places[0], backed_off=False)
    above = Stop(work.places[0], backed_off=True)
    if work.kind == "pick_place":
        return _pick_place(work, first, above)
    if work.kind == "sort":
        return _sort(work, first, above)
    grasp_s = GRASP_S if work.kind == "hold" else 0.0
    pause = Leg(first, stay_s=grasp_s)
    letting_go = Leg(first, stay_s=grasp_s, carries=True)
    still = Leg(first, stay_s=work.dwell_s, carries=True, presses=work.kind == "press")
    return Itinerary(
        approach=(Leg(above), Leg(first), pause) if grasp_s else (Leg(above), Leg(first)),
        cycle=(still,),
        retreat=(letting_go, Leg(above), Leg(None)) if grasp_s else (Leg(above), Leg(None)),
    )


def _pick_place(work: Work, first: Stop, above: Stop) -> Itinerary:
    second = Stop(work.places[1], backed_off=False)
    above_second = Stop(work.places[1], backed_off=True)
    return Itinerary(
        approach=(Leg(above),),
        cycle=(
            Leg(first),
            Leg(first, stay_s=work.dwell_s),
            Leg(above, carries=True),
            Leg(above_second, carries=True),
            Leg(second, carries=True),
            Leg(second, stay_s=work.dwell_s, carries=True),
            Leg(above_second),
            Leg(above),
        ),
        retreat=(Leg(None),),
    )


def _sort(work: Work, first: Stop, above: Stop) -> Itinerary:
    second = Stop(work.places[1], backed_off=False)
    return Itinerary(
        approach=(Leg(above), Leg(first)),
        cycle=(
            Leg(first, stay_s=work.dwell_s),
            Leg(second, carries=True),
            Leg(second, stay_s=work.dwell_s, carries=True),
            Leg(first),
        ),
        retreat=(Leg(above), Leg(None)),
    )
