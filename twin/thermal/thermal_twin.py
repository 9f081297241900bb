"""The physical twin: an arm's thermal network, nominal or identified, which predicts motor temperatures of a plan.

It implements the same protocol as the learned twin, and also predicts temperatures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat

import numpy as np

from fleet.difficulty import Difficulty, Forecast, difficulty_of_error
from fleet.motion import Drive, Plan, drives
from fleet.motor import Motors
from fleet.robot import JOINTS, ThermalLimits
from fleet.thermal import HOUSING, NODES, STEP_S, WINDING, ThermalModel, node_heat, temperature_steps
from twin.thermal.parameters import HeatModel
from twin.thermal.result import AMBIENT_C, Identified, nominal_heat_model
from twin.thermal.risk import MarginHead, Pieces, affine_margins, fit_head
from twin.vae.window import check_jobs

Array = np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class RcTwin:
    """One arm's resistance-capacitance network as a twin; implements `fleet.difficulty.DifficultyModel`.

    d_k = 1 − exp(−rise_k / room_k): the predicted rise of motor k above its idle temperature over the room from there
    to the warning limit.
    """

    arm: str
    heat_model: HeatModel
    ambient_c: float
    """Assumed ambient temperature."""
    base: str
    """Version of the nominal or identified network."""
    warning_c: float = ThermalLimits().warning_c
    head: MarginHead | None = None
    """From predicted margins to P(saturation); None without past jobs."""

    @classmethod
    def nominal(cls, arm: str = "arm", *, ambient_c: float = AMBIENT_C) -> "RcTwin":
        """A Gen3 by the project's defaults, in still air."""
        return cls(arm=arm, heat_model=nominal_heat_model(), ambient_c=ambient_c, base="rc-nominal")

    @classmethod
    def of(cls, identified: Identified) -> "RcTwin":
        """The twin of an identified arm."""
        shared = {name: getattr(identified, name) for name in ("arm", "heat_model", "ambient_c")}
        return cls(base=identified.version, **shared)

    @property
    def version(self) -> str:
        """Names parameters, ambient temperature and limit, and the head if there is one."""
        return f"{self.base}-{self.ambient_c:g}-{self.warning_c:g}" + (f"-{self.head.name}" if self.head else "")

    @property
    def motors(self) -> Motors:
        """The arm's motors."""
        return self.heat_model.motors

    @cached_property
    def thermal(self) -> ThermalModel:
        """The arm's network as matrices."""
        return self.heat_model.thermal()

    @cached_property
    def idle_c(self) -> Array:
        """Steady temperatures of the powered arm without load, °C, [node]."""
        return self.thermal.steady(node_heat(np.zeros(JOINTS), self.motors.idle_w), self.ambient_c)

    def likely_start(self, temp_c: Array) -> Array:
        """Node temperatures for measured motor temperatures, °C, [..., joint] to [..., node].

        Housings have no sensor and are taken as warm as their windings: true after some minutes of rest, cautious right
        after work. `twin.thermal.kalman.filter_log` estimates them better from a log.
        """
        return np.concatenate([temp_c, temp_c], axis=-1)

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of the repeated plan; with a head also its risk as a function of the temperatures now.

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
        load, duration_s = self._mean_drive(plans, repetitions)
        return self.simulate(load, duration_s, start_c)[..., WINDING].max(axis=0)

    def simulate(self, load: Drive, duration_s: Array, start_c: Array) -> Array:
        """Node temperatures under constant drives [job, joint], °C, [step + 1, job, node].

        Every job has the same number of steps, equal within it, at most `fleet.thermal.STEP_S` long.
        """
        steps = max(1, int(np.ceil(np.max(duration_s, initial=0.0) / STEP_S)))
        rows = temperature_steps(
            repeat(load, steps),
            np.asarray(duration_s, dtype=float) / steps,
            motors=self.motors,
            thermal=self.thermal,
            start_c=np.broadcast_to(start_c, (len(duration_s), NODES)).astype(float),
            ambient_c=self.ambient_c,
        )
        return np.stack(list(rows))

    def predict(self, plan: Plan, repetitions: int, start_c: Array) -> tuple[Array, Array]:
        """Motor temperatures during a job: approach, cycles and retreat, each with its own mean heat.

        Args:
            start_c: Measured motor temperatures [joint], or estimates of all nodes [node].

        Returns:
            Time since the start, s, [time], and temperatures, °C, [time, joint].
        """
        self._check([plan], [repetitions])
        temp = self.likely_start(start_c) if len(start_c) == JOINTS else np.asarray(start_c, dtype=float)
        if temp.shape != (NODES,):
            raise ValueError(f"start_c must be [{JOINTS}] or [{NODES}] (got shape {np.shape(start_c)}).")
        times, temps, now_s = [np.zeros(1)], [temp[None]], 0.0
        for phase, count in zip(plan.phases, (1, repetitions, 1), strict=True):
            lasts_s = phase.duration_s * count
            if lasts_s == 0:
                continue
            part = self.simulate(drives([phase.profile], self.motors), np.array([lasts_s]), temps[-1][-1])[:, 0]
            times.append(now_s + lasts_s * np.arange(1, len(part)) / (len(part) - 1))
            temps.append(part[1:])
            now_s += lasts_s
        return np.concatenate(times), np.concatenate(temps)[:, WINDING]

    def pieces(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> list[Pieces]:
        """Margins of each job as affine functions of the motor temperatures at its start, one per plan."""
        load, duration_s = self._mean_drive(plans, repetitions)
        return affine_margins(
            load,
            duration_s,
            magnets_c=self.simulate(load, duration_s / 2.0, self.idle_c)[-1][:, HOUSING],
            motors=self.motors,
            thermal=self.thermal,
            ambient_c=self.ambient_c,
            idle_c=self.idle_c[WINDING],
            limit_c=self.warning_c,
            start_of_windings=self.likely_start(np.eye(JOINTS)).T,
        )

    def with_past_jobs(
        self, plans: Sequence[Plan], repetitions: Sequence[int], *, temp_c: Array, passed: Array
    ) -> "RcTwin":
        """The same twin with P(saturation) fitted on past jobs.

        Args:
            temp_c: Motor temperatures measured at the start, [job, joint].
            passed: Whether some motor passed the limit, bool [job].

        Raises:
            NotEnoughExperience: too few jobs, or hardly any of one kind.
        """
        margin = np.array([p.margin(t) for p, t in zip(self.pieces(plans, repetitions), temp_c, strict=True)])
        return replace(self, head=fit_head(margin, passed))

    def risk(self, plan: Plan, repetitions: int) -> Forecast:
        """P(saturation) of a job for any measured temperatures at its start.

        Raises:
            ValueError: the twin was fitted on no past jobs.
        """
        if self.head is None:
            raise ValueError(f"The rc twin of '{self.arm}' has no P(saturation) yet; call RcTwin.with_past_jobs first.")
        return self.head.risk(self.pieces([plan], [repetitions])[0])

    def _mean_drive(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> tuple[Drive, Array]:
        """Mean drive of each job over its whole time, [job, joint], and its duration, s, [job]."""
        self._check(plans, repetitions)
        square, friction = np.zeros((2, len(plans), JOINTS))
        for i, (plan, times) in enumerate(zip(plans, repetitions, strict=True)):
            share, phases = plan.weights(times), drives([phase.profile for phase in plan.phases], self.motors)
            square[i], friction[i] = share @ phases.current_sq, share @ phases.friction_w
        duration_s = [plan.duration_s(times) for plan, times in zip(plans, repetitions, strict=True)]
        return Drive(square, friction), np.array(duration_s, dtype=float)

    def _check(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> None:
        check_jobs(plans, repetitions, least=0)
        for plan in plans:
            if plan.cycle.profile.shape[-1] != JOINTS:
                raise ValueError(f"The thermal network has {JOINTS} joints (got {plan.cycle.profile.shape[-1]}).")
