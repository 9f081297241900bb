"""A thermal forecast as text, numbers and a page with a chart."""

import math
from collections.abc import Mapping
from typing import Any  # values of JSON and of Plotly's schema

import numpy as np

from fleet.robot import JOINTS, ThermalLimits
from scenarios.show import charts
from scenarios.show.page import Chart, Page, Section, origin_table
from scenarios.show.words import duration
from scenarios.table import Column, Table
from twin.logs.recording import Recording
from twin.thermal.forecast import MOST_RESIDUAL_K, MOST_SD, MOST_WAY_RAD, RISK, SAMPLES, ThermalForecast

Array = np.ndarray

LIMITS_C = (40.0, ThermalLimits().warning_c, ThermalLimits().error_c)
"""Temperatures of which a forecast tells when they are reached."""
MOST_POINTS = 400
"""Points of a curve."""
MINUTE_S = 60.0


def summary(found: ThermalForecast, so_far: Recording, repetitions: int) -> list[str]:
    """What speaks against the forecast, the hottest motor at the end, and the highest safe start, in sentences."""
    low, middle, high = (each[-1] for each in found.interval())
    hottest, warning_c = int(middle.argmax()), ThermalLimits().warning_c
    warmer_k = found.safe_start_k(warning_c)
    times, doubts = "1 repetition" if repetitions == 1 else f"{repetitions} repetitions", _doubts(found, repetitions)
    first = (
        f"After {times}, {duration(found.run_s)}, joint {hottest + 1} is the hottest: "
        f"{middle[hottest]:.1f} °C (95 % interval {low[hottest]:.1f} to {high[hottest]:.1f}), now "
        f"{so_far_c(so_far)[hottest]:.1f} °C."
    )
    if math.isinf(warmer_k):
        at = f"from an arm at {found.ambient_c:g} °C"
        return [
            *doubts,
            first,
            f"No start of the planned run is safe: P({warning_c:g} °C) is more than {100 * RISK:g} % even {at}.",
        ]
    # Rounded down, so that it is below the limit.
    start_c = math.floor(10.0 * (float(so_far_c(so_far).max()) + warmer_k) - 1e-6) / 10.0
    than = f"{abs(warmer_k):.1f} K {'warmer' if warmer_k >= 0 else 'cooler'} than now"
    return [
        *doubts,
        first,
        f"Highest safe start of the planned run: hottest motor at {start_c:.1f} °C, if all motors and housings are "
        f"{than}.",
    ]


def _doubts(found: ThermalForecast, repetitions: int) -> list[str]:
    """What speaks against a forecast, in sentences."""
    doubts, joint, reason = list[str](), int(found.residual_k.argmax()), ""
    if found.residual_k[joint] > MOST_RESIDUAL_K:
        reason = (
            f"joint {joint + 1} has temperatures that differ by {found.residual_k[joint]:.1f} K (RMS) from those that "
            "its load explains; in public logs by up to 0.3 K"
        )
    elif found.distance_sd > MOST_SD:
        reason = (
            f"the load explains the temperatures only for an arm that is {found.distance_sd:.1f} standard deviations "
            "from the network"
        )
    elif found.unlike.doubts:
        reason = f"the load explains the temperatures only if {', and '.join(found.unlike.doubts)}"
    if reason:
        doubts.append(f"Do not trust this forecast: in the log, {reason}. {found.unlike.remedy}")
    if repetitions > 1 and found.way_back_rad > MOST_WAY_RAD:
        doubts.append(
            f"The plan ends {found.way_back_rad:.2f} rad from where it begins. The way back, between the repetitions, "
            "is not in the forecast: give a plan that returns."
        )
    return doubts


def so_far_c(so_far: Recording) -> Array:
    """Last motor temperatures of a log, °C, [joint]."""
    assert so_far.temp_c is not None, "a forecast starts from temperatures"
    return so_far.temp_c[-1]


def joint_table(found: ThermalForecast, so_far: Recording) -> Table:
    """Temperatures now and at the end of the run, and the highest in it, for each joint."""
    low, middle, high = found.interval()
    rows = [
        (
            str(j + 1),
            f"{so_far_c(so_far)[j]:.1f}",
            f"{middle[-1, j]:.1f}",
            f"{low[-1, j]:.1f} … {high[-1, j]:.1f}",
            f"{middle[:, j].max():.1f}",
            f"{high[:, j].max():.1f}",
        )
        for j in range(JOINTS)
    ]
    head = ("joint", "now, °C", "end, °C", "95 % interval", "max. in run, °C", "its 97.5 %, °C")
    return Table(head=head, rows=tuple(rows))


