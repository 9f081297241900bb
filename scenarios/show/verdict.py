"""What happened in a shift, in words."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any  # values of run.json

from fleet.events import Event
from scenarios.run.schedule import Assignment, Outage, Schedule
from scenarios.shift_records import Offer
from scenarios.show.words import by_joint, clock, duration

MOST_FAULTS = 2
"""Faults with a sentence of their own."""
MOST_ARMS = 6
"""Arms that are named in one sentence."""
MARGIN_K = 3.0
"""Another arm would have avoided a fault if its predicted peak was this much below the limit and below the peak of the
arm that faulted."""
WEIGHS_PEAK = "wsept"
"""The built-in policy that weighs the predicted peak against the value of a job."""
PAUSE_S = 60.0
"""Two jobs of an arm count as one stretch of work if less time lies between them."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The first lines of a report."""

    badge: str
    good: bool
    sentences: tuple[str, ...]
    faults: Mapping[str, Event]
    """That some of the sentences are about."""


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
    about = {_fault(fault, plan): fault for fault in faults[:MOST_FAULTS]}
    sentences = [*_jobs(metrics)]
    for sentence, fault in about.items():
        sentences += [sentence, *_cause(fault, plan, offers)]
    if len(faults) > MOST_FAULTS:
        of = sorted({fault.arm for fault in faults})
        arms = ", ".join(of[:MOST_ARMS]) + (f" and {len(of) - MOST_ARMS} more" if len(of) > MOST_ARMS else "")
        sentences.append(f"{len(faults)} faults in all, of {arms}: see the events below.")
    elif not faults:
        sentences.append(_hottest(metrics))
    if run.get("policy") != WEIGHS_PEAK:
        sentences += _foreseen(faults, plan, offers)
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
    good = status == "finished" and not faults and not contacts
    return Verdict(badge=badge, good=good, sentences=tuple(sentences), faults=about)


def _jobs(metrics: Mapping[str, Any]) -> Iterable[str]:
    finished, on_time = metrics.get("finished"), metrics.get("on_time")
    if finished is None:
        return
    of = f" of {metrics['jobs']}" if metrics.get("jobs") is not None else ""
    late = ""
    if on_time is not None and finished:
        late = ", all on time" if on_time == finished else f", {on_time} of them on time"
    yield f"{finished}{of} jobs finished{late}."


def _hottest(metrics: Mapping[str, Any]) -> str:
    peaks_c = {arm: c for arm, c in (metrics.get("peak_c") or {}).items() if c is not None and math.isfinite(c)}
    if not peaks_c:
        return "No motor reached its fault limit."
    arm = max(peaks_c, key=lambda arm: peaks_c[arm])
    return f"No motor reached its fault limit; the hottest, in {arm}, reached {peaks_c[arm]:.0f} °C."


def _fault(fault: Event, plan: Schedule) -> str:
    outage = next((o for o in plan.outages if o.arm == fault.arm and o.start_s == fault.time_s), None)
    at = f" during {fault.job}" if fault.job else ""
    why = by_joint(fault.reason or f"motor {fault.joint} reached its limit").replace("joint ", "the motor of joint ", 1)
    return f"{clock(fault.time_s)}: {fault.arm} stopped{at}, {_outage(outage)}: {why}."


def _outage(outage: Outage | None) -> str:
    if outage is None:
        return "and recovered at once"
    length = duration(outage.end_s - outage.start_s)
    return f"out for {length}" if outage.recovered else f"out for the remaining {length}"


def _award(fault: Event, plan: Schedule) -> Assignment | None:
    """The work in which an arm faulted."""
    same = (a for a in plan.assignments if (a.arm, a.job) == (fault.arm, fault.job))
    return next((a for a in same if a.start_s <= fault.time_s <= a.end_s), None)


def _behind(award: Assignment, offers: Sequence[Offer]) -> list[Offer]:
    """The offers behind an award; in a live fleet they are a little older than its start."""
    earlier = [offer for offer in offers if offer.job == award.job and offer.time_s <= award.start_s]
    last_s = max((offer.time_s for offer in earlier), default=0.0)
    return [offer for offer in earlier if offer.time_s == last_s]


