"""Recorded shifts that are put together from events, jobs and offers."""

from dataclasses import replace
from typing import Any

import numpy as np

from fleet.events import Event
from fleet.robot import ThermalLimits
from fleet.telemetry import Telemetry
from scenarios.run.records import JobRecord, Offer, ShiftLog


def telemetry(samples: int = 7200, arms: int = 2) -> Telemetry:
    """Temperatures that wander; everything else is still."""
    rng = np.random.default_rng(0)
    joints = np.zeros((samples, arms, 7))
    temp_c = 40.0 + np.cumsum(rng.normal(0, 0.05, joints.shape), axis=0)
    return Telemetry(
        time_s=np.arange(1.0, samples + 1),
        mode=np.zeros((samples, arms), dtype=int),
        q=joints,
        qd=joints,
        tau=joints,
        current_a=joints,
        temp_c=temp_c,
    )


def log_of(
    readings: Telemetry, arms: tuple[str, ...], events: tuple[Event, ...] = (), card: dict[str, Any] | None = None
) -> ShiftLog:
    limits = ThermalLimits(warning_c=60.0, error_c=75.0)
    return ShiftLog(card=card or {}, arms=arms, limits=limits, readings=readings, events=events)


def shift(
    *events: Event,
    temp_c: float | None = None,
    samples: int = 1000,
    arms: tuple[str, ...] = ("arm_a", "arm_b"),
    card: dict[str, Any] | None = None,
    **fields: Any,
) -> ShiftLog:
    """A shift with a reading a second, with one temperature of all motors if it is given, and `fields` of its log."""
    readings = telemetry(samples, len(arms))
    if temp_c is not None:
        readings = replace(readings, temp_c=np.full(readings.temp_c.shape, temp_c))
    return replace(log_of(readings, arms, events, card), **fields)


def event(time_s, kind, arm="arm_a", job="crate", **more):
    return Event(time_s=time_s, kind=kind, arm=arm, job=job, **more)


def record(job: str, due_s: float, state: str = "finished", value: float = 1.0) -> JobRecord:
    done_s = due_s if state == "finished" else None
    return JobRecord(
        job=job, state=state, release_s=0.0, due_s=due_s, finished_s=done_s, value=value, payload_kg=0.0, cycles=1
    )


def done(job: str, begin_s: float, end_s: float, late_s: float = 0.0, arm: str = "arm_a") -> tuple[Event, ...]:
    return (
        event(begin_s, "award", arm, job),
        event(end_s, "finish", arm, job, value=late_s),
        event(end_s, "home", arm, job),
    )


def offered(job: str, time_s: float, length_s: float) -> Offer:
    how = {"awarded": True, "state": "idle", "feasible": True, "free": True, "difficulty": None, "peak_c": None}
    return Offer(time_s=time_s, job=job, arm="arm_a", p_saturation=None, duration_s=length_s, **how)  # pyright: ignore[reportArgumentType]


def row_of_table(name: str, *after: str, kind: str = "sort") -> dict[str, Any]:
    return {"name": name, "kind": kind, "places": [["a", "b"]], "payload_kg": [0.2], "after": list(after)}


IN_ORDER = {"jobs": [row_of_table("A1"), row_of_table("A2", "A1")]}
