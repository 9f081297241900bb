"""Numbers of a scenario file that are probably in another unit: each is asked about in one sentence."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from math import degrees, pi
from typing import NamedTuple, TypeGuard

from fleet.errors import ScenarioError

_LOG = logging.getLogger(__name__)
EPOCH_S, EPOCH_MS = 1e8, 1e11
"""Smallest times that are taken for seconds or milliseconds since 1970; shifts are shorter."""
MOST = 1e15
"""Smallest number that is not looked at: it is refused for its size."""
FEWEST_ARRIVALS, FEWEST_POINTS = 3, 2
"""Different times of arrivals, or of ambient temperatures, of which it can be said that they are minutes."""
MOST_NAMED = 3
"""Times that a warning names."""


HOT_CELL_C = 50.0
"""Allowed ambient temperatures from here on are probably in °F."""


class _Mistake(NamedTuple):
    unit: str
    """Probably meant."""
    low: float
    high: float
    """Magnitudes that are taken for this unit; they are not sensible in the right one."""


_MISTAKES: Mapping[str, _Mistake] = {
    **dict.fromkeys(("warning_c", "error_c", "restart_c", "lower_c"), _Mistake("kelvin", 263.15, 473.15)),
    **dict.fromkeys(("cool_c", "ambient_c", "air_c"), _Mistake("kelvin", 263.15, 473.15)),
    "points": _Mistake("kelvin", 263.15, 333.15),  # of the ambient temperature, which is at most 60 °C
    **dict.fromkeys(("payload_kg", "tool_kg", "payload_limit_kg"), _Mistake("grams", 20.0, 20_000.0)),
    "size_m": _Mistake("millimetres", 20.0, 20_000.0),
    "retreat_m": _Mistake("millimetres", 2.0, 20_000.0),
    "clearance_m": _Mistake("millimetres", 0.5, 20_000.0),
}
"""By key, at any depth of a file."""
_FAHRENHEIT = {each: _Mistake("°F", 110.0, 263.0) for each in ("warning_c", "error_c", "restart_c")}
"""Of limits of motors, which stop at 75 °C."""
_MEANT: Mapping[str, Callable[[float], str]] = {
    "°F": lambda f: f"{f:g} °F is {(f - 32) / 1.8:.1f} °C. Give °C.",
    "kelvin": lambda k: f"{k:g} K is {k - 273.15:.1f} °C. Give °C.",
    "grams": lambda g: f"{g:g} g is {g / 1000:g} kg. Give kg.",
    "millimetres": lambda mm: f"{mm:g} mm is {mm / 1000:g} m. Give m.",
}
_ANGLES = ("tilt_deg", "tool_deg")
_TURNS = {
    round(pi * k / n, d) for n in (2, 3, 4, 6) for k in range(1, 2 * n + 1) for d in range(2 if n == 2 else 3, 17)
}
"""Common angles in radians, as people round them."""


def check_units(raw: object, file: str) -> None:
    """Check that no number of a parsed file is probably in another unit.

    Raises:
        ScenarioError: place, number, and what it would be in the unit that is probably meant.
    """
    for place, key, numbers in _numbers(raw):
        if sentence := question(key, numbers):
            shown = f"{numbers[0]:g}" if len(numbers) == 1 else f"[{', '.join(f'{each:g}' for each in numbers)}]"
            raise ScenarioError(f"{file}: {place} = {shown}: {sentence}")


def question(key: str, numbers: Sequence[float]) -> str:
    """A question about the unit of the numbers of a key; "" if they are sensible."""
    if key in _ANGLES:
        turns = [abs(each) for each in numbers if abs(each) in _TURNS]
        if turns and all(not each or abs(each) in _TURNS for each in numbers):
            return f"is this radians? {turns[0]:g} rad is {degrees(turns[0]):.0f}°. Give degrees."
    worst = max(numbers, key=abs)
    for mistakes in (_MISTAKES, _FAHRENHEIT):
        if (mistake := mistakes.get(key)) and mistake.low <= abs(worst) <= mistake.high:
            return f"is this {mistake.unit}? {_MEANT[mistake.unit](worst)}"
    return ""


def _numbers(raw: object, place: str = "", key: str = "") -> Iterator[tuple[str, str, list[float]]]:
    """Place, key and numbers of each number and each list of numbers, at any depth; of ambient points the second."""
    if isinstance(raw, Mapping):
        for name, value in raw.items():
            yield from _numbers(value, f"{place}.{name}" if place else str(name), str(name))
    elif isinstance(raw, list | tuple):
        if key == "points" and all(isinstance(point, list | tuple) and len(point) == 2 for point in raw):
            raw = [point[1] for point in raw]
        numbers = [float(each) for each in raw if _is_number(each)]
        if numbers and len(numbers) == len(raw):
            yield place, key, numbers
        for i, value in enumerate(() if numbers else raw):
            yield from _numbers(value, f"{place}[{i}]")
    elif _is_number(raw):
        yield place, key, [float(raw)]


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < MOST


def check_times(
    times_s: Sequence[float],
    horizon_s: float,
    where: str,
    names: Sequence[str] = (),
    numbers_s: Sequence[float] | None = None,
) -> None:
    """Log a warning if some arrival times lie outside the shift, or are probably in another unit.

    Args:
        where: Begins each sentence.
        names: Of the times, for the warning; may be left out.
        numbers_s: Times that were given as numbers, which may be in another unit; by default all.

    Raises:
        ScenarioError: none lies in the shift.
    """
    inside, count = sum(time < horizon_s for time in times_s), len(times_s)
    if not times_s:
        raise ScenarioError(f"{where} gives no job: there are no times. Give seconds from the begin of the shift.")
    if not horizon_s > 0:  # reported when the scenario is made
        return
    numbers_s = times_s if numbers_s is None else numbers_s
    question, last = _unit_of_times(numbers_s, horizon_s, FEWEST_ARRIVALS) if numbers_s else "", max(times_s)
    if not inside:
        which = "its only time is" if count == 1 else f"all {count} times are"
        raise ScenarioError(
            f"{where} gives no job: {which} outside the shift, which ends at horizon_s = {horizon_s:g} "
            f"(got {min(times_s):.15g} to {last:.15g} s).{question or ' Give seconds from the begin of the shift.'}"
        )
    if inside < count:
        _LOG.warning(
            "%s: %d of %d times are outside the shift, which ends at horizon_s = %g; these jobs never arrive%s.%s",
            *(where, count - inside, count, horizon_s, _first_outside(times_s, horizon_s, names), question),
        )
    elif question:
        which = "times" if len(numbers_s) == count else f"of {count} times that are numbers"
        within = f"all {len(numbers_s)} {which} are within {max(numbers_s):g} s of a shift of {horizon_s:g} s"
        _LOG.warning("%s: %s.%s", where, within, question)


def check_ambient(points: Sequence[tuple[float, float]], horizon_s: float, where: str) -> None:
    """Log a warning if times or values of ambient temperatures are probably in another unit; `where` begins it."""
    times_s, hottest_c = [time_s for time_s, _ in points], max((c for _, c in points), default=0.0)
    if hottest_c >= HOT_CELL_C:
        _LOG.warning("%s: %g °C: is this °F? %s", where, hottest_c, _MEANT["°F"](hottest_c))
    if times_s and (asked := _unit_of_times(times_s, horizon_s, FEWEST_POINTS)):
        _LOG.warning("%s: the last time is %g.%s", where, max(times_s), asked)


def _first_outside(times_s: Sequence[float], horizon_s: float, names: Sequence[str]) -> str:
    """The first of the named times outside the shift, after a colon; "" without names."""
    outside = [f"{name} at {time:.15g} s" for name, time in zip(names, times_s, strict=False) if time >= horizon_s]
    return f": {', '.join(outside[:MOST_NAMED])}{', …' * (len(outside) > MOST_NAMED)}" if outside else ""


def _unit_of_times(times_s: Sequence[float], horizon_s: float, fewest: int) -> str:
    first, last = min(times_s), max(times_s)
    if first >= EPOCH_S:
        unit, factor = ("milliseconds", 0.001) if first >= EPOCH_MS else ("seconds", 1.0)
        if first * factor < 1e10:
            day = datetime.fromtimestamp(first * factor, UTC).isoformat(sep=" ", timespec="seconds")
            return f" Are these {unit} since 1970? The first is {day[:19]} UTC. Subtract the begin of the shift."
    middle = sorted(times_s)[len(times_s) // 2]  # a single date beyond the shift is no unit
    if middle >= horizon_s and last / 1000 < horizon_s and last >= 10 * horizon_s:
        return f" Are these milliseconds? {last:g} ms is {last / 1000:g} s. Give seconds."
    for unit, short, unit_s in (("minutes", "min", 60), ("hours", "h", 3600), ("days", "d", 86_400)):
        if len(set(times_s)) >= fewest and horizon_s / 2 <= unit_s * last <= horizon_s:
            return f" Are these {unit}? {last:g} {short} is {unit_s * last:g} s. Give seconds."
    return ""
