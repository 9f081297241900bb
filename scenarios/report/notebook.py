"""Results as a notebook shows them: HTML without a page around it."""

from collections.abc import Mapping, Sequence
from typing import Any  # values of run.json

from fleet.events import Event
from scenarios.report.page import escape, paragraph
from scenarios.report.run_page import key_figures
from scenarios.report.schedule import schedule
from scenarios.report.verdict import verdict
from scenarios.shift_records import Offer

_STYLE = "<style>.thermofleet dl{display:flex;flex-wrap:wrap;gap:.4em 1.6em}.thermofleet dd{margin:0}</style>"


def run_html(run: Mapping[str, Any], events: Sequence[Event], offers: Sequence[Offer]) -> str:
    """A run in words, and its key figures.

    Args:
        run: Content of `run.json`.
        events: In order of time.
        offers: What each arm knew at each award.
    """
    arms = [arm["name"] for arm in run["scenario"]["arms"]]
    told = verdict(run, events, schedule(events, arms, run["time_s"]), offers)
    title = f"{run['scenario']['name']} · {run['policy']} · seed {run['seed']}"
    return (
        f'{_STYLE}<div class="thermofleet"><p><b>{escape(title)}</b>: {escape(told.badge)}</p>'
        f"{''.join(paragraph(sentence) for sentence in told.sentences)}{key_figures(run['metrics'])}</div>"
    )
