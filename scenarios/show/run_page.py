"""The report of a shift in words, tables and figures; two shifts, or several, side by side; a run in a notebook."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple  # Any: values of a card
from urllib.parse import quote

from fleet.env.render.heat import heat_scale
from fleet.events import Event
from scenarios.run.records import JobSpan, Notice, Offer, ShiftLog
from scenarios.show.charts import AXIS, COLOURS, LAYOUT, Figure, named_rows, plain
from scenarios.show.late_jobs import (
    PAUSED,
    halt_text,
    late_jobs,
    late_table,
    lateness_text,
    standstill,
    standstill_text,
)
from scenarios.show.page import Badge, Chart, Head, Page, Playback, Section, packed
from scenarios.show.timeline import STREAM_NAME, hottest_motors, shift_charts, time_unit
from scenarios.show.words import (
    clock,
    duration,
    joined_breaks,
    kind_text,
    names_text,
    offer_text,
    offers_text,
    value_text,
)
from scenarios.table import Column, Moment, Table, render

MOST_FAULTS = 2
"""Faults described in a sentence each."""
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
    moments: Mapping[str, Moment]
    """Of some of the sentences."""


def verdict(log: ShiftLog) -> Verdict:
    """The outcome of a shift: its jobs, each fault and the latest job with the cause, and what to look at.

    Missing figures of its card are left out; without offers there is no sentence about other choices.
    """
    metrics, plan, faults = log.card.get("metrics") or {}, log.plan, log.faults
    contacts = sum(event.kind == "contact" for event in log.events)
    about = {_fault(fault, log): fault for fault in faults[:MOST_FAULTS]}
    moments = {sentence: _before(fault) for sentence, fault in about.items()}
    sentences = [*log.remarks, *_jobs(metrics), *_early_end(log.card), *_outside_shift(log.card.get("scenario") or {})]
    for sentence, fault in about.items():
        sentences += [sentence, *_cause(fault, log)]
    if len(faults) > MOST_FAULTS:
        arms = sorted({fault.arm for fault in faults})
        sentences.append(f"{len(faults)} faults in all, of {names_text(arms)}: see the events below.")
    elif not faults:
        sentences.append(_hottest(metrics))
    if failures := [outage for outage in plan.outages if outage.kind == "failure"]:
        arms, out_s = sorted({each.arm for each in failures}), sum(each.end_s - each.start_s for each in failures)
        count = f"{len(failures)} failure{'s' * (len(failures) > 1)} not by heat"
        sentences.append(f"{count}: {names_text(arms)} out for {duration(out_s)} in all.")
    if log.policy != WEIGHS_PEAK:
        sentences += _foreseen(log)
    if contacts:
        sentences.append(
            f"Arms touched something {f'{contacts} times' if contacts > 1 else 'once'}: see the events below."
        )
    sentences += [f"{halt_text(log, halt)}: no job was awarded." for halt in log.halts if not halt.arm]
    if stood := standstill(log):
        sentences.append(standstill_text(log, stood))
    if late := late_jobs(log):
        sentences.append(lateness_text(log, late))
        moments[sentences[-1]] = Moment(late[0].due_s)
    status = str(log.card.get("status", "unknown"))
    if status == "interrupted":
        badge = f"Interrupted after {duration(plan.horizon_s)}: everything here covers that part only"
    elif status == "running":
        badge = f"So far, {duration(plan.horizon_s)}: the recording was not ended, and may still grow"
    else:
        counts = ((len(faults), "fault"), (contacts, "contact"), (len(late), "late job"))
        badge = ", ".join(f"{count} {what}{'s' * (count > 1)}" for count, what in counts if count)
        calm = "No fault, no job" if metrics.get("jobs") == 0 else "No fault, no late job"
        waited = [stood.badge] if stood else []
        badge = ", ".join([*filter(None, [badge]), *waited])
        badge = badge or (calm if status == "finished" else f"Status: {status}")
    badge = f"{badge}; {log.unknown}" if log.unknown else badge
    good = status == "finished" and not (faults or contacts or late or stood or log.unknown)
    return Verdict(badge=badge, good=good, sentences=tuple(sentences), moments=moments)


def _jobs(metrics: Mapping[str, Any]) -> Iterable[str]:
    finished, on_time = metrics.get("finished"), metrics.get("on_time")
    if finished is None:
        return
    of = f" of {metrics['jobs']}" if metrics.get("jobs") is not None else ""
    late = ""
    if on_time is not None and finished:
        late = ", all on time" if on_time == finished else f", {on_time} of them on time"
    yield f"{finished}{of} jobs finished{late}."


def _early_end(card: Mapping[str, Any]) -> Iterable[str]:
    """That a shift ended with its last job; of recordings, nothing."""
    time_s, horizon_s = card.get("time_s", math.inf), (card.get("scenario") or {}).get("horizon_s", -math.inf)
    if card.get("status") == "finished" and time_s < horizon_s:
        whole = duration(horizon_s)
        yield f"The shift of {whole} ended after {duration(time_s)}, with its last job: all figures are of that time."


def _outside_shift(scenario: Mapping[str, Any]) -> Iterable[str]:
    """How many jobs of tables and traces never arrive."""
    horizon_s, arrivals = scenario.get("horizon_s", math.inf), [each["arrivals"] for each in scenario.get("jobs", ())]
    times_s = [each["start_s"] + time_s for each in arrivals for time_s in each["times_s"] or ()]
    if count := sum(time_s >= horizon_s for time_s in times_s):
        yield f"{count} of {len(times_s)} jobs of tables and traces never arrived: their times are outside the shift."


def _hottest(metrics: Mapping[str, Any]) -> str:
    peaks_c = _peaks(metrics)
    if not peaks_c:
        return "No motor reached its error limit."
    arm = max(peaks_c, key=lambda arm: peaks_c[arm])
    return f"No motor reached its error limit; the hottest, in {arm}, reached {peaks_c[arm]:.0f} °C."


def _fault(fault: Event, log: ShiftLog) -> str:
    outage = next((o for o in log.plan.outages if o.arm == fault.arm and o.start_s == fault.time_s), None)
    at = f" during {fault.job}" if fault.job else ""
    why = (fault.reason or f"joint {fault.joint} reached its limit").replace("joint ", "the motor of joint ", 1)
    loss = "and recovered at once"
    if outage is not None:
        rest = "" if outage.recovered else "the remaining "
        loss = f"out for {rest}{duration(outage.end_s - outage.start_s)}"
    return f"{clock(fault.time_s, log.begin)}: {fault.arm} stopped{at}, {loss}: {why}."


def _own_offer(award: JobSpan, log: ShiftLog) -> Offer | None:
    """The offer that got the job; None if its scores are unknown."""
    own = next((offer for offer in log.offers_behind(award.job, award.arm, award.start_s) if offer.awarded), None)
    return own if own is not None and own.peak_c is not None and own.p_saturation is not None else None


def _foreseen(log: ShiftLog) -> Iterable[str]:
    """How many faults were predicted, and what kind of policy avoids them."""
    count, faults = 0, log.faults
    for fault in faults:
        award = log.plan.at(fault.arm, fault.time_s, fault.job)
        own = _own_offer(award, log) if award else None
        count += own is not None and (own.peak_c or 0.0) >= _limit_c(fault)
    if count:
        which = "The fault was" if len(faults) == 1 else f"{count} of {len(faults)} faults were"
        yield f"{which} predicted: a policy that weighs the predicted peak, such as {WEIGHS_PEAK}, avoids such awards."


def _limit_c(fault: Event) -> float:
    return fault.value if math.isfinite(fault.value) else math.inf


def _cause(fault: Event, log: ShiftLog) -> Iterable[str]:
    """Why an arm faulted, as far as its award tells, and what would have avoided it."""
    plan = log.plan
    award = plan.at(fault.arm, fault.time_s, fault.job)
    if award is None:
        return
    begin_s = _begin(award, [a for a in plan.assignments if a.arm == fault.arm and a.start_s <= fault.time_s])
    pause = f"at work without a pause since {clock(begin_s, log.begin)}; " if begin_s < award.start_s else ""
    own = _own_offer(award, log)
    if own is None:
        if pause:
            yield f"Why: {pause}no prediction was recorded."
        return
    yield (
        f"Why: {pause}at the award, {clock(award.start_s, log.begin)}, predicted peak {own.peak_c:.0f} °C and "
        f"P(saturation) {own.p_saturation:.2f}."
    )
    yield _avoidable(fault, own, log.offers_behind(award.job, award.arm, award.start_s), log)


def _begin(award: JobSpan, work: Sequence[JobSpan]) -> float:
    """Start of the uninterrupted work of an arm before an award."""
    begin_s = award.start_s
    for a in sorted(work, key=lambda a: a.start_s, reverse=True):
        if a.start_s < begin_s <= a.end_s + PAUSE_S:
            begin_s = a.start_s
    return begin_s


def _avoidable(fault: Event, own: Offer, offered: Sequence[Offer], log: ShiftLog) -> str:
    """What would have avoided a fault, by the predictions at the award of its job."""
    own_c = own.peak_c or math.inf
    limit_c = _limit_c(fault)
    most_c = min(own_c, limit_c) - MARGIN_K
    cooler = [o for o in offered if not o.awarded and o.feasible and o.peak_c is not None and o.peak_c <= most_c]
    free = [o for o in cooler if o.free]
    if cooler:
        best = min(free or cooler, key=lambda o: o.peak_c or 0.0)
        choice = f"Avoidable by giving the job to {best.arm}, predicted peak {best.peak_c:.0f} °C"
        return f"{choice}: it was free." if best.free else f"{choice}, {_occupied(best, log)}."
    others = "no other arm could do the job" + (" cooler" if any(o.feasible and not o.awarded for o in offered) else "")
    if own_c < limit_c:
        return f"Not predicted: the predicted peak was below the limit, and {others}."
    return f"Avoidable only by letting the job wait until {fault.arm} had cooled: {others}."


def _occupied(offer: Offer, log: ShiftLog) -> str:
    """Why an arm could not take a job, or until when."""
    if why := {"faulted": "was out after a fault", "break": PAUSED, "paused": "was paused"}.get(offer.state):
        return f"which {why}"
    plan = log.plan
    current = plan.at(offer.arm, offer.time_s)
    if current is None or current.end_s == offer.time_s:
        return "but its place or space was taken"
    if current.end_s >= plan.horizon_s:
        return "which was busy to the end"
    return f"once it was free, at {clock(current.end_s, log.begin)}"


ROWS = 300
"""Most rows of the event table."""
BEFORE_S = 5.0
"""A click on an event goes to this time before it."""
NOTABLE = (
    "fault",
    "failure",
    "contact",
    "give_up",
    "alarm",
    "pause",
    "resume",
    "cancel",
    "settle",
    "change",
    "clear",
    "recover",
    "return",
    "break",
    "break_end",
    "warning",
    "torque_warning",
    "alarm_acknowledged",
    "alarm_ended",
    "lost",
)
"""Kinds of events and notices of the event table, most important first; the least important are dropped first."""
MOST_AWARDS = 300
MOST_OFFERS = 7
"""Other offers that an award shows."""


def report_html(log: ShiftLog, model: Mapping[str, Any] | None = None) -> str:
    """The report of a shift as one HTML page; the same input, with events in any order, gives the same text.

    Args:
        log: Missing figures of its card are left out of the report.
        model: `fleet.arm.cell.cell_model` with the same arms; without it nothing is shown in 3-D.

    Raises:
        ValueError: the events contradict each other.
    """
    log = replace(log, events=tuple(sorted(log.events, key=lambda e: (e.time_s, e.arm, e.kind, e.job))))
    card, replay = log.card, None
    if model is not None and len(log.readings.time_s):
        replay = _playback([log], model)
    scenario = card.get("scenario", {})
    outcome = verdict(log)
    sections = [
        Section(key=chart.key.replace("chart", "figure"), title=heading, charts=(chart,))
        for heading, chart in shift_charts(log).items()
    ]
    if late := late_table(log):
        sections.append(Section(key="late", title="Late jobs", tables=(late,)))
    sections += [_event_section(log), *_award_section(log)]
    provenance = (("All settings and figures", _provenance(card).html()),)
    sections.append(Section(key="provenance", title="Provenance", details=provenance))
    seed = f" · seed {card['seed']}" if "seed" in card else ""
    head = Head(
        badges=[Badge(outcome.badge, outcome.good, next(iter(outcome.moments.values()), None))],
        sentences=outcome.sentences,
        moments=outcome.moments,
        remarks=[*filter(None, [scenario.get("description")]), " · ".join(_settings(card, log.arms))],
        tiles=key_figures(card.get("metrics") or {}),
        replay=replay,
    )
    title = f"{scenario.get('name', 'unnamed scenario')} · {log.policy}{seed}"
    return Page(title=title, sections=sections, head=head, narrow=False).html()


def _playback(logs: Sequence[ShiftLog], model: Mapping[str, Any]) -> Playback:
    """Shifts with readings in the same cell, to be played in step."""
    limits = logs[0].limits
    return Playback(
        model={**model, "heat": heat_scale(limits.warning_c, limits.error_c)},
        shifts=tuple(packed(log.readings, log.load_kg) for log in logs),
        unit_s=time_unit(logs[0].plan.horizon_s)[1],
        begin=logs[0].begin,
    )


def run_html(log: ShiftLog) -> str:
    """A run in words, and its key figures, as a notebook shows them."""
    title = f"{log.card['scenario']['name']} · {log.policy} · seed {log.card['seed']}"
    return str(render("notebook.html", title=title, verdict=verdict(log), tiles=key_figures(log.card["metrics"])))


def _settings(run: Mapping[str, Any], arms: Sequence[str]) -> list[str]:
    horizon_s = run.get("scenario", {}).get("horizon_s")
    length = f"{duration(horizon_s)} shift" if horizon_s is not None else "Shift"
    how = [f"{length} of {len(arms)} arm{'s' if len(arms) != 1 else ''}"]
    return how + [f"{name} {run[name]}" for name in ("plant", "bus", "difficulty") if run.get(name) is not None]


class KeyFigure(NamedTuple):
    """One of the most important metrics."""

    label: str
    name: str
    """The metric."""
    form: str
    unit: str = ""
    whole: str = ""
    """The metric that it is a part of."""


KEY_FIGURES = (
    KeyFigure("jobs finished", "finished", ",.4g", whole="jobs"),
    KeyFigure("value", "value", ",.4g", whole="value_offered"),
    KeyFigure("on time", "on_time", ",.4g", whole="finished"),
    KeyFigure("tardiness if finished", "tardiness_min", ",.1f", "min"),
    KeyFigure("jobs per hour", "jobs_per_hour", ".1f"),
    KeyFigure("faults", "faults", ".0f"),
    KeyFigure("contacts", "contacts", ",.0f"),
    KeyFigure("given up", "given_up", ",.0f"),
    KeyFigure("expired", "expired", ",.0f"),
    KeyFigure("above warning", "above_warning_min", ",.1f", "min"),
    KeyFigure("hottest motor", "hottest_c", ".1f", "°C"),
    KeyFigure("too hot to touch", "hot_surface_min", ",.1f", "min"),
    KeyFigure("availability", "availability", ".1%"),
    KeyFigure("utilisation", "utilisation", ".1%"),
    KeyFigure("energy to heat", "energy_wh", ",.0f", "Wh"),
    KeyFigure("tool drift", "most_drift_mm", ".2f", "mm"),
    KeyFigure("insulation used", "most_insulation_ppb", ",.3g", "ppb"),
    KeyFigure("claims lost to another arm", "lost_claims", ",.0f"),
)
MAIN_FIGURES = ("finished", "value", "on_time", "faults", "above_warning_min", "hottest_c")
"""Metrics by which shifts are compared in a chart."""
RARE = ("contacts", "given_up", "expired")
"""At the head of a report only where there are some."""


def key_figures(metrics: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, text and style of the most important metrics; those without a number are left out."""
    values, peaks_c = numbers(metrics), _peaks(metrics)
    hottest = max(peaks_c, key=lambda arm: peaks_c[arm], default="")
    tiles = list[tuple[str, str, str]]()
    for label, name, form, unit, whole in KEY_FIGURES:
        if name in values and (name not in RARE or values[name] > 0):
            small = f"of {values[whole]:{form}}" if whole in values else f"{unit} {hottest * (name == 'hottest_c')}"
            bad = "bad" if name in ("faults", "contacts") and values[name] > 0 else ""
            tiles.append((label, f"{values[name]:{form}} {small}".rstrip(), bad))
    return tiles


