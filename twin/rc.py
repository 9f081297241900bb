"""The physical twin: an arm's thermal network, nominal or identified, asked what a plan would do to the motors.

It implements the same protocol as the learned twin, and says besides what that one cannot: temperatures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fleet.difficulty import Difficulty, Risk, difficulty_of_error
from fleet.motion import Drive, Plan, drive
from fleet.motor import Motors
from fleet.robot import JOINTS, ThermalLimits
from fleet.thermal import HOUSING, NODES, WINDING, ThermalModel, advance, drive_heat, node_heat
from twin.identified import AMBIENT_C, Identified, nominal_body
from twin.rc_risk import MarginHead, Pieces, fit_head, pieces
from twin.thermal_values import Body

Array = np.ndarray

STEP_S = 10.0
"""Heat follows the temperatures at least this often."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RcTwin:
    """One arm's thermal network as a twin; implements `fleet.difficulty.DifficultyModel`.

    d_k = 1 − exp(−rise_k / room_k): the predicted rise of motor k over its temperature after long idling, by the room
    from there to the warning limit. One is reached where the motor would pass the limit many times over.
    """

    arm: str
    body: Body
    ambient_c: float
    """Air that is assumed around the arm."""
    base: str
    """Version of what it was made from."""
    warning_c: float = ThermalLimits().warning_c
    head: MarginHead | None = None
    """Turns predicted margins into P(saturation); without one there is none."""

    @classmethod
    def nominal(cls, arm: str = "arm", *, ambient_c: float = AMBIENT_C) -> "RcTwin":
        """A Gen3 by the project's defaults, in still air."""
        return cls(arm=arm, body=nominal_body(), ambient_c=ambient_c, base="rc-nominal")

    @classmethod
    def of(cls, identified: Identified) -> "RcTwin":
        """The arm that its own logs told."""
        return cls(arm=identified.arm, body=identified.body, ambient_c=identified.ambient_c, base=identified.version)

    def with_head(self, head: MarginHead | None) -> "RcTwin":
        """The same twin with P(saturation) as it was learned before."""
        return replace(self, head=head)

    @property
    def version(self) -> str:
        """What produced the score: parameters, air and limit, and the head if there is one."""
        return f"{self.base}-{self.ambient_c:g}-{self.warning_c:g}" + (f"-{self.head.name}" if self.head else "")

    @property
    def motors(self) -> Motors:
        """The arm's motors."""
        return self.body.motors

    @cached_property
    def thermal(self) -> ThermalModel:
        """The arm's network as matrices."""
        return self.body.thermal()

    @cached_property
    def idle_c(self) -> Array:
        """Where the powered arm settles without load, °C, [node]."""
        return self.thermal.steady(node_heat(np.zeros(JOINTS), self.motors.idle_w), self.ambient_c)

    def likely_start(self, temp_c: Array) -> Array:
        """Node temperatures that go with measured motor temperatures, °C, [..., joint] to [..., node].

        Housings have no sensor; without a log of what was before they are taken as warm as their windings. That is so
        after some minutes of rest, and cautious right after work; `twin.observer.observe` knows better from a log.
        """
        return np.concatenate([temp_c, temp_c], axis=-1)

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of doing the plan so many times; with a head also how the risk depends on the temperatures now.

        Raises:
            ValueError: repetitions < 1, or a plan without motion or with other joints.
        """
        peak = self.peaks([plan], [repetitions], start_c=self.idle_c)[0]
        idle = self.idle_c[WINDING]
        rise = np.maximum(peak - idle, 0.0) / np.maximum(self.warning_c - idle, 1.0)
        # Beyond this 1 − exp(−e) rounds to one; d_k stays below it.
        per_joint = difficulty_of_error(np.minimum(rise, 30.0))
        return Difficulty(per_joint, risk=self.risk(plan, repetitions) if self.head else None)

    def peaks(self, plans: Sequence[Plan], repetitions: Sequence[int], *, start_c: Array) -> Array:
        """Hottest temperature of each motor during each job, °C, [plan, joint].

        Args:
            start_c: [node], or [plan, node]; `likely_start` makes it from measured temperatures.
        """
        load, duration = self._load(plans, repetitions)
        return self.course(load, duration, start_c)[..., WINDING].max(axis=0)

    def course(self, load: Drive, duration_s: Array, start_c: Array) -> Array:
        """Node temperatures under constant drives [job, joint], °C, [step + 1, job, node].

        Every job has the same number of steps, equal within it, at most `STEP_S` long.
        """
        steps = max(1, int(np.ceil(np.max(duration_s, initial=0.0) / STEP_S)))
        phi, gamma = self.thermal.step_matrices(np.asarray(duration_s, dtype=float) / steps)
        temp = np.broadcast_to(start_c, (len(duration_s), NODES)).astype(float)
        rows, air = [temp], np.full(len(duration_s), self.ambient_c)
        for _ in range(steps):
            heat_w = drive_heat(temp, load.current_sq, load.friction_w, self.motors)
            temp = advance(temp, heat_w, air, phi, gamma, self.thermal.to_ambient)
            rows.append(temp)
        return np.stack(rows)

    def predict(self, plan: Plan, repetitions: int, start_c: Array) -> tuple[Array, Array]:
        """Motor temperatures during a job.

        Args:
            start_c: Measured motor temperatures [joint], or those of all nodes [node] from an observer.

        Returns:
            Time since the start, s, [time], and temperatures, °C, [time, joint]; approach, cycles and retreat each
            with their own mean heat.
        """
        self._load([plan], [repetitions])  # for its checks
        temp = self.likely_start(start_c) if len(start_c) == JOINTS else np.asarray(start_c, dtype=float)
        if temp.shape != (NODES,):
            raise ValueError(f"start_c must be [{JOINTS}] or [{NODES}] (got shape {np.shape(start_c)}).")
        times, temps, now = [np.zeros(1)], [temp[None]], 0.0
        for phase, times_done in zip(plan.phases, (1, repetitions, 1), strict=True):
            lasts = phase.duration_s * times_done
            if lasts == 0:
                continue
            mean = drive(phase.profile, self.motors)
            load = Drive(mean.current_sq[None], mean.friction_w[None])
            part = self.course(load, np.array([lasts]), temps[-1][-1])[:, 0]
            times.append(now + lasts * np.arange(1, len(part)) / (len(part) - 1))
            temps.append(part[1:])
            now += lasts
        return np.concatenate(times), np.concatenate(temps)[:, WINDING]

    def pieces(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> list[Pieces]:
        """How each job's motor temperatures at some times depend on those measured before, one per plan."""
        load, duration = self._load(plans, repetitions)
        middle = self.course(load, duration / 2.0, self.idle_c)[-1]
        return pieces(self, load, duration, middle[:, HOUSING])

    def learned(self, plans: Sequence[Plan], repetitions: Sequence[int], *, temp_c: Array, passed: Array) -> "RcTwin":
        """The same twin with P(saturation) fitted on past jobs.

        Args:
            temp_c: Motor temperatures measured at the start, [job, joint].
            passed: Whether some motor passed the limit, bool [job].

        Raises:
            NotEnoughExperience: too few jobs, or hardly any of one kind.
        """
        margin = np.array([p.margin(t) for p, t in zip(self.pieces(plans, repetitions), temp_c, strict=True)])
        return self.with_head(fit_head(margin, passed))

    def risk(self, plan: Plan, repetitions: int) -> Risk:
        """P(saturation) of a job for any measured temperatures at its start.

        Raises:
            ValueError: the twin has learned from no past jobs.
        """
        if self.head is None:
            raise ValueError(f"The rc twin of '{self.arm}' has no P(saturation) yet; use RcTwin.learned first.")
        return self.head.risk(self.pieces([plan], [repetitions])[0])

    def _load(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> tuple[Drive, Array]:
        """Mean drive of each job over its whole time, [job, joint], and how long it takes, [job]."""
        square, friction, duration = [], [], []
        for plan, times in zip(plans, repetitions, strict=True):
            if times < 1:
                raise ValueError(f"A job has at least one repetition (got {times}).")
            if plan.duration_s(times) == 0:
                raise ValueError(f"The plan of arm '{plan.arm}' has no motion in it.")
            if plan.cycle.profile.shape[-1] != JOINTS:
                raise ValueError(f"The thermal network has {JOINTS} joints (got {plan.cycle.profile.shape[-1]}).")
            share = plan.weights(times)
            parts = [drive(phase.profile, self.motors) for phase in plan.phases]
            square.append(share @ np.array([part.current_sq for part in parts]))
            friction.append(share @ np.array([part.friction_w for part in parts]))
            duration.append(plan.duration_s(times))
        shape = (len(plans), JOINTS)
        return Drive(np.reshape(square, shape), np.reshape(friction, shape)), np.array(duration, dtype=float)
