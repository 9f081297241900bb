"""Fleets of the units of a study: prepared once for instances that share a cell, and kept while they are needed."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

from scenarios.job_stream import all_works, works_of
from scenarios.prepare.fleet import DifficultyName, Fleet, RiskName, prepare
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, quiet
from scenarios.schema import Scenario
from scenarios.trials.plan import Study, Unit

MOST_FLEETS = 4
"""Prepared fleets that a process keeps; one has some 10 MB per arm."""
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
    return (frozenset(all_works(scenario)), *(getattr(scenario, name) for name in kept))


class Fleets:
    """Prepared fleets, the last few of them kept."""

    def __init__(self) -> None:
        self._cells: OrderedDict[object, Fleet] = OrderedDict()
        self._last: tuple[object, Fleet] | None = None

    def of(
        self,
        unit: Unit,
        risk: RiskName,
        folder: Path,
        progress: Progress = quiet,
        randomise: Randomisation | None = None,
    ) -> Fleet:
        """The fleet of a unit; the same object for units of one group that follow each other.

        Raises:
            FleetError: it cannot be prepared.
        """
        scenario = drawn(unit.case.scenario, unit.fleet)
        asked = (scenario, unit.training, unit.difficulty, risk, randomise, folder)
        if self._last and self._last[0] == asked:
            return self._last[1]
        cell = (prepared_content(scenario, unit.difficulty), *asked[1:])
        if cell not in self._cells:
            self._cells[cell] = prepare(
                scenario,
                difficulty=unit.difficulty,
                risk=risk,
                randomise=randomise,
                training=unit.training,
                cache=folder,
                progress=progress,
            )
            while len(self._cells) > MOST_FLEETS:
                self._cells.popitem(last=False)
        self._cells.move_to_end(cell)
        found = replace(self._cells[cell], scenario=scenario)
        self._last = asked, found
        return found


def warm(units: Sequence[Unit], study: Study, folder: Path, fleets: Fleets, progress: Progress) -> None:
    """Make the plans and twins that units share, so that no two processes make the same; all land in the cache."""
    seen: set[object] = set()
    for unit in units:
        content = plan_content(drawn(unit.case.scenario, unit.fleet))
        cell = (content, unit.training, unit.difficulty)
        if cell not in seen:
            seen.add(cell)
            fleets.of(unit, study.risk, folder, progress, study.randomise)