def figure_table(shifts: Mapping[str, Mapping[str, Any]], *, wholes: bool = False, in_file: bool = False) -> Table:
    """Key figures, a column for each shift's metrics by its name, and the second of two minus the first.

    Args:
        wholes: Say of what a figure is a part, as in `77 of 87`; without it, cells are plain numbers.
        in_file: Differences are plain numbers, too.
    """
    columns, rows = [numbers(metrics) for metrics in shifts.values()], list[tuple[str, ...]]()
    for label, name, form, unit, whole in KEY_FIGURES:
        form, percent = form.replace(",", "").replace("%", "f"), form.endswith("%")
        if any(name in values for values in columns):
            scaled = [values[name] * 100**percent if name in values else None for values in columns]
            of = [f" of {values[whole]:{form}}" if wholes and whole in values else "" for values in columns]
            texts = ["" if each is None else f"{each:{form}}{part}" for each, part in zip(scaled, of, strict=True)]
            change = _difference(scaled, form, in_file=in_file)
            rows.append((str(Column(label, "%" if percent else unit)), *texts, *change))
    return Table(head=("", *shifts, *(["difference"] if len(shifts) == 2 else [])), rows=tuple(rows))


def _difference(values: Sequence[float | None], form: str, *, in_file: bool) -> list[str]:
    """The second value less the first, as the last cell of a row of two; none in other rows."""
    if len(values) != 2:
        return []
    first, second = values
    if first is None or second is None:
        return [""]
    change = f"{second - first:{'' if in_file else '+'}{form}}"
    return ["0" if not float(change) else change if in_file else change.replace("-", "−")]


