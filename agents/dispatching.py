"""Dispatching rules of the textbook, without heat: each is an index of jobs, or an order of arms.

They are non-idling: a free arm that may claim a job does so. Source of all: Pinedo, Scheduling, 6th ed., Springer 2022,
chapter 14.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from agents.assignment import QuickestSsi
from agents.policy import WAIT, per_option
from agents.rules import IndexRule, oldest_jobs_to
from fleet.observation import Observation

Array = np.ndarray

DIGITS = 1
"""Due dates of a job by different arms are equal up to rounding; decimals of a second that count."""


class Fifo(IndexRule):
    """First in, first out: the oldest job of the queue first, to the arm that needs the least time for it.

    Scope central: it compares the arms' times.
    """

    only_choices = True

    def index(self, seen: Observation) -> Array:
        """Place in the queue from its end, then the shorter duration, [option]."""
        return _first_by(per_option(seen, np.arange(len(seen.offered))), seen.duration_s)


class Edd(IndexRule):
    """Earliest due date first, to the arm that needs the least time for the job.

    Optimal for the largest lateness on one machine (Jackson 1955). Scope central: it compares the arms' times.
    """

    only_choices = True

    def index(self, seen: Observation) -> Array:
        """Minus the time until the due date, then the shorter duration, [option]."""
        return _first_by((seen.slack_s.astype(float) + seen.duration_s).round(DIGITS), seen.duration_s)


class Spt(QuickestSsi):
    """Shortest processing time first: the claims of `quickest_ssi`, whose arms are all free when they claim.

    Optimal for the sum of completion times on one machine (Smith 1956). Scope central: it compares the arms' times.
    """

    only_choices = True


class Atc(IndexRule):
    """Apparent tardiness cost: value per time, discounted by exp(−slack / (k · mean duration)) until the slack is 0.

    Without slack it is `wspt`; with much slack the less urgent job waits. Scope central: it compares the arms' times.

    Source: Vepsalainen & Morton, Management Science 33, 1987; k = 2 as there for little congestion.
    """

    only_choices = True
    look_ahead: ClassVar = 2.0
    """k."""

    def index(self, seen: Observation) -> Array:
        """Value per second times urgency, [option]."""
        duration_s, legal = np.maximum(seen.duration_s, 1.0).astype(float), seen.action_mask[1:-1] > 0
        mean_s = duration_s[legal].mean() if legal.any() else 1.0
        urgency = np.exp(-np.maximum(seen.slack_s, 0.0) / (self.look_ahead * mean_s))
        return per_option(seen, seen.value) / duration_s * urgency


class LeastLoaded:
    """The oldest job goes to the able arm with the least working time in this shift, by the durations of its claimed
    plans.

    Scope central: it compares the work of all arms. The observation does not contain the work so far, so the rule adds
    the durations of its claims; a claim that lost is subtracted.
    """

    scope: ClassVar = "central"
    only_choices = False
    """A lost claim becomes known in the next interval."""

    def __init__(self) -> None:
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: no arm has worked."""
        self._load_s: dict[str, float] = {}
        self._claimed_s: dict[str, float] = {}

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """One pass over the slots from the oldest job; each goes to the able arm with the least working time."""
        for arm, claimed_s in self._claimed_s.items():
            if arm in observations and observations[arm].last_award < 0:
                self._load_s[arm] -= claimed_s
        self._claimed_s = {}
        if not any(seen.action_mask[1:-1].any() for seen in observations.values()):
            return dict.fromkeys(observations, WAIT)
        actions = oldest_jobs_to(sorted(observations, key=lambda arm: self._load_s.get(arm, 0.0)), observations)
        self._claimed_s = {
            arm: float(observations[arm].duration_s[action - 1]) for arm, action in actions.items() if action != WAIT
        }
        for arm, claimed_s in self._claimed_s.items():
            self._load_s[arm] = self._load_s.get(arm, 0.0) + claimed_s
        return actions


def _first_by(first: Array, then: Array) -> Array:
    """Index by one quantity and, where it is equal, by another; less is better, and both are below 10⁶."""
    return -(first.astype(float) * 1e6 + then)
