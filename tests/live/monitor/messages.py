"""Messages of an arm and an auctioneer, and a fleet of one arm that publishes them."""

from fleet.bus.protocol.auction import JobStatus, Result, Status
from fleet.bus.protocol.messages import State


def state(arm="a", time_s=1.0, **change):
    words = {"tick": 1, "mode": "idle", "temp_c": (30.0, 52.5, 40.0), "headroom_k": 7.5, **change}
    return State(arm=arm, time_s=time_s, **words)


def result(number, job="j", to="awarded"):
    return Result(auctioneer="au", number=number, time_s=1.0, status=JobStatus(job, to))


def stands(time_s, *jobs, state="finished"):
    return Status("au", time_s, tuple(JobStatus(job, state) for job in jobs))