def _peaks(metrics: Mapping[str, Any]) -> dict[str, float]:
    return {arm: c for arm, c in (metrics.get("peak_c") or {}).items() if c is not None and math.isfinite(c)}


def numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    """The finite numbers among metrics, and of those that each arm has the highest."""
    values = {k: float(v) for k, v in metrics.items() if isinstance(v, int | float) and math.isfinite(v)}
    own = {
        "hottest_c": _peaks(metrics),
        "most_drift_mm": metrics.get("tool_drift_mm"),
        "most_insulation_ppb": metrics.get("insulation_ppb"),
    }
    return values | {name: max(by_arm.values()) for name, by_arm in own.items() if by_arm}


def _event_section(log: ShiftLog) -> Section:
    """The notable events and notices by time, how many there are, and which are left out."""
    notable = [e for e in joined_breaks((*log.events, *log.notices), log.arms) if e.kind in NOTABLE]
    if not notable:
        return Section(key="log", title="Events", sentences=("No fault, no warning, no lost claim.",))
    first = sorted(notable, key=lambda e: (NOTABLE.index(e.kind), e.time_s))
    listed, rest = first[:ROWS], first[ROWS:]
    sentences = [f"{_counted(Counter(e.kind for e in notable))}."]
    if rest:
        omitted = _counted(Counter(e.kind for e in rest))
        sentences.append(
            f"{len(listed)} of {len(notable)} are listed; left out: {omitted}. The event log has all of them."
        )
    listed.sort(key=lambda e: (e.time_s, e.arm, NOTABLE.index(e.kind)))
    table = Table(
        head=("time", "event", "arm", "job", "reason, or who"),
        rows=tuple((clock(e.time_s, log.begin), kind_text(e.kind), e.arm, e.job, e.reason) for e in listed),
        numbers=False,
    )
    kinds, moments = [e.kind for e in listed], [_before(event) for event in listed]
    shown = table.html(style="events", key="events", kinds=kinds, moments=moments)
    return Section(key="log", title="Events", sentences=tuple(sentences), html=shown)


