"""Several runs side by side: one table of key figures, a chart of the main ones, and the hottest motors over time."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any  # values of Plotly's schema

from scenarios.run.records import ShiftLog
from scenarios.show.page import AXIS, LAYOUT, Chart, Figure, Section, named_rows, plain, sections_page
from scenarios.show.run_page import MAIN_FIGURES, figure_table, numbers, verdict
from scenarios.show.timeline import POLICY_LINES, STREAM_NAME, hottest_motors
from scenarios.table import Column, Table

BAR_PX, TITLE_PX = 24, 44
"""Height of a bar, and of the title and the gap above the bars of a figure."""


def runs_table(logs: Mapping[str, ShiftLog]) -> Table:
    """Settings, outcome and key figures, a column for each run by its name; "" for a figure that a run lacks."""
    settings = {
        "scenario": [str(log.card.get("scenario", {}).get("name", "")) for log in logs.values()],
        "policy": [log.policy for log in logs.values()],
        "seed": [str(log.card.get("seed", "")) for log in logs.values()],
        "predictions": [str(log.card.get("difficulty", "")) for log in logs.values()],
        "outcome": [verdict(log).badge for log in logs.values()],
    }
    figures = figure_table({name: log.card.get("metrics") or {} for name, log in logs.items()})
    rows = [(name, *cells) for name, cells in settings.items()]
    return replace(figures, rows=(*rows, *figures.rows))


def runs_page(logs: Mapping[str, ShiftLog]) -> str:
    """Runs by name as one HTML page that opens offline; the same runs give the same text."""
    table = runs_table(logs)
    same = [row[0] for row in table.rows[:4] if len(set(row[1:])) == 1]
    differ = [row[0] for row in table.rows[:4] if len(set(row[1:])) > 1]
    equal_jobs = {"scenario", "seed"} <= set(same)
    jobs = "All have the same jobs." if equal_jobs else "They have other jobs: their figures compare no policies."
    lead = (f"The runs differ in {', '.join(differ) or 'nothing'}. {jobs}",)
    main = Chart(key="main", figure=bars(logs), alt=f"Main figures of {', '.join(logs)}; the table has the numbers")
    sections = [Section(key="figures", title="Key figures", charts=(main,), tables=(table,))]
    if (
        equal_jobs
        and all(len(log.readings.time_s) for log in logs.values())
        and len({log.limits for log in logs.values()}) == 1
    ):
        chart = Chart(key="hottest", figure=hottest_motors(logs), alt=f"Hottest motor under {', '.join(logs)}")
        sections.append(Section(key="heat", title="Hottest motor of the fleet", charts=(chart,)))
    origin = Table(
        head=("run", "hash of the code", "hash of the scenario"),
        rows=tuple(
            (name, *(str(log.card.get(key, "")) for key in ("code_hash", "scenario_hash")))
            for name, log in logs.items()
        ),
        numbers=False,
    )
    title = f"{len(logs)} runs{f' of {table.rows[0][1]}' if 'scenario' in same else ''}"
    return sections_page(title, sections, origin, lead)


def bars(logs: Mapping[str, ShiftLog]) -> Figure:
    """The main figures one below the other, each with a bar for each run."""
    values = [numbers(log.card.get("metrics") or {}) for log in logs.values()]
    shown = [each for each in MAIN_FIGURES if any(each.name in own for own in values)]
    block_px = TITLE_PX + BAR_PX * len(logs)
    height_px = block_px * max(1, len(shown))
    names = [plain(name, STREAM_NAME) for name in logs]
    data, layout, titles = list[dict[str, Any]](), dict[str, Any](), list[dict[str, Any]]()
    for number, (label, name, form, unit, _) in enumerate(shown, start=1):
        top = 1 - ((number - 1) * block_px + TITLE_PX) / height_px
        own = [each.get(name) for each in values]
        text = [f"{value:{form}}" if value is not None else "" for value in own]
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}"}
        look = {"color": [POLICY_LINES[k % len(POLICY_LINES)][0] for k in range(len(names))]}
        data.append(
            {"type": "bar", "orientation": "h", "x": own, "y": list(range(len(own))), "text": text, "marker": look}
            | {
                "hovertemplate": "%{text}<extra></extra>",
                "textposition": "outside",
                "textangle": 0,
                "cliponaxis": False,
                **axes,
            }
        )
        layout[f"xaxis{number}"] = AXIS | {"anchor": f"y{number}", "rangemode": "tozero", "visible": False}
        domain = [max(0.0, top - BAR_PX * len(logs) / height_px), top]
        layout[f"yaxis{number}"] = named_rows(names, anchor=f"x{number}", domain=domain)
        place = {"x": 0, "xref": "paper", "xanchor": "left", "y": top, "yref": "paper", "yanchor": "bottom"}
        titles.append({"text": f"<b>{Column(label, unit)}</b>", "showarrow": False, **place})
    margin = {"l": 60, "r": 48, "t": 4, "b": 12}
    return {
        "data": data,
        "layout": LAYOUT
        | layout
        | {"height": height_px + 16, "margin": margin, "annotations": titles, "showlegend": False},
    }
