"""Tables and sentences of `thermofleet layout`."""

from rich.table import Table
from rich.text import Text

from scenarios.report.layout import SEARCH_S, LayoutReport
from scenarios.schema import Scenario

WORST = 8
"""Pairs of jobs in the table of exclusions."""


def layout_tables(scenario: Scenario, report: LayoutReport) -> list[Table | Text]:
    """Reach matrix, reasons, exclusions, and the most arms at work at once."""
    arms = [arm.name for arm in scenario.arms]
    reach = {(entry.place, entry.arm): entry for entry in report.reach}
    matrix = text_table("place", *arms)
    for place in scenario.places:
        matrix.add_row(place.name, *(_payload(reach[place.name, arm].payload_kg) for arm in arms))
    reasons = text_table("cannot do", "reason")
    for entry in report.reach:
        if entry.reason:
            reasons.add_row(f"{entry.arm} at {entry.place}", entry.reason)
    shared = [pair for pair in report.exclusions if not pair.same_place]
    pairs = text_table("job", "excludes", "share of plans")
    for pair in shared[:WORST]:
        one, other = (f"{job}, {arm}" for job, arm in zip(pair.jobs, pair.arms, strict=True))
        pairs.add_row(one, other, f"{pair.share:.0%}")
    most = ", ".join(f"{work.arm} {work.job}" for work in report.at_once)
    always = sum(pair.share == 1 for pair in shared)
    return [
        Text(f"{scenario.name}: heaviest payload (kg) of the jobs that an arm can do at a place; –: it can do none"),
        matrix,
        Text(""),
        reasons,
        Text(""),
        Text(
            f"{report.excluded_share:.0%} of the pairs of plans of two arms come closer than "
            f"{report.clearance_m * 1e3:g} mm and exclude each other. Pairs of jobs at different "
            f"stations: {always} exclude each other always, {len(shared) - always} for some plans"
            + (f". The first {WORST}:" if len(shared) > WORST else ":" if shared else ".")
        ),
        *([pairs] if shared else []),
        Text(""),
        Text(
            f"{'At most' if report.largest else 'At least'} {len(report.at_once)} of {len(arms)} arms can work at once"
            + (f", for example {most}." if most else ".")
            + ("" if report.largest else f" The search for more ended after {SEARCH_S:g} s.")
        ),
    ]


def _payload(payload_kg: float | None) -> str:
    return "–" if payload_kg is None else f"{payload_kg:g}"


def text_table(*columns: str) -> Table:
    """An empty table without lines, whose cells are folded."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table