def _before(event: Event | Notice) -> Moment:
    return Moment(max(0.0, event.time_s - BEFORE_S), event.arm)


def _award_section(log: ShiftLog) -> Iterator[Section]:
    """Why each arm got its job: the offers behind each award; nothing without offers."""
    awards = [list(group) for _, group in groupby(log.known_offers, key=lambda o: (o.time_s, o.job))]
    if not awards:
        return
    rows, moments = list[tuple[str, ...]](), list[Moment]()
    for award in awards[:MOST_AWARDS]:
        winner = next(offer for offer in award if offer.awarded)
        others = sorted((offer for offer in award if offer is not winner), key=_rank)
        cells = (winner.arm, offer_text(winner), offers_text(others[:MOST_OFFERS]))
        rows.append((clock(winner.time_s, log.begin), winner.job, *cells))
        moments.append(Moment(winner.time_s, winner.arm))
    left = f" The first {MOST_AWARDS} of {len(awards)} are listed; offers.parquet has all of them."
    how = (
        "P: probability that a motor passes its warning limit. Then the predicted peak, the difficulty d, and the "
        "duration of the job; in brackets, why the arm could not take it then. Other offers: free arms "
        "first, then by P and predicted peak." + left * (len(awards) > MOST_AWARDS)
    )
    head = ("time", "job", "awarded to", "its offer", "other offers")
    shown = Table(head=head, rows=tuple(rows), numbers=False).html(key="choices", moments=moments)
    details = ((f"The offers behind {len(awards)} award{'s' * (len(awards) > 1)}", shown),)
    yield Section(key="awards", title="Why each arm got its job", how=how, details=details)


