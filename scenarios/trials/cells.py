"""Which scenarios share a prepared fleet, and which share the plans and trained twins that take long to make."""

from dataclasses import fields, replace

from scenarios.job_stream import all_works, works_of
from scenarios.prepare.fleet import DifficultyName
from scenarios.schema import Scenario

_UNREAD = ("name", "description", "jobs", "reward", "people", "slots", "decisions", "telemetry_interval_s", "bus")
"""Fields of a scenario that `prepare` does not read, and its jobs."""
_WEATHER = ("horizon_s", "decision_interval_s", "ambient", "start", "limits")
"""Fields that plans and trained networks do not depend on; what does is quickly made."""


def drawn(scenario: Scenario, fleet: int) -> Scenario:
    """The scenario with the k-th draw of its arms."""
    return replace(scenario, spread=replace(scenario.spread, seed=scenario.spread.seed + fleet))


def prepared_content(scenario: Scenario, difficulty: DifficultyName) -> tuple[object, ...]:
    """What `prepare` reads of a scenario: two with the same content have the same prepared fleet.

    Past jobs of a twin are drawn from the scenario's streams, so these are kept whole.
    """
    jobs = scenario.jobs if difficulty == "twin" else tuple(works_of(scenario, stream) for stream in scenario.jobs)
    return (jobs, *(getattr(scenario, field.name) for field in fields(scenario) if field.name not in _UNREAD))


def plan_content(scenario: Scenario) -> tuple[object, ...]:
    """What takes long to make of a scenario, plans and trained twins, depends on this."""
    kept = (field.name for field in fields(scenario) if field.name not in (*_UNREAD, *_WEATHER))
    return (all_works(scenario), *(getattr(scenario, name) for name in kept))
