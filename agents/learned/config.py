"""Length of a training, and hyperparameters of that of networks."""

from dataclasses import dataclass, field
from math import inf
from typing import Literal, get_args

from fleet.errors import FleetError
from fleet.fields import MAX_SEED, check, option

Algorithm = Literal["mappo", "ippo"]
Decisions = Literal["interval", "events"]
"""As in `fleet.env.allocation_v2`, which agents do not import."""


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
    """Length of a training, and its validation.

    Raises:
        FleetError: a number is out of its bounds.
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
    validate_every: int = option("Iterations from one validation to the next.", 20, low=1, high=1_000_000)
    in_total: bool = False
    """Whether `minutes` include those before a resume, too, and a complete training is skipped."""

    def __post_init__(self) -> None:
        try:
            check(self)
        except ValueError as error:
            raise FleetError(str(error)) from error

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

    algorithm: Algorithm = option(
        "mappo (one critic for the whole fleet) or ippo (one critic per arm).", "mappo", choices=get_args(Algorithm)
    )
    size: NetworkSize = field(default_factory=NetworkSize)
    envs: int = option("Shifts simulated in parallel; not with --suite.", 32, low=1, high=65_536)
    steps: int | None = option(
        "Steps of every env in an iteration; default: 16 with events, 128 with intervals.", None, low=1, high=65_536
    )
    epochs: int = option(
        "Passes of the actor over an iteration's choices; the critic makes one over all steps.", 4, low=1, high=1000
    )
    minibatch: int = option("Choices in one optimiser step of the actor.", 128, low=1, high=1_000_000)
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
        "Length of a training step: events (until an arm has a choice) or interval; not with --suite.",
        "events",
        choices=get_args(Decisions),
        noun="kind of step",
    )
    """See `fleet.env.allocation_v2`."""
    discount_s: float = option(
        "Horizon of the discount, s: gamma of a step is exp(-elapsed_s / discount_s).", 7200.0, low=1, high=1e7
    )
    trace_s: float = option(
        "Horizon of the trace, s: lambda of a step is exp(-elapsed_s / trace_s).", 900.0, low=1, high=1e7
    )
    """Longer than most jobs, so that the return of a claim contains the reward of its job."""
    clip: float = option("Largest change of a likelihood ratio from 1.", 0.2, low=0, high=1e6, above=True)
    entropy: float = option("Weight of the entropy bonus; not with --suite.", 0.002, low=0, high=10)
    max_gradient: float = option("Largest norm of a gradient.", 0.5, low=0, high=1e6, above=True)
    reward_scale: float = option("Factor on rewards.", 0.1, low=0, high=1e6, above=True)
    warm_start: str = option(
        "Rule that the network imitates first, for example wspt; default: none. Not with --suite.", ""
    )
    seed: int = option("Seed for shifts, initialisation and minibatches.", 0, low=0, high=MAX_SEED)

    def __post_init__(self) -> None:
        check(self)

    @property
    def length(self) -> int:
        """Steps of every env in an iteration."""
        if self.steps is not None:
            return self.steps
        return 16 if self.decisions == "events" else 128
