"""The calendar of a shift: breaks and recurring jobs at times of day, and the absences of arms in ticks.

A scenario file gives `begin` and `end` of a break as a job table does: in seconds or `h:mm` from the begin of the
shift, or as dates; with `shift_begin`, `h:mm` is a time of day. A break between times of day recurs on its `weekdays`,
by default every day, and so do arrivals of kind `weekly`. They become plain times here, so the rest of the product
knows no calendar.
"""

import logging
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, time, timedelta, tzinfo
from functools import partial
from math import ceil, inf
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from fleet.engine.state import ABSENCE, BROKEN, FINISH_CYCLE, FINISH_JOB, no_absences
from fleet.errors import ScenarioError, nearest, printable
from fleet.seeding import child
from scenarios.spec.job_table import DAY_S, counts_as, seconds_of, since, twice
from scenarios.spec.schema import MOST_BREAKS, Scenario

_LOG = logging.getLogger(__name__)
WEEKDAYS = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
HOUR = timedelta(hours=1)
DAY, LONGEST_NIGHT = 24 * HOUR, 12 * HOUR
"""The end of a day, and the longest break beyond it: a longer one probably has its begin and end exchanged."""
SHORT_S = 60.0
"""Length below which the times of a break are probably minutes."""
FAILURES = 3
"""Child of the seed of a shift that samples the failures of its arms."""
_ROUNDING = 1e-9
"""Ticks by which a break may begin or end late."""


def zone_of(name: object, where: str) -> tzinfo | None:
    """The time zone of an IANA name; None without one.

    Raises:
        ScenarioError: there is no such zone on this machine.
    """
    if name is None:
        return None
    try:
        return ZoneInfo(str(name))
    except (ValueError, OSError) as error:  # a ZoneInfoNotFoundError is a KeyError
        raise ScenarioError(f"{where}: '{printable(str(name))}' is no name of a time zone ({error}).") from error
    except KeyError as error:
        raise ScenarioError(
            f"{where}: there is no time zone '{printable(str(name))}'; give a name as Europe/Berlin or UTC."
        ) from error


def begin_of(shift_begin: str, time_zone: str | None) -> datetime:
    """The begin of the shift of a `Scenario`, in the zone of its times of day."""
    begin = datetime.fromisoformat(shift_begin)
    return begin if time_zone is None else begin.astimezone(ZoneInfo(time_zone))


def date_at(begin: datetime, time_s: float) -> datetime:
    """The date of a time of the shift, to the second, in the zone of its begin."""
    return (begin.astimezone(UTC) + timedelta(seconds=round(time_s))).astimezone(begin.tzinfo)


def moment_text(moment: datetime, form: str) -> str:
    """A date in a form for times of day; where clocks go back, the hour that occurs twice has the name of its zone."""
    return f"{moment:{form}{' %Z' if twice(moment) else ''}}"


def with_calendar(raw: Mapping[str, Any], begin: datetime | None, horizon_s: float, file: str) -> dict[str, Any]:
    """The parsed file with the times of its breaks and recurring jobs in seconds; Any: values of TOML.

    Args:
        begin: Of the shift; None for unknown.
        horizon_s: Length of the shift; 0 if it is not valid, which is reported later.

    Raises:
        ScenarioError: a time, a weekday, or the begin of the shift is missing or wrong.
    """
    made = dict(raw)
    if not horizon_s:
        return made | {name: [] for name in ("breaks", "jobs") if name in made}
    if isinstance(breaks := raw.get("breaks"), list):
        made["breaks"] = [
            entry
            for i, each in enumerate(breaks)
            for entry in (
                _break_times(each, begin, horizon_s, f"{file}: breaks[{i}]") if isinstance(each, Mapping) else [each]
            )
        ]
    if isinstance(jobs := raw.get("jobs"), list):
        made["jobs"] = [_recurring(each, begin, horizon_s, f"{file}: jobs[{i}]") for i, each in enumerate(jobs)]
    return made


