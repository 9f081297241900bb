"""A recorded shift for files of other viewers: moments, poses of links, motors, payloads, and events in words."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any  # plain values of a cell model

import numpy as np

from fleet.arm.cell import HOT_MOTOR_M, MOTOR_M
from fleet.env.render.heat import heat_colour, heat_marks
from fleet.job import payload_radius_m
from fleet.robot import ThermalLimits
from scenarios.run.log import RunLog
from scenarios.show.page import HEAT_STEP_S
from scenarios.show.words import SEVERITY, event_text, joined_breaks, offers_text

Array = np.ndarray

MOST_POSES, MOST_HEATS = 250_000, 40_000
"""Postures and sets of temperatures of one arm in a file; longer shifts of larger fleets keep fewer moments by default,
so that a file stays below 100 MB."""


def motor_drums(temp_c: Array, limits: ThermalLimits) -> tuple[Array, Array]:
    """Colours (RGB from 0 to 1, [..., 3]) and radii (m, [...]) of motors at temperatures in °C, [...]."""
    coolest_c = heat_marks(limits.warning_c, limits.error_c)[0]
    heat = np.clip((temp_c - coolest_c) / (limits.error_c - coolest_c), 0.0, 1.0)
    colours = heat_colour(temp_c, limits.warning_c, limits.error_c)
    return colours, MOTOR_M + heat * (HOT_MOTOR_M - MOTOR_M)


@dataclass(frozen=True)
class LogLine:
    """A line of the log."""

    time_s: float
    severity: str
    """info, warning or error."""
    arm: str
    """"" for none; several in words."""
    text: str


class Moments:
    """A recorded shift at equally spaced moments.

    Args:
        every_s: Time between two poses; by default the samples of the run, or as few as keep the file small.
    """

    def __init__(self, run: RunLog, every_s: float | None = None) -> None:
        time_s = run.readings.time_s
        self.run, self.limits = run, run.limits
        self.model: Mapping[str, Any] = run.cell_model()
        self.sample_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
        wanted = 1 if every_s is None else round(every_s / self.sample_s)
        size, free = run.readings.mode.size, every_s is None
        stride = max(1, wanted, -(-size // MOST_POSES) if free else 1)
        heat = max(stride, round(HEAT_STEP_S / self.sample_s), -(-size // MOST_HEATS) if free else 1)
        self.pose_s = stride * self.sample_s
        self.poses = np.arange(0, len(time_s), stride)
        """Samples of which the postures are kept."""
        self.heats = np.arange(0, len(time_s), heat)
        """Samples of which the temperatures are kept."""

    @property
    def joint_links(self) -> list[int]:
        """Index of the link that each joint turns."""
        return [i for i, link in enumerate(self.model["links"]) if link["turns"]]

    def link_quaternions(self, q: Array) -> Array:
        """Rotation of each link in its parent's frame, w, x, y, z, [..., link, 4], at angles [..., joint] in rad."""
        links = self.model["links"]
        fixed = np.array([link["quaternion"] for link in links])
        half = np.zeros((*q.shape[:-1], len(links)))
        half[..., self.joint_links] = q / 2
        cos, sin = np.cos(half), np.sin(half)
        w, x, y, z = fixed.T
        return np.stack([w * cos - z * sin, x * cos + y * sin, y * cos - x * sin, z * cos + w * sin], axis=-1)

    @cached_property
    def payload_m(self) -> Array:
        """Radius of the ball in each hand, m, [sample, arm]; 0 without a payload."""
        load_kg = self.run.load_kg
        sizes = {kg: payload_radius_m(kg) for kg in np.unique(load_kg).tolist()}
        return np.vectorize(sizes.__getitem__, otypes=[float])(load_kg)

    def jobs(self, arm: str, time_s: Array) -> list[str]:
        """Job of an arm at each time; "" for none."""
        names = [""] * len(time_s)
        for work in self.run.plan.assignments:
            if work.arm == arm:
                begin, end = np.searchsorted(time_s, (work.start_s, work.end_s))
                names[begin:end] = [work.job] * (end - begin)
        return names

    def log(self) -> Iterator[LogLine]:
        """Events in order of time, a break of several arms as one; an award is followed by what each arm offered."""
        offers = {
            key: list(group)
            for key, group in groupby(self.run.known_offers, key=lambda offer: (offer.time_s, offer.job))
        }
        for event in sorted(joined_breaks(self.run.events, self.run.arms), key=lambda event: event.time_s):
            yield LogLine(event.time_s, SEVERITY.get(event.kind, "info"), event.arm, event_text(event))
            if event.kind == "award" and (made := offers.get((event.time_s, event.job))):
                made.sort(key=lambda offer: (not offer.awarded, offer.arm))
                yield LogLine(event.time_s, "info", "", f"offers for {event.job}: {offers_text(made)}")


def ahead(pose: Mapping[str, Any], distance_m: float) -> list[float]:
    """The point at a distance along a pose's z axis."""
    w, x, y, z = pose["quaternion"]
    axis = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return [p + distance_m * a for p, a in zip(pose["position"], axis, strict=True)]
