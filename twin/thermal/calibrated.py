"""A learned twin with a predicted peak and P(saturation): what scores the plans of an arm."""

from dataclasses import dataclass

import numpy as np

from fleet.difficulty import Difficulty
from fleet.motion import Plan
from twin.saturation.model import SaturationModel
from twin.thermal.thermal_twin import RcTwin
from twin.vae.twin import Twin


@dataclass(frozen=True, eq=False)
class CalibratedTwin:
    """A twin with P(saturation); implements `fleet.difficulty.DifficultyModel`."""

    twin: Twin
    """Gives the difficulty d."""
    heat: RcTwin
    """Gives the predicted peak and, if it has a curve and there is no other model, P(saturation)."""
    saturation: SaturationModel | None = None
    """Gives P(saturation) from the features of the twin."""

    def __post_init__(self) -> None:
        if self.saturation is not None and self.saturation.twin != self.twin.version:
            raise ValueError(
                f"The saturation model was fitted on twin {self.saturation.twin}, this is {self.twin.version}; "
                "fit it again on this twin's features."
            )

    @property
    def version(self) -> str:
        """Versions of the models that give difficulty, predicted peak, and P if it is another one."""
        parts = {"d": self.twin.version, "peak": self.heat.version}
        if self.saturation is not None:
            parts["p"] = f"{self.saturation.evidence}-{self.saturation.version}"
        return "+".join(f"{name}:{version}" for name, version in parts.items())

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty, predicted peak and risk of the repeated plan."""
        features = self.twin.features([plan], [repetitions])
        risk = None
        if self.saturation is not None:
            risk = self.saturation.risk(features, np.array([plan.duration_s(repetitions)]))[0]
        peak = self.heat.peak(plan, repetitions)
        return Difficulty(features.difficulty[0], risk=risk, peak=peak, weight=self.twin.joint_weight)
