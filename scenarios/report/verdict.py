"""What happened in a shift, in words."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any  # values of run.json

from fleet.events import Event
from scenarios.report.gantt import clock
from scenarios.report.schedule import Outage, Schedule
from scenarios.shift_records import Offer

MOST_FAULTS = 3
"""Faults with a sentence of their own."""
MOST_ARMS = 6
"""Arms that are named in one sentence."""
CLEARLY = 0.1
"""P(saturation) of another offer counts as lower if it is less by this."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The first lines of a report."""

    badge: str
    good: bool
    sentences: tuple[str, ...]


def verdict(run: Mapping[str, Any], events: Sequence[Event], plan: Schedule, offers: Sequence[Offer] = ()) -> Verdict:
    """The outcome of a shift: its jobs, each fault with its cause, and what to look at.

    Args:
        run: Content of `run.json`; what is missing is left out.
        events: In order of time.
        offers: What each arm knew at each award; without them nothing is said about other choices.
    """
    metrics = run.get("metrics") or {}
    faults = [event for event in events if event.kind == "fault"]
    contacts = sum(event.kind == "contact" for event in events)
    sentences = [*_jobs(metrics)]
    for fault in faults[:MOST_FAULTS]:
        sentences += [_fault(fault, plan), *_other_choice(fault, plan, offers)]
    if len(faults) > MOST_FAULTS:
        of = sorted({fault.arm for fault in faults})
        arms = ", ".join(of[:MOST_ARMS]) + (f" and {len(of) - MOST_ARMS} more" if len(of) > MOST_ARMS else "")
        sentences.append(f"{len(faults)} faults in all, of {arms}: see the events below.")
    elif not faults:
        sentences.append("No motor reached its limit.")
    if contacts:
        sentences.append(f"Arms touched something {_times(contacts)}: see the events below.")
    status = str(run.get("status", "unknown"))
    if status == "interrupted":
        badge = f"Interrupted after {duration(plan.horizon_s)}: everything here covers that part only"
    elif faults:
        badge = f"{len(faults)} fault{'s' * (len(faults) > 1)}"
    elif contacts:
        badge = "Contact"
    else:
        badge = "No fault" if status == "finished" else f"Status: {status}"
    return Verdict(badge=badge, good=status == "finished" and not faults and not contacts, sentences=tuple(sentences))


def duration(time_s: float) -> str:
    """3 h, 54 min, 1 h 30 min, 20 s."""
    hours, minutes = divmod(round(time_s / 60), 60)
    if time_s < 60:
        return f"{time_s:.0f} s"
    return " ".join(f"{n} {unit}" for n, unit in ((hours, "h"), (minutes, "min")) if n)


def _jobs(metrics: Mapping[str, Any]) -> Iterable[str]:
    finished, on_time = metrics.get("finished"), metrics.get("on_time")
    if finished is None:
        return
    of = f" of {metrics['jobs']}" if metrics.get("jobs") is not None else ""
    late = ""
    if on_time is not None and finished:
        late = ", all on time" if on_time == finished else f", {on_time} of them on time"
    yield f"{finished}{of} jobs finished{late}."


def _fault(fault: Event, plan: Schedule) -> str:
    outage = next((o for o in plan.outages if o.arm == fault.arm and o.start_s == fault.time_s), None)
    at = f" with {fault.job}" if fault.job else ""
    why = fault.reason or f"motor {fault.joint} reached its limit"
    return f"{clock(fault.time_s)}: {fault.arm} stopped{at}: {why}; {_lost(outage)}."


def _lost(outage: Outage | None) -> str:
    if outage is None:
        return "it recovered at once"
    length = duration(outage.end_s - outage.start_s)
    return f"it was lost for {length}" if outage.recovered else f"it was lost for the remaining {length}"


def _other_choice(fault: Event, plan: Schedule, offers: Sequence[Offer]) -> Iterable[str]:
    """What was known when the job of a fault was awarded, and whether another arm had less to fear."""
    award = next(
        (
            a
            for a in plan.assignments
            if (a.arm, a.job) == (fault.arm, fault.job) and a.start_s <= fault.time_s <= a.end_s
        ),
        None,
    )
    if award is None:
        return
    known = [o for o in offers if o.job == fault.job and o.time_s == award.start_s]
    own = next((o for o in known if o.awarded), None)
    if own is None or own.peak_c is None or own.p_saturation is None:
        return
    told = f"At its award, {clock(award.start_s)}, the predicted peak was {own.peak_c:.0f} °C, P(saturation) "
    told += f"{own.p_saturation:.2f}"
    better = [
        o for o in known if o.free and o.p_saturation is not None and o.p_saturation <= own.p_saturation - CLEARLY
    ]
    if better:
        best = min(better, key=lambda o: o.p_saturation or 0.0)
        peak = f"{best.peak_c:.0f} °C, " if best.peak_c is not None else ""
        yield f"{told}; {best.arm} was free, with {peak}P {best.p_saturation:.2f}."
    elif any(o.free and not o.awarded for o in known):
        yield f"{told}; no free arm was clearly better."
    else:
        yield f"{told}; no other arm was free for it."


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
