"""A run as read from its folder."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any  # values of run.json

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import JOINTS
from fleet.telemetry import MODES, Telemetry
from scenarios.run.run_folder import UNITS, check_format
from scenarios.run.schedule import Schedule, payloads, schedule
from scenarios.shift_records import JobRecord, Offer
from scenarios.spec.schema import Scenario


@dataclass(frozen=True, eq=False)
class StoredRun:
    """The files of a run."""

    card: Mapping[str, Any]
    """run.json."""
    scenario: Scenario
    telemetry: Telemetry
    events: tuple[Event, ...]
    jobs: tuple[JobRecord, ...]
    offers: tuple[Offer, ...]

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arms."""
        return tuple(arm.name for arm in self.scenario.arms)

    @cached_property
    def plan(self) -> Schedule:
        """Which arm worked on what."""
        return schedule(self.events, self.arms, float(self.telemetry.time_s[-1]))

    @cached_property
    def load_kg(self) -> np.ndarray:
        """Payload in each hand, kg, [sample, arm]."""
        return payloads(self.telemetry, self.plan, self.arms, {job.job: job.payload_kg for job in self.jobs})

    def _repr_html_(self) -> str:
        from scenarios.show.run_page import run_html

        return run_html(self.card, self.events, self.offers)


def read_run(folder: Path) -> StoredRun:
    """Read the folder of a run.

    Raises:
        FleetError: it is no folder of a run, not of this version, or damaged.
    """
    try:
        card = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        check_format(card, folder)
        scenario = msgspec.convert(card["scenario"], Scenario)
        tables = {name: pq.read_table(folder / f"{name}.parquet") for name in ("telemetry", "events", "jobs", "offers")}
        stored = StoredRun(
            card,
            scenario,
            _telemetry(tables["telemetry"], len(scenario.arms)),
            tuple(Event(**_without_nulls(row)) for row in tables["events"].to_pylist()),
            tuple(JobRecord(**row) for row in tables["jobs"].to_pylist()),
            tuple(Offer(**row) for row in tables["offers"].to_pylist()),
        )
        if not len(stored.telemetry.time_s):
            raise ValueError("telemetry.parquet has no rows")
        _ = stored.plan  # raises for events that contradict each other or the fleet
        return stored
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid) as error:
        raise FleetError(
            f"'{folder}' is no complete folder of `thermofleet run` ({type(error).__name__}: {error})."
        ) from error


def _telemetry(table: pa.Table, arms: int) -> Telemetry:
    samples = table.num_rows // arms
    readings = {name: np.stack([table[f"{name}_{j + 1}"].to_numpy() for j in range(JOINTS)], axis=-1) for name in UNITS}
    modes = table["mode"].combine_chunks()
    numbers = np.array([MODES.index(mode) for mode in modes.dictionary.to_pylist()])[modes.indices.to_numpy()]
    return Telemetry(
        time_s=table["time_s"].to_numpy()[::arms],
        mode=numbers.reshape(samples, arms),
        **{name: values.reshape(samples, arms, JOINTS) for name, values in readings.items()},
    )


def _without_nulls(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: float("nan") if value is None else value for name, value in row.items()}
