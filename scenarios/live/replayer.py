"""Replay a run or a recording on the bus: every arm publishes its messages again, and shows its token meanwhile."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.operator import ControlRequest, Operation
from fleet.errors import FleetError
from scenarios.live.recording import CARD, MESSAGES, SOURCES, Message, read_card, read_parts, states
from scenarios.run.log import check_format

TURN_S, TOKENS_S = 0.2, 2.0
"""Real seconds between two checks whether to stop; for the router to name the arms that are present."""


@dataclass(frozen=True, eq=False)
class Replay:
    """Messages to be published again."""

    fleet: str
    telemetry: pa.Table
    events: pa.Table
    results: pa.Table
    operations: pa.Table
    warning_c: float = 60.0
    """Warning limit of the headroom, where no headroom was recorded."""

    def __len__(self) -> int:
        return sum(table.num_rows for table in (self.telemetry, self.events, self.results, self.operations))

    @classmethod
    def of(cls, folder: Path) -> "Replay":
        """Read the folder of a run or of a recording, which may still be going on.

        Raises:
            FleetError: it is neither.
        """
        if (folder / CARD).exists():
            return cls(read_card(folder).fleet, *(read_parts(folder, kind) for kind in MESSAGES))
        try:
            run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
            scenario = run["scenario"]
            check_format(run, folder)
            return cls(
                fleet=scenario["name"],
                telemetry=pq.read_table(folder / "telemetry.parquet"),
                events=pq.read_table(folder / "events.parquet"),
                results=pa.table({}),
                operations=pa.table({}),
                warning_c=scenario["limits"]["warning_c"],
            )
        except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid) as error:
            raise FleetError(
                f"'{folder}' holds neither a run (run.json, telemetry.parquet, events.parquet) nor a recording of the "
                f"bus ({CARD})."
            ) from error

    @property
    def arms(self) -> list[str]:
        """Names of the arms."""
        return sorted(set(self.telemetry["arm"].to_pylist())) if self.telemetry.num_rows else []

    def messages(self) -> Iterator[Message]:
        """Yield all messages in order of time."""
        streams: list[Iterator[Message]] = [
            states(self.telemetry, warning_c=self.warning_c),
            _events(self.events),
            _results(self.results),
            _operations(self.operations),
        ]
        return merge(*streams, key=lambda message: message.time_s)

    def play(self, link: BusClient, *, speed: float, stopped: Callable[[], bool]) -> int:
        """Publish all messages at their own pace times `speed`, and return how many were published.

        Raises:
            FleetError: an arm of that name is on the bus already.
        """
        _refuse_present(link, self.arms)
        for arm in self.arms:
            link.declare_token(keys.of_arm(link.fleet, arm, "alive"))
        publishers: dict[str, Callable[[Message], None]] = {}
        start_s, first_s, count = time.monotonic(), None, 0
        for message in self.messages():
            first_s = message.time_s if first_s is None else first_s
            due_s = start_s + (message.time_s - first_s) / speed
            while time.monotonic() < due_s and not stopped():
                link.serve(min(due_s, time.monotonic() + TURN_S))
            if stopped():
                break
            key = _key(link.fleet, message)
            if key not in publishers:
                publishers[key] = link.publisher(key, type(message))
            publishers[key](message)
            count += 1
        return count


def _key(fleet: str, message: Message) -> str:
    role, topic, _ = next(source for source in SOURCES.values() if isinstance(message, source[2]))
    name = message.auctioneer if isinstance(message, Result | Operation) else message.arm
    return str(keys.Key(fleet, role, name, topic))


def _events(table: pa.Table) -> Iterator[ArmEvent]:
    numbers: dict[str, int] = {}
    for row in table.to_pylist():
        arm = row["arm"]
        if not arm:  # an event of the fleet
            continue
        numbers[arm] = row.get("number", numbers.get(arm, -1) + 1)
        value = None if row["value"] != row["value"] else row["value"]  # NaN in a run
        yield msgspec.convert({**row, "number": numbers[arm], "value": value}, ArmEvent)


def _results(table: pa.Table) -> Iterator[Result]:
    for row in table.to_pylist():
        status = {name: row[name] for name in JobStatus.__struct_fields__}
        yield msgspec.convert({**row, "status": status, "offers": json.loads(row["offers"] or "[]")}, Result)


def _operations(table: pa.Table) -> Iterator[Operation]:
    for row in table.to_pylist():
        request = msgspec.json.decode(row["content"], type=ControlRequest)
        yield Operation(row["auctioneer"], row["time_s"], request, row["number"], row["epoch"])


def _refuse_present(link: BusClient, arms: list[str]) -> None:
    present = link.tokens(keys.of_every_arm(link.fleet, "alive"), timeout_s=TOKENS_S)
    if taken := sorted(present & set(arms)):
        raise FleetError(f"Arm '{taken[0]}' of fleet '{link.fleet}' is on the bus already; give another --fleet.")
