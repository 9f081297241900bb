"""Figures of a live fleet in the text format of Prometheus (exposition format 0.0.4), at `/metrics` of the gateway."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import product
from typing import get_args

from fleet.bus.protocol.auction import JobState
from fleet.live.job_rules import waits_since_s
from fleet.live.monitor.health import ALARM_KINDS, OTHER, REASONS, reason_class
from fleet.live.monitor.snapshot import FleetSnapshot, bids_of

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
METRICS: Mapping[str, tuple[str, str]] = {
    "jobs": ("gauge", "Jobs by state."),
    "job_changes_total": (
        "counter",
        "Changes of jobs to a state, as an auctioneer publishes them, cached ones included.",
    ),
    "waiting_jobs": ("gauge", "Waiting jobs by class of reason."),
    "oldest_waiting_seconds": (
        "gauge",
        "Fleet seconds for which the oldest released job waits; 0 without one.",
    ),
    "bids": ("gauge", "Waiting jobs for which an arm has a bid."),
    "arm_events_total": (
        "counter",
        "Events of an arm by kind, such as award, finish and fault, cached ones included.",
    ),
    "motor_temperature_celsius": ("gauge", "Temperature of a motor."),
    "headroom_kelvin": ("gauge", "From the hottest motor of an arm to its warning limit."),
    "p_saturation": ("gauge", "P that a motor passes the warning limit in the rest of the current job of an arm."),
    "work_seconds_total": ("counter", "Fleet seconds of work of an arm since the gateway began."),
    "heat_total": ("counter", "Sum of squared motor torques of an arm over fleet time, N²m²s."),
    "present": ("gauge", "Whether an arm shows its token and a fresh state."),
    "silence_seconds": ("gauge", "Real seconds since the last message of a participant."),
    "alarms": ("gauge", "Alarms that last, by kind and whether somebody has acknowledged them."),
    "fleet_speed": ("gauge", "Fleet seconds per real second."),
}
"""Type and help of each metric; names begin with `thermofleet_`."""
Sample = tuple[str, dict[str, str], float | None]


def exposition(fleet: FleetSnapshot, alarms: Counter[tuple[str, str]]) -> str:
    """The metrics of a fleet; what is unknown has no sample.

    Args:
        alarms: Number of those that last, by kind and "yes" or "no" for acknowledged.
    """
    lines: dict[str, list[str]] = {name: [] for name in METRICS}
    for name, labels, value in samples(fleet, alarms):
        if value is not None and math.isfinite(value):
            shown = ",".join(f'{key}="{_escaped(text)}"' for key, text in {"fleet": fleet.fleet, **labels}.items())
            lines[name].append(f"thermofleet_{name}{{{shown}}} {value:.10g}")
    return "".join(
        f"# HELP thermofleet_{name} {text}\n# TYPE thermofleet_{name} {kind}\n"
        + "".join(f"{line}\n" for line in lines[name])
        for name, (kind, text) in METRICS.items()
    )


def samples(fleet: FleetSnapshot, alarms: Counter[tuple[str, str]]) -> Iterable[Sample]:
    """Name, labels and value of every sample; arguments as of `exposition`."""
    for state in get_args(JobState):
        yield "jobs", {"state": state}, fleet.counts.get(state, 0)
        yield "job_changes_total", {"state": state}, fleet.changes.get(state, 0)
    waiting = [status for status in fleet.jobs if status.state == "waiting"]
    names = {status.job for status in waiting}
    reasons = Counter(reason_class(status.reason) for status in waiting)
    for reason in dict.fromkeys((*REASONS.values(), OTHER)):
        yield "waiting_jobs", {"reason": reason}, reasons[reason]
    if (now_s := fleet.time_s) is not None:
        since_s = [since_s for status in waiting if (since_s := waits_since_s(status)) is not None]
        yield "oldest_waiting_seconds", {}, max(0.0, now_s - min(since_s, default=now_s))
    for arm in fleet.arms:
        own = {"arm": arm.arm}
        yield "bids", own, bids_of(arm, names)
        yield from (("arm_events_total", {**own, "kind": kind}, count) for kind, count in arm.events.items())
        yield from (
            ("motor_temperature_celsius", {**own, "joint": str(joint)}, temp_c)
            for joint, temp_c in enumerate(arm.temp_c, start=1)
        )
        yield "headroom_kelvin", own, arm.headroom_k
        yield "p_saturation", own, arm.p_saturation
        yield "work_seconds_total", own, arm.worked_s
        yield "heat_total", own, arm.heat_n2m2s
        yield "present", own, arm.present
        yield "silence_seconds", {"participant": arm.arm, "role": "arm"}, arm.state_age_s
    for auctioneer in fleet.auctioneers:
        labels = {"participant": auctioneer.auctioneer, "role": "auctioneer"}
        yield "silence_seconds", labels, auctioneer.heard_age_s
    for kind, acknowledged in product(ALARM_KINDS, ("no", "yes")):
        yield "alarms", {"kind": kind, "acknowledged": acknowledged}, alarms[kind, acknowledged]
    yield "fleet_speed", {}, fleet.speed


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")
