"""The tables of docs/scaling.md: what is calculated is current, and asking all arms is the limit of asking few."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scaling import ask, load

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "scaling.md").read_text(encoding="utf-8")


def numbers(row):
    return [cell.strip().strip("*").replace(" ", "") for cell in row.strip("|").split("|")]


def test_the_page_has_the_calculated_loads():
    rows = [numbers(row) for row in re.findall(r"^\| [\d ]+, \d+ \|.*\|$", PAGE, re.MULTILINE)]
    assert len(rows) == 8
    for who, state_hz, asked, *stated in rows:
        arms, sites = map(int, who.split(","))
        at = load.load_of(arms, sites, state_hz=float(state_hz), asked=0 if asked == "all" else int(asked))
        cores = at.hub_router * load.COSTS.forward_s
        calculated = (
            at.site_router, at.hub_router, at.hub_mb, cores, at.auctioneer, at.full_round_s, at.recorder_gb,
            at.journal_mb,
        )  # fmt: skip
        assert [float(text) for text in stated] == pytest.approx(calculated, rel=0.04, abs=0.006)


def test_the_load_of_states_follows_from_their_number():
    """Without jobs to speak of: hub = one in and two out (auctioneer, recorder), and lease queries."""
    slow, fast = (load.load_of(1000, 10, state_hz=hz, asked=1) for hz in (0.0, 10.0))
    assert fast.hub_router - slow.hub_router == pytest.approx(3 * 10_000)
    assert fast.site_router - slow.site_router == pytest.approx(2 * 10_000 / 10)
    assert fast.auctioneer - slow.auctioneer == pytest.approx(10_000 * load.COSTS.state_s)


def test_asking_as_many_as_there_are_is_asking_all():
    library = ask.large_cell(8, "blind")
    full, (few, one) = (
        next(iter(ask.shifts(library, [3], None, "random"))),
        [next(iter(ask.shifts(library, [3], asked, "random"))) for asked in (8, 1)],
    )
    assert few == full
    assert one[-1] == 1.0  # one quote a job
    assert full[-1] > 1.0
    assert np.isfinite(one).all()