def _rank(offer: Offer) -> tuple[bool, bool, float, float, str]:
    """Sort key of offers: free arms first, then by P(saturation) and predicted peak; unknown ones last of their kind,
    infeasible ones last of all."""
    p, peak_c = (math.inf if value is None else value for value in (offer.p_saturation, offer.peak_c))
    return not offer.feasible, not offer.free, p, peak_c, offer.arm


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[kind]} × {kind_text(kind)}" for kind in NOTABLE if counts.get(kind))


def _provenance(run: Mapping[str, Any]) -> Table:
    """Everything else in `run.json`; the cell of an unknown value is empty."""
    rows = list[tuple[str, str]]()
    scenario = {f"scenario {k}": v for k, v in run.get("scenario", {}).items() if k not in ("name", "description")}
    rest = {k: v for k, v in run.items() if k not in ("scenario", "status", "policy", "seed")}
    for key, value in (rest | scenario).items():
        parts = value.items() if isinstance(value, Mapping) else [("", value)]
        texts = [(part, "" if inner is None else value_text(inner)) for part, inner in parts]
        rows += [(f"{key} {part}".strip(), text) for part, text in texts]
    return Table(head=("", ""), rows=tuple(rows), numbers=False)


def other_choices(log: ShiftLog, other: ShiftLog) -> list[str]:
    """Of the job of each fault, what became of it in the other shift; nothing for the shift itself."""
    lines: list[str] = []
    if other is log:
        return lines
    for job in dict.fromkeys(fault.job for fault in log.faults if fault.job):
        own = [event for event in other.events if event.job == job]
        faults = [event for event in own if event.kind == "fault"]
        finish = next((event for event in own if event.kind == "finish"), None)
        if finish is not None:
            after = f", after {len(faults)} fault{'s' * (len(faults) > 1)}" if faults else " without a fault"
            lines.append(
                f"Under {other.policy}, {finish.arm} finished {job} at {clock(finish.time_s, other.begin)}{after}."
            )
        else:
            began = any(event.kind == "award" for event in own)
            lines.append(f"Under {other.policy}, {job} was not {'finished' if began else 'begun'}.")
    return lines


