"""Interface of the body of an arm: motion, heat and sensors, simulated or replayed."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fleet.events import Event
from fleet.job import Job
from fleet.motion import Plan
from fleet.telemetry import Mode

Array = np.ndarray


@dataclass(frozen=True)
class SensorReading:
    """Sensor values of one arm; empty where there is no sensor."""

    mode: Mode
    temp_c: tuple[float, ...]
    """Motor temperatures, [joint]."""
    q: tuple[float, ...] = ()
    """rad, [joint]."""
    qd: tuple[float, ...] = ()
    """rad/s, [joint]."""
    tau: tuple[float, ...] = ()
    """N·m, [joint]."""
    current_a: tuple[float, ...] = ()
    """[joint]."""


class Body(Protocol):
    """Executes its current job as fleet time passes, up to the cycles that it is allowed."""

    @property
    def time_s(self) -> float:
        """Simulated up to this fleet time."""
        ...

    @property
    def job(self) -> str:
        """Name of the current job; "" for none."""
        ...

    @property
    def is_free(self) -> bool:
        """Whether it is at home, not faulted, and without a job."""
        ...

    @property
    def away(self) -> Plan | None:
        """Plan along which it is away from home, also where a fault stopped it; None at home."""
        ...

    @property
    def housing_c(self) -> Array:
        """Estimated housing temperatures, which have no sensor, °C, [joint]."""
        ...

    @property
    def cycles(self) -> int:
        """Cycles of the current job that are done, by any arm."""
        ...

    def last_cycle_in_s(self) -> float:
        """Seconds until the last cycle of the current job could begin; inf without a job."""
        ...

    def free_in_s(self) -> float:
        """Seconds until it could be free if it may do all of the current job; inf while it is faulted."""
        ...

    def start(self, job: Job, plan: Plan, cycles: int) -> None:
        """Take a job of which `cycles` are done; it must be free. Nothing moves before `allow_cycles`."""
        ...

    def allow_cycles(self, cycles: int) -> None:
        """Limit the cycles of the current job that may be begun, including those done; one in progress is finished."""
        ...

    def clear_fault(self) -> str:
        """Clear a fault at once, if it may be; return why it may not, or ""."""
        ...

    def release(self) -> None:
        """Finish the cycle, return home, release the job."""
        ...

    def advance(self, until_s: float) -> list[Event]:
        """Simulate up to a fleet time, or part of the way, and return the events; `finish` and `return` end the job."""
        ...

    def set_time(self, time_s: float) -> None:
        """Set the fleet time without advancing."""
        ...

    def set_step(self, dt_s: float) -> None:
        """Set the interval at which the body is read, fleet seconds."""
        ...

    def read_sensors(self) -> SensorReading:
        """Return the present sensor values."""
        ...
