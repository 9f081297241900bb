"""Fleets of the units of a study: prepared once for instances that share a cell, and kept while they are needed."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scenarios.prepare.fleet import Fleet, RiskName, prepare
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, quiet
from scenarios.trials.cells import drawn, plan_content, prepared_content
from scenarios.trials.plan import Study, Unit

MOST_FLEETS = 4
"""Prepared fleets that a process keeps; one has some 10 MB per arm."""


class Fleets:
    """Prepared fleets, the last few of them kept."""

    def __init__(self) -> None:
        self._cells: OrderedDict[object, tuple[object, Fleet]] = OrderedDict()
        """With what the plans of each depend on."""
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
        asked = (scenario, unit.twins, unit.difficulty, risk, randomise, folder)
        if self._last and self._last[0] == asked:
            return self._last[1]
        cell = (prepared_content(scenario, unit.difficulty), *asked[1:])
        if cell not in self._cells:
            plans = (plan_content(scenario), unit.difficulty, risk, randomise, folder)
            like = next((fleet for key, fleet in self._cells.values() if key == plans), None)
            made = prepare(
                scenario,
                difficulty=unit.difficulty,
                risk=risk,
                randomise=randomise,
                training=unit.twins,
                cache=folder,
                progress=progress,
                like=like,
            )
            self._cells[cell] = plans, made
            while len(self._cells) > MOST_FLEETS:
                self._cells.popitem(last=False)
        self._cells.move_to_end(cell)
        fleet = self._cells[cell][1]
        _, *specs = (randomise or Randomisation()).scenarios_of(scenario)
        variants = [replace(each, scenario=spec) for each, spec in zip(fleet.variants, specs, strict=True)]
        found = replace(fleet, scenario=scenario, variants=tuple(variants))
        self._last = asked, found
        return found


def warm(units: Sequence[Unit], study: Study, folder: Path, fleets: Fleets, progress: Progress) -> None:
    """Make the plans and twins that units share, so that no two processes make the same; all land in the cache."""
    seen: set[object] = set()
    for unit in units:
        content = plan_content(drawn(unit.case.scenario, unit.fleet))
        cell = (content, unit.twins, unit.difficulty)
        if cell not in seen:
            seen.add(cell)
            fleets.of(unit, study.risk, folder, progress, study.randomise)