SETTINGS = {
    "policy": "policy",
    "seed": "seed",
    "difficulty": "predictions",
    "risk": "risk",
    "plant": "plant",
    "bus": "bus",
}
"""Settings of a run that the table of several runs has, by their keys in the card."""
LONG_SETTINGS = {
    "scenario_hash": ("content of the scenario", ("scenario",)),
    "channel": ("channel between the arms", ("scenario",)),
    "twins": ("twins", ("scenario", "predictions")),
    "versions": ("versions of libraries", ()),
    "code_hash": ("code", ()),
}
"""Other settings by their keys: name, and the settings of which each, if it differs, explains a difference of this."""


def _differences(logs: Mapping[str, ShiftLog]) -> list[str]:
    """Names of the settings in which runs differ."""

    def differ(key: str) -> bool:
        first, *others = (log.card.get(key) for log in logs.values())
        return any(each != first for each in others)

    names = ["scenario"] if len({log.card.get("scenario", {}).get("name") for log in logs.values()}) > 1 else []
    names += [name for key, name in SETTINGS.items() if differ(key)]
    return names + [name for key, (name, causes) in LONG_SETTINGS.items() if differ(key) and not {*causes} & {*names}]


def runs_table(logs: Mapping[str, ShiftLog], *, in_file: bool = False) -> Table:
    """Settings, outcome and key figures, a column for each run by its name; "" for a figure that a run lacks.

    Args:
        in_file: As of `figure_table`.
    """
    settings = {
        "scenario": [str(log.card.get("scenario", {}).get("name", "")) for log in logs.values()],
        **{name: [str(log.card.get(key, "")) for log in logs.values()] for key, name in SETTINGS.items()},
        "outcome": [verdict(log).badge for log in logs.values()],
    }
    figures = figure_table({name: log.card.get("metrics") or {} for name, log in logs.items()}, in_file=in_file)
    rows = [(name, *cells, *([""] if len(logs) == 2 else [])) for name, cells in settings.items()]
    return replace(figures, rows=(*rows, *figures.rows))