def _own_offer(award: Assignment, offers: Sequence[Offer]) -> Offer | None:
    """The offer that got the job; None if its scores are unknown."""
    own = next((o for o in _behind(award, offers) if o.awarded), None)
    return own if own is not None and own.peak_c is not None and own.p_saturation is not None else None


def _foreseen(faults: Sequence[Event], plan: Schedule, offers: Sequence[Offer]) -> Iterable[str]:
    """How many faults were predicted, and what kind of policy avoids them."""
    awards = [(fault, _award(fault, plan)) for fault in faults]
    own = [(fault, _own_offer(award, offers)) for fault, award in awards if award is not None]
    count = sum(offer is not None and (offer.peak_c or 0.0) >= _limit_c(fault) for fault, offer in own)
    if count:
        which = "The fault was" if len(faults) == 1 else f"{count} of {len(faults)} faults were"
        yield f"{which} predicted: a policy that weighs the predicted peak, such as {WEIGHS_PEAK}, avoids such awards."


def _limit_c(fault: Event) -> float:
    return fault.value if math.isfinite(fault.value) else math.inf


def _cause(fault: Event, plan: Schedule, offers: Sequence[Offer]) -> Iterable[str]:
    """Why an arm faulted, as far as its award tells, and what would have avoided it."""
    award = _award(fault, plan)
    if award is None:
        return
    begin_s = _begin(award, [a for a in plan.assignments if a.arm == fault.arm and a.start_s <= fault.time_s])
    pause = f"at work without a pause since {clock(begin_s)}; " if begin_s < award.start_s else ""
    own = _own_offer(award, offers)
    if own is None:
        if pause:
            yield f"Why: {pause}no prediction was recorded."
        return
    yield (
        f"Why: {pause}at the award, {clock(award.start_s)}, predicted peak {own.peak_c:.0f} °C and P(saturation) "
        f"{own.p_saturation:.2f}."
    )
    yield _avoidable(fault, own, _behind(award, offers), plan)


def _begin(award: Assignment, work: Sequence[Assignment]) -> float:
    """Begin of the work of an arm that led to an award without a pause."""
    begin_s = award.start_s
    for a in sorted(work, key=lambda a: a.start_s, reverse=True):
        if a.start_s < begin_s <= a.end_s + PAUSE_S:
            begin_s = a.start_s
    return begin_s


def _avoidable(fault: Event, own: Offer, offered: Sequence[Offer], plan: Schedule) -> str:
    """What would have avoided a fault, by the predictions at the award of its job."""
    own_c = own.peak_c or math.inf
    limit_c = _limit_c(fault)
    most_c = min(own_c, limit_c) - MARGIN_K
    cooler = [o for o in offered if not o.awarded and o.feasible and o.peak_c is not None and o.peak_c <= most_c]
    free = [o for o in cooler if o.free]
    if cooler:
        best = min(free or cooler, key=lambda o: o.peak_c or 0.0)
        choice = f"Avoidable by giving the job to {best.arm}, predicted peak {best.peak_c:.0f} °C"
        return f"{choice}: it was free." if best.free else f"{choice}, {_occupied(best, plan)}."
    others = "no other arm could do the job" + (" cooler" if any(o.feasible and not o.awarded for o in offered) else "")
    if own_c < limit_c:
        return f"Not predicted: the predicted peak was below the limit, and {others}."
    return f"Avoidable only by letting the job wait until {fault.arm} had cooled: {others}."


def _occupied(offer: Offer, plan: Schedule) -> str:
    """Until when an arm could not have taken a job, or why."""
    if offer.state == "faulted":
        return "which was out after a fault"
    current = next(
        (a for a in plan.assignments if a.arm == offer.arm and a.start_s <= offer.time_s < a.end_s),
        None,
    )
    if current is None:
        return "but its place or space was taken"
    if current.end_s >= plan.horizon_s:
        return "which was busy to the end"
    return f"once it was free, at {clock(current.end_s)}"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