def limits(found: ThermalForecast) -> list[dict[str, Any]]:
    """Probability and times of reaching each limit in the run, and what is safe; None where it is never reached."""

    def finite(value: float) -> float | None:
        return None if math.isinf(value) else value

    return [
        {
            "limit_c": limit_c,
            "p": found.probability(limit_c),
            "reached_s": dict(zip(("early", "median", "late"), map(finite, found.reached_s(limit_c)), strict=True)),
            "longest_s": finite(found.longest_s(limit_c)),
            "safe_start_k": finite(found.safe_start_k(limit_c)),
        }
        for limit_c in LIMITS_C
    ]


def limit_table(found: ThermalForecast) -> Table:
    """Probability and time of reaching each limit in the run, and the longest run below it."""
    least, simulated = 1.0 / SAMPLES, f"> {duration(float(found.time_s[-1]))}"
    rows = [
        (
            f"{each['limit_c']:g} °C",
            f"< {least:g}" if each["p"] < least else f"{each['p']:.2f}",
            *("–" if (s := each["reached_s"][name]) is None else duration(s) for name in ("early", "median")),
            simulated if each["longest_s"] is None else duration(each["longest_s"]),
        )
        for each in limits(found)
    ]
    head = ("limit", "P in the run", Column("earliest", words=True), Column("median", words=True), "longest run")
    note = f"Earliest: {100 * RISK:g} % quantile. Longest run: P(reaching the limit) is at most {100 * RISK:g} %."
    return Table(head=head, rows=tuple(rows), notes=(note,))


def card(found: ThermalForecast, so_far: Recording, origin: Mapping[str, str]) -> dict[str, Any]:
    """The numbers of a forecast as JSON, and from what they were made."""
    low, middle, high = found.interval()
    courses = {"low_c": low, "median_c": middle, "high_c": high}
    return {
        "origin": dict(origin),
        "run_s": found.run_s,
        "cycle_s": found.cycle_s,
        "residual_k": np.round(found.residual_k, 3).tolist(),
        "distance_sd": round(found.distance_sd, 3),
        "unlike": [*found.unlike.doubts],
        "way_back_rad": round(found.way_back_rad, 3),
        "now_c": so_far_c(so_far).tolist(),
        "limits": limits(found),
        "time_s": found.time_s[found.in_run].tolist(),
        **{name: np.round(values, 3).tolist() for name, values in courses.items()},
    }


def page(found: ThermalForecast, so_far: Recording, repetitions: int, origin: Mapping[str, str]) -> str:
    """The page as HTML, which opens offline."""
    section = Section(
        key="forecast",
        title="Motor temperatures",
        sentences=tuple(summary(found, so_far, repetitions)),
        how="Curves are measured temperatures before 0 min and medians of the forecast after it. The shaded band is "
        "the 95 % interval of the hottest motor.",
        charts=(_chart(found, so_far),),
        tables=(limit_table(found), joint_table(found, so_far)),
    )
    title = f"Thermal forecast after {so_far.name}"
    return Page(title=title, sections=[section], origin=origin_table(origin)).html()


def _chart(found: ThermalForecast, so_far: Recording) -> Chart:
    """Measured temperatures, and the forecast with the interval of the hottest motor, over minutes from now."""
    low, middle, high = found.interval()
    hottest = int(middle[-1].argmax())
    measured = so_far.part(so_far.time_s >= so_far.time_s[-1] - max(found.run_s, 30 * MINUTE_S))
    assert measured.temp_c is not None, "a forecast starts from temperatures"
    ahead = found.time_s[found.in_run] / MINUTE_S
    minutes = np.append((measured.time_s - so_far.time_s[-1]) / MINUTE_S, ahead)
    temp_c = np.concatenate([measured.temp_c, middle])
    name, colour = f"95 % interval of joint {hottest + 1}", charts.JOINT_LINES[hottest][0]
    data = [charts.band(ahead, low[:, hottest], high[:, hottest], colour, name=name)]
    for j, (colour, dash) in enumerate(charts.JOINT_LINES):
        look = {"color": colour, "dash": dash, "width": 2.5 if j == hottest else 1.3}
        data.append(charts.curve(f"joint {j + 1}", minutes, temp_c[:, j], look, most=MOST_POINTS))
    lines, labels = charts.limit_lines(ThermalLimits())
    now = {
        "type": "line",
        "x0": 0,
        "x1": 0,
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "line": {"color": charts.INK, "width": 1},
    }
    shown_c = charts.range_c(np.concatenate([measured.temp_c, high]), ThermalLimits())
    layout = charts.WITH_LEGEND | {
        "margin": charts.MARGIN | {"r": charts.LIMITS_PX, "t": 60},
        "xaxis": charts.axis("minutes from the end of the log"),
        "yaxis": charts.axis("motor temperature, °C", range=shown_c),
        "shapes": [*lines, now],
        "annotations": labels,
    }
    alt = f"Motor temperatures before and in the run; joint {hottest + 1} ends at {middle[-1, hottest]:.1f} °C"
    return Chart(key="forecast_chart", figure={"data": data, "layout": layout}, alt=alt)