def bars(logs: Mapping[str, ShiftLog]) -> Figure:
    """The main figures one below the other, each with a bar for each run."""
    values = [numbers(log.card.get("metrics") or {}) for log in logs.values()]
    shown = [each for each in KEY_FIGURES if each.name in MAIN_FIGURES and any(each.name in own for own in values)]
    names, rows = [plain(name, STREAM_NAME) for name in logs], list(range(len(logs)))
    block_px = TITLE_PX + BAR_PX * len(logs)
    height_px = block_px * max(1, len(shown))
    data, layout, titles = list[dict[str, Any]](), dict[str, Any](), list[dict[str, Any]]()
    for number, (label, name, form, unit, _) in enumerate(shown, start=1):
        top = 1 - ((number - 1) * block_px + TITLE_PX) / height_px
        own = [each.get(name) for each in values]
        text = ["" if value is None else f"{value:{form}}" for value in own]
        look = {
            "textposition": "outside",
            "textangle": 0,
            "cliponaxis": False,
            "hovertemplate": "%{text}<extra></extra>",
        }
        look |= {"marker": {"color": [COLOURS[k % len(COLOURS)] for k in rows]}}
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}"}
        data.append({"type": "bar", "orientation": "h", "x": own, "y": rows, "text": text} | look | axes)
        layout[f"xaxis{number}"] = AXIS | {"anchor": f"y{number}", "rangemode": "tozero", "visible": False}
        domain = [max(0.0, top - BAR_PX * len(logs) / height_px), top]
        layout[f"yaxis{number}"] = named_rows(names, anchor=f"x{number}", domain=domain)
        place = {"x": 0, "xref": "paper", "xanchor": "left", "y": top, "yref": "paper", "yanchor": "bottom"}
        titles.append({"text": f"<b>{Column(label, unit)}</b>", "showarrow": False, **place})
    size = {"height": height_px + 16, "margin": {"l": 60, "r": 48, "t": 4, "b": 12}}
    return {"data": data, "layout": LAYOUT | layout | size | {"annotations": titles, "showlegend": False}}


