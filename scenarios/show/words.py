"""Times, events and offers in words."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, TypeVar

from fleet.events import Event
from scenarios.spec.calendar import date_at, moment_text

if TYPE_CHECKING:  # slow to import
    from fleet.bus.protocol.auction import ArmEvent
    from scenarios.run.records import Notice, Offer

Entry = TypeVar("Entry", bound="Event | Notice")
SEVERITY = {
    "warning": "warning", "torque_warning": "warning", "return": "warning", "give_up": "error", "expire": "warning",
    "fault": "error", "contact": "error", "illegal": "warning",
}  # fmt: skip
"""Kinds of events that are more than information."""
MOST_NAMES = 6
"""Names in one sentence."""
LABELS = {"lost": "claim lost", "return": "job returned", "give_up": "job given up", "recover": "recovered"}


def clock(time_s: float, begin: datetime | None = None) -> str:
    """A time of the shift as h:mm:ss; with its begin, which has a zone, the time of day, on later days with the day.

    Where clocks go back, the hour that occurs twice has the name of its zone.
    """
    if begin is not None:
        moment = date_at(begin, time_s)
        day = "" if moment.date() == begin.date() else "%a %d %b "
        return moment_text(moment, f"{day}%H:%M:%S")
    seconds = round(time_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def duration(time_s: float) -> str:
    """3 h, 1 h 30 min, 54 min, 2 min 30 s, 20 s; from an hour on in whole minutes."""
    seconds = round(time_s) if time_s < 3600 else 60 * round(time_s / 60)
    parts = ((seconds // 3600, "h"), (seconds // 60 % 60, "min"), (seconds % 60, "s"))
    return " ".join(f"{n} {unit}" for n, unit in parts if n) or "0 s"


def names_text(names: Sequence[str]) -> str:
    """`arm_0, arm_1 and arm_2`; of many, the first ones and the number of the others."""
    shown = [*names[:MOST_NAMES], *([f"{len(names) - MOST_NAMES} more"] if len(names) > MOST_NAMES else [])]
    return " and ".join([*([", ".join(shown[:-1])] if shown[1:] else []), *shown[-1:]])


def value_text(value: object) -> str:
    """A value of a card: numbers with six digits, keys before their values, only the length of nested lists, and
    none for an empty one."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(
            f"{key} {seed_text(inner) if key == 'seed' else value_text(inner)}" for key, inner in value.items()
        )
    if isinstance(value, list | tuple):
        if not value:
            return "none"
        nested = any(isinstance(inner, Mapping | list | tuple) for inner in value)
        return f"list of {len(value)}" if nested else ", ".join(map(value_text, value))
    return str(value)


def seed_text(seed: object) -> str:
    """A seed; of a twin without the separator before an empty spawn key."""
    return value_text(seed).removesuffix("/")


def kind_text(kind: str) -> str:
    """A kind of event."""
    return LABELS.get(kind, kind.replace("_", " "))


def event_text(event: "Event | ArmEvent") -> str:
    """An event in words, without its time and arm."""
    joint = f", joint {event.joint}" if event.joint else ""
    reason = f": {event.reason}" if event.reason else ""
    return f"{event.kind.replace('_', ' ')}{f' {event.job}' if event.job else ''}{joint}{reason}"


def joined_breaks(events: Iterable[Entry], arms: Sequence[str]) -> Iterator[Entry]:
    """Yield events; those of arms whose breaks begin, or end, in the same second as one, last.

    Args:
        arms: All arms, in the order in which they are named.
    """
    breaks = dict[tuple[str, int, str], list[Entry]]()
    for event in events:
        if event.kind in ("break", "break_end"):
            breaks.setdefault((event.kind, round(event.time_s), event.reason), []).append(event)
        else:
            yield event
    for alike in breaks.values():
        own = {each.arm for each in alike}
        yield replace(alike[0], arm=names_text([arm for arm in arms if arm in own]))


def offer_text(offer: "Offer") -> str:
    """P(saturation), predicted peak, difficulty and duration of an offer, and why the arm could not take the job."""
    if not offer.feasible:
        return "cannot do it"
    parts = [f"P {offer.p_saturation:.2f}"] if offer.p_saturation is not None else []
    parts += [f"{offer.peak_c:.0f} °C"] if offer.peak_c is not None else []
    parts += [f"d {offer.difficulty:.2f}"] if offer.difficulty is not None else []
    parts.append(f"{(offer.duration_s or 0.0) / 60:.0f} min")
    barred = "" if offer.free else f" ({offer.state if offer.state != 'idle' else 'place or space taken'})"
    return ", ".join(parts) + barred


def offers_text(offers: "Iterable[Offer]") -> str:
    """Offers of several arms in one sentence."""
    return "; ".join(f"{offer.arm}: {offer_text(offer)}" for offer in offers)
