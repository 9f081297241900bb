"""Two linked routers under arms and auctioneer: killed, cut and healed, no job is lost or done twice."""

import pytest

from benchmarks.chaos.mesh import mesh

ARMS, JOBS = 4, 16


@pytest.mark.slow
def test_kill_either_router_and_cut_the_link(tmp_path):
    outcome = mesh(tmp_path, arms=ARMS, jobs=JOBS, speed=40.0)
    assert (outcome.lost, outcome.twice, outcome.exited, outcome.violations) == ((), (), (), ())
    assert outcome.finished + outcome.unfinished == JOBS
    assert outcome.finished >= JOBS - ARMS  # an unfinished job is one that an arm had when it was cut off
    assert all("inf" not in note for note in outcome.notes)  # all arms were present again after each fault
