"""Length of a training, and hyperparameters of that of networks."""

from dataclasses import dataclass, field, fields
from math import inf
from typing import Literal, get_args

from fleet.errors import FleetError
from fleet.fields import MAX_SEED, check, option

Algorithm = Literal["mappo", "ippo"]
Decisions = Literal["interval", "events"]
"""As in `fleet.env.allocation_v2`, which agents do not import."""
LONGEST_S = 1e7
"""Longest horizon of a discount, 116 days."""


@dataclass(frozen=True, kw_only=True)
class NetworkSize:
    """Widths of the hidden layers."""

    arm: int = 48
    option: int = 48
    pair: int = 16

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise ValueError(f"NetworkSize.{name} must be >= 1 (got {value}).")


@dataclass(frozen=True, kw_only=True)
class TrainingLength:
    """Length of a training; subclasses add counts, which must be positive.

    Raises:
        FleetError: a number is not positive.
    """

    minutes: float = option(
        "Training time excluding the twins, min. With --resume: additional time; with --resume and --seeds: total of "
        "each training.",
        30.0,
        low=0,
        high=100_000,
        above=True,
    )
    iterations: int | None = option(
        "Maximum number of iterations in total, those before a resume included.", None, low=1, high=1_000_000
    )
    validate_every: int = 20
    """Iterations from one validation to the next."""
    in_total: bool = False
    """Whether `minutes` include those before a resume, too, and a complete training is skipped."""

    def __post_init__(self) -> None:
        try:
            check(self)
        except ValueError as error:
            raise FleetError(str(error)) from error
        for each in fields(self):
            value = getattr(self, each.name)
            if value is not None and each.name not in ("minutes", "iterations", "in_total") and value < 1:
                raise FleetError(f"{each.name} must be >= 1 (got {value}).")

    def share(self, iterations: int, seconds: float, before_s: float) -> float:
        """Finished share of a training; from 1 on it is complete.

        Args:
            iterations, seconds: Of all sessions.
            before_s: Time of the sessions before a resume.
        """
        spent_s = seconds - (0.0 if self.in_total else before_s)
        return max(spent_s / (60.0 * self.minutes), iterations / (self.iterations or inf))


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """Hyperparameters of a training."""

    algorithm: Algorithm = "mappo"
    size: NetworkSize = field(default_factory=NetworkSize)
    envs: int = option("Shifts simulated in parallel.", 32, low=1, high=65_536)
    steps: int | None = None
    """Steps of every env in an iteration; by default 16 with events, 128 with intervals."""
    epochs: int = 4
    """Passes of the actor over an iteration's choices; the critic makes one over all steps."""
    minibatch: int = 128
    """Choices in one optimiser step of the actor."""
    learning_rate: float = option(
        "Learning rate; default: 0.0003, with --suite 0.02.",
        3e-4,
        low=0,
        high=10,
        above=True,
        flag="--lr",
        shown="",
    )
    decisions: Decisions = option(
        "Length of a training step: events (until an arm has a choice) or interval.",
        "events",
        choices=get_args(Decisions),
        noun="kind of step",
    )
    """See `fleet.env.allocation_v2`."""
    discount_s: float = 7200.0
    """Horizon of the discount: gamma of a step is exp(-elapsed_s / discount_s)."""
    trace_s: float = 900.0
    """Horizon of the trace: lambda of a step is exp(-elapsed_s / trace_s). Longer than most jobs, so that the return of
    a claim contains the reward of its job."""
    clip: float = 0.2
    entropy: float = option("Weight of the entropy bonus; not with --suite.", 0.002, low=0, high=10)
    max_gradient: float = 0.5
    reward_scale: float = 0.1
    warm_start: str = option("Rule that the network imitates first, for example wspt; default: none.", "")
    seed: int = option("Seed for shifts, initialisation and minibatches.", 0, low=0, high=MAX_SEED)

    def __post_init__(self) -> None:
        check(self)
        if self.algorithm not in get_args(Algorithm):
            raise ValueError(f"algorithm must be one of {', '.join(get_args(Algorithm))} (got {self.algorithm!r}).")
        whole, positive = (
            ("steps", "epochs", "minibatch"),
            ("clip", "max_gradient", "reward_scale"),
        )
        values = vars(self) | {"steps": self.length}
        for names, allowed, valid in (
            (whole, ">= 1", lambda value: value >= 1),
            (positive, "> 0", lambda value: value > 0),
            (("discount_s", "trace_s"), f"1 to {LONGEST_S:g}", lambda value: 1 <= value <= LONGEST_S),
        ):
            for name in names:
                if not valid(values[name]):
                    raise ValueError(f"{name} must be {allowed} (got {values[name]}).")

    @property
    def length(self) -> int:
        """Steps of every env in an iteration."""
        if self.steps is not None:
            return self.steps
        return 16 if self.decisions == "events" else 128