def _break_times(
    given: Mapping[str, Any], begin: datetime | None, horizon_s: float, where: str
) -> Iterator[dict[str, Any]]:
    """The breaks of one entry, with `begin_s` and `end_s`."""
    entry = {name: value for name, value in given.items() if name not in ("begin", "end", "weekdays")}
    if double := [name for name in ("begin", "end") if name in given and f"{name}_s" in given]:
        raise ScenarioError(f"{where}: {double[0]} and {double[0]}_s are the same time; keep one of them.")
    if given.get("arms") == []:
        raise ScenarioError(f"{where}.arms is empty: name the arms, or leave it out for a break of all of them.")
    times = [given.get(name, given.get(f"{name}_s")) for name in ("begin", "end")]
    numbers = [float(each) for each in times if isinstance(each, int | float)]
    if len(numbers) == 2 and 0 < (length_s := numbers[1] - numbers[0]) < SHORT_S:
        raise ScenarioError(f"{where} lasts {length_s:g} s: are its times minutes? Give seconds, h:mm or h:mm:ss.")
    if "begin" not in given and "end" not in given and "weekdays" not in given:
        yield entry  # whose own times are checked with its fields
        return
    if missing := [name for name in ("begin", "end") if name not in given]:
        raise ScenarioError(f"{where}: '{missing[0]}' is missing; a break has begin and end.")
    daily = begin is not None and all(_is_clock(given[name]) for name in ("begin", "end"))
    if "weekdays" not in given and not daily:
        tell = partial(_LOG.warning, "%s: %s.", where)
        try:
            first_s, last_s = (seconds_of(given[name], begin, horizon_s, tell) for name in ("begin", "end"))
        except ValueError as error:
            raise ScenarioError(f"{where}: {error}.") from error
        yield entry | {"begin_s": first_s, "end_s": last_s}
        return
    first, last = (_clock(given[name], f"{where}.{name}") for name in ("begin", "end"))
    if next_day := last <= first:
        last += DAY
    if next_day and last - first in (timedelta(), DAY):
        raise ScenarioError(
            f"{where}: {given['begin']} to {given['end']} begins and ends at the same time of day; a whole day is 0:00 "
            "to 24:00."
        )
    if next_day and last - first > LONGEST_NIGHT and last != DAY:
        raise ScenarioError(
            f"{where}: {given['begin']} to {given['end']} lasts {(last - first) / HOUR:.4g} h over midnight, but at "
            f"most {LONGEST_NIGHT / HOUR:g} h are taken: are begin and end exchanged? Give a longer break as two, to "
            "24:00 and from 0:00 on the next days, or with dates for a single one."
        )
    touched = False
    for day_s, date in _days(given.get("weekdays", list(WEEKDAYS)), begin, horizon_s, where):
        begin_s, end_s = day_s(date, first), day_s(date, last)
        touched |= end_s > 0 and begin_s < horizon_s
        if end_s > max(0.0, begin_s) and begin_s < horizon_s:  # not within the hour that summer time leaves out
            yield entry | {"begin_s": begin_s, "end_s": end_s}
    if not touched and "weekdays" not in given:
        raise ScenarioError(
            f"{where}: {given['begin']} to {given['end']} is outside the shift, which begins at {begin:%H:%M} and ends "
            f"{horizon_s / 3600.0:.3g} h later."
        )


def _recurring(stream: Any, begin: datetime | None, horizon_s: float, where: str) -> Any:
    """A stream whose weekly arrivals are a trace; any other value as it is (Any: values of TOML)."""
    arrivals = stream.get("arrivals") if isinstance(stream, Mapping) else None
    if not isinstance(arrivals, Mapping) or arrivals.get("kind") != "weekly":
        return stream
    where = f"{where}.arrivals"
    if unknown := sorted(arrivals.keys() - {"kind", "at", "weekdays"}):
        raise ScenarioError(f"{where}: arrivals of kind 'weekly' take no '{unknown[0]}'; they take at, weekdays.")
    if not isinstance(times := arrivals.get("at"), list) or not times:
        raise ScenarioError(f'{where}.at must be a list of times of day, as ["6:00", "14:30"] (got {times!r}).')
    clocks = [_clock(each, f"{where}.at") for each in times]
    days = _days(arrivals.get("weekdays", list(WEEKDAYS)), begin, horizon_s, where)
    found = sorted(day_s(date, each) for day_s, date in days for each in clocks)  # each a job, also at one moment
    inside = [time_s for time_s in found if 0 <= time_s < horizon_s]
    if not inside:
        raise ScenarioError(f"{where}: none of these times lies within the shift of {horizon_s:g} s from {begin}.")
    return {**stream, "arrivals": {"kind": "trace", "times_s": inside}}


def _days(given: object, begin: datetime | None, horizon_s: float, where: str) -> Iterator[tuple[Any, datetime]]:
    """Midnight of each of the weekdays that may touch the shift, and a function of it and a time of day.

    The function gives seconds since the begin of the shift; a clock that is set in between counts. It logs a warning
    for a time in the shift that occurs twice or never.
    """
    place = f"{where}.weekdays"
    if begin is None:
        raise ScenarioError(f"{place}: weekdays need shift_begin, the begin of the shift.")
    if not isinstance(given, list) or not given:
        raise ScenarioError(f"{place} must be a list of days, as {list(WEEKDAYS[:2])} (got {given!r}).")
    for name in given:
        if name not in WEEKDAYS:
            raise ScenarioError(f"{place}: there is no day '{printable(str(name))}'{nearest(str(name), WEEKDAYS)}")

    def since_begin(date: datetime, clock: timedelta) -> float:
        moment = (date + clock).replace(tzinfo=begin.tzinfo)
        time_s, counted, doubt = since(begin, moment), counts_as(moment), twice(moment)
        if counted != date + clock:
            doubt = f"does not exist: summer time leaves out this hour, so it counts as {counted:%H:%M}"
        if doubt and 0 <= time_s < horizon_s:
            _LOG.warning("%s: %s %s.", where, f"{moment:%d %b %Y %H:%M}", doubt)
        return time_s

    for day in range(-1, ceil(horizon_s / DAY_S) + 1):
        date = datetime.combine(begin.date() + timedelta(days=day), time())
        if WEEKDAYS[date.weekday()] in given:
            yield since_begin, date


