"""Two linked routers under arms and auctioneer: killed, cut and healed, no job is lost or done twice."""

import importlib
from pathlib import Path

import pytest

CHAOS = Path(__file__).parents[2] / "benchmarks" / "chaos"
ARMS, JOBS = 4, 16


@pytest.mark.parametrize("by", ["proxy", pytest.param("netns", marks=pytest.mark.slow)])
def test_kill_either_router_and_cut_the_link(by, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(CHAOS)
    if by == "netns" and (reason := importlib.import_module("namespaces").unavailable_reason()):
        pytest.skip(reason)
    mesh = importlib.import_module("mesh").mesh
    outcome = mesh(tmp_path, arms=ARMS, jobs=JOBS, speed=40.0, namespaces=by == "netns")
    assert outcome.by == by
    assert (outcome.lost, outcome.twice, outcome.exited, outcome.violations) == ((), (), (), ())
    assert outcome.finished + outcome.unfinished == JOBS
    assert outcome.finished >= JOBS - ARMS  # an unfinished job is one that an arm had when it was cut off
    assert all("inf" not in note for note in outcome.notes)  # all arms were present again after each fault