BAR_PX, TITLE_PX = 24, 44
"""Height of a bar, and of the title and the gap above the bars of a figure."""


def _given_jobs(log: ShiftLog) -> Mapping[str, tuple[Any, ...]]:
    """What each job of a shift was before any policy decided on it, by name."""
    return {
        job.job: (
            job.release_s,
            job.due_s,
            job.value,
            job.payload_kg,
            job.cycles,
            log.work(job.job),
            log.stream(job.job).get("due"),
            log.stream(job.job).get("after"),
        )
        for job in log.jobs
    }


def runs_page(
    logs: Mapping[str, ShiftLog],
    *,
    title: str = "",
    lead: Sequence[str] = (),
    reports: Mapping[str, str] | None = None,
    model: Mapping[str, Any] | None = None,
) -> str:
    """Shifts by name as one HTML page that opens offline; the same shifts give the same text.

    It has key figures and what happened in each; of shifts with the same jobs also the hottest motors in one chart.

    Args:
        title, lead: Heading and first sentences; by default number and differences of the shifts.
        reports: Paths of their reports relative to the page, by name.
        model: As in `report_html`, of shifts in one cell: their movements are shown in step.
    """
    table = runs_table(logs)
    differ = _differences(logs)
    first_jobs, *other_jobs = map(_given_jobs, logs.values())
    equal_jobs = all(each == first_jobs for each in other_jobs)
    if not equal_jobs:
        differ.append("jobs")
    jobs = "All have the same jobs." if equal_jobs else "They have other jobs: their figures compare no policies."
    charts, replay = list[Chart](), None
    if equal_jobs and all(len(log.readings.time_s) for log in logs.values()):
        if len({log.limits for log in logs.values()}) == 1:
            alt = f"Hottest motor over the shift under {', '.join(logs)}"
            charts.append(Chart(key="hottest", figure=hottest_motors(logs), alt=alt))
        replay = _playback([*logs.values()], model) if model else None
    sections, badges = list[Section](), list[Badge]()
    for number, (name, log) in enumerate(logs.items()):
        outcome = verdict(log)
        badges.append(Badge(f"{name}: {outcome.badge}", outcome.good, next(map(_before, log.faults), None)))
        others = [line for other in logs.values() for line in other_choices(log, other)] if equal_jobs else []
        sections.append(Section(key=f"run-{number}", title=name, sentences=(*outcome.sentences, *others)))
    hashes = ("code_hash", "scenario_hash")
    origin = Table(
        head=("run", "hash of the code", "hash of the scenario"),
        rows=tuple((name, *(str(log.card.get(key, "")) for key in hashes)) for name, log in logs.items()),
        numbers=False,
    )
    charts.append(Chart(key="main", figure=bars(logs), alt=f"Main figures of {', '.join(logs)}; the table has them"))
    figures = Section(key="figures", title="Figures", charts=tuple(charts), html=table.html(style="compared"))
    head = Head(
        badges=badges,
        sentences=lead[:1] or (f"The runs differ in {names_text(differ) or 'nothing'}. {jobs}",),
        remarks=lead[1:],
        replay=replay,
        names=tuple(logs),
        links={name: quote(path) for name, path in (reports or {}).items()},
    )
    title = title or f"{len(logs)} runs{'' if 'scenario' in differ else f' of {table.rows[0][1]}'}"
    return Page(title=title, sections=[figures, *sections], head=head, origin=origin, narrow=False).html()