def _is_clock(given: object) -> bool:
    """Whether a value is written as a time of day."""
    return isinstance(given, time) or re.fullmatch(r"\d{1,2}:\d{2}(:\d{2})?", str(given)) is not None


def _clock(given: object, where: str) -> timedelta:
    """A time of day, by the clock since midnight; up to 24:00."""
    if str(given) in ("24:00", "24:00:00"):
        return DAY
    try:
        hours, _, rest = str(given).partition(":")
        clock = given if isinstance(given, time) else time.fromisoformat(f"{hours:0>2}:{rest}")
    except ValueError as error:
        raise ScenarioError(f"{where}: expected a time of day, as '6:00' (got {given!r}).") from error
    return timedelta(hours=clock.hour, minutes=clock.minute, seconds=clock.second, microseconds=clock.microsecond)


def check_breaks(scenario: Scenario, file: str) -> None:
    """Check the arms and times of the breaks.

    Raises:
        ScenarioError: names the break.
    """
    if len(scenario.breaks) > MOST_BREAKS:
        raise ScenarioError(f"{file}: breaks: at most {MOST_BREAKS} in a shift (got {len(scenario.breaks)}).")
    arms = [arm.name for arm in scenario.arms]
    for i, each in enumerate(scenario.breaks):
        for name in each.arms:
            if name not in arms:
                raise ScenarioError(f"{file}: breaks[{i}].arms: there is no arm '{name}'{nearest(name, arms)}")
        if each.end_s <= 0 or each.begin_s >= scenario.horizon_s:
            times_s = ((each.begin_s, each.end_s), (0.0, scenario.horizon_s))
            own, shift = (_span_text(scenario, *both) for both in times_s)
            raise ScenarioError(
                f"{file}: breaks[{i}]: '{each.name}', {own}, lies outside the shift, {shift}: change its times, or "
                "leave it out."
            )
    long = [each for each in scenario.breaks if each.begin_s <= 0 and each.end_s >= scenario.horizon_s]
    if all(any(arm in (each.arms or arms) for each in long) for arm in arms):
        raise ScenarioError(
            f"{file}: breaks: every arm has a break in the whole shift, {_span_text(scenario, 0.0, scenario.horizon_s)}"
            ", so no job can be done: change the times of a break or of the shift."
        )
    latest = dict[tuple[str, str], tuple[float, int]]()  # end and index, by name and arm
    for i, each in sorted(enumerate(scenario.breaks), key=lambda one: one[1].begin_s):
        for arm in each.arms or arms:
            end_s, other = latest.get((each.name, arm), (-inf, i))
            if each.begin_s < end_s:
                raise ScenarioError(
                    f"{file}: breaks[{i}].name: '{each.name}' is also the name of breaks[{other}], which overlaps it "
                    f"on '{arm}': rename one, or leave it out."
                )
            latest[each.name, arm] = max((end_s, other), (each.end_s, i))


def _span_text(scenario: Scenario, begin_s: float, end_s: float) -> str:
    """From when to when: dates if the begin of the shift is one, else seconds."""
    if scenario.shift_begin is None:
        return f"{begin_s:g} to {end_s:g} s"
    begin = begin_of(scenario.shift_begin, scenario.time_zone)
    return " to ".join(moment_text(date_at(begin, time_s), "%d %b %Y %H:%M") for time_s in (begin_s, end_s))


def absences_of(scenario: Scenario, seed: np.random.SeedSequence) -> np.ndarray:
    """Breaks of the arms, and failures sampled for the shift of a seed, `ABSENCE` [absence].

    A break begins with the first decision at or after its begin. Failures are a Poisson process of the time in which an
    arm is in order, with exponential times to repair: the usual model of availability (IEC 61703).
    """
    names, dt_s, rows = [arm.name for arm in scenario.arms], scenario.decision_interval_s, list[tuple[int, ...]]()

    def add(arm: int, begin_s: float, end_s: float, kind: int) -> None:
        begin, end = (ceil(each / dt_s - _ROUNDING) for each in (max(begin_s, 0.0), end_s))
        if end > 0 and begin < scenario.ticks:
            rows.append((arm, begin, min(max(end, begin + 1), scenario.ticks), kind))

    for each in scenario.breaks:
        for name in each.arms or names:
            kind = FINISH_CYCLE if each.finish == "cycle" else FINISH_JOB
            add(names.index(name), each.begin_s, each.end_s, kind)
    for index, arm in enumerate(scenario.arms):
        if arm.fails is None:
            continue
        rng, now_s = np.random.default_rng(child(seed, FAILURES, index)), 0.0
        while (now_s := now_s + rng.exponential(arm.fails.every_s)) < scenario.horizon_s:
            begin_s, now_s = now_s, now_s + rng.exponential(arm.fails.repair_s)
            add(index, begin_s, now_s, BROKEN)
    return np.array(rows, ABSENCE) if rows else no_absences()
