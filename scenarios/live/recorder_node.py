"""The recorder on the bus: receives what arms and auctioneers publish, and writes it in turns."""

import fcntl
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from msgspec import structs

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, Result
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Operation
from fleet.errors import BusError, FleetError
from scenarios.live.gap_fetcher import GapFetcher
from scenarios.live.recorder import MAX_ROWS, Recorder

TURN_S, BATCH = 0.5, 1000
"""Real seconds, and messages, after which received messages are written to the disk."""
CELL_S, CELL_REPLY_S = 30.0, 5.0
"""Real seconds between two questions about the cell, until one is answered; in which a reply counts."""
RETRY_S = 5.0
"""Real seconds until the next attempt to write a part to a disk that refused."""
BACKLOG = 200_000
"""Messages that may wait: joining a fleet of a hundred arms brings a hundred thousand at once."""
CONNECT_S = 0.5
"""Real seconds that the router has to accept the session that fetches missed messages."""

_LOG = logging.getLogger(__name__)


class RecorderNode:
    """Records what a fleet publishes: call `serve` until the end, then `end`."""

    def __init__(
        self, link: BusClient, recorder: Recorder, connect: Callable[[], BusClient], *, rotate_s: float
    ) -> None:
        """Subscribe.

        Args:
            link: Open client of the bus.
            connect: Makes another client of the fleet, not open yet, which fetches missed messages.
            rotate_s: Real seconds between two Parquet parts; rows are in the journal before.
        """
        self._link, self.recorder, self._rotate_s = link, recorder, rotate_s
        self._fetcher = GapFetcher(recorder, connect)
        self._due_s, self._failure = time.monotonic() + rotate_s, ""
        self._ask_cell_s = -math.inf
        link.subscribe(keys.of_every_arm(link.fleet, "state"), State, recorder.add, history=True)
        link.subscribe(keys.of_every_arm(link.fleet, "event"), ArmEvent, recorder.add, history=True)
        link.subscribe(keys.of_every_auction(link.fleet, "result"), Result, recorder.add, history=True)
        link.subscribe(keys.of_every_auction(link.fleet, "operation"), Operation, recorder.add, history=True)

    def serve(self, until_s: float = math.inf) -> None:
        """Handle messages for a turn, and do what is due; a disk that refuses is tried again later."""
        self._link.serve(min(until_s, time.monotonic() + TURN_S), at_least=BATCH)
        self._fetcher.step(real_s := time.monotonic())
        if self.recorder.cell is None and real_s >= self._ask_cell_s:
            self._ask_cell_s = real_s + CELL_S
            key = keys.of_jobs(self._link.fleet, "cell")
            with suppress(BusError):  # also with a certificate that does not allow it, the rest is recorded
                self._link.query(key, CellRequest(), Cell, self._keep_cell, timeout_s=CELL_REPLY_S)
        try:
            if real_s >= self._due_s or (self.recorder.waiting >= MAX_ROWS and not self._failure):
                self._due_s = real_s + self._rotate_s
                self.recorder.write()
            self.recorder.save()
            self._failure = ""
        except FleetError as error:
            if not self._failure:
                _LOG.error("Not recorded yet: %s", error)
            self._failure, self._due_s = str(error), min(self._due_s, real_s + RETRY_S)

    def _keep_cell(self, replies: Replies[Cell]) -> None:
        """Keep the description of the cell without the work of its arms; the next part puts it on the disk."""
        for cell in replies.messages.values():
            self.recorder.cell = structs.replace(cell, arms=tuple(structs.replace(arm, works=()) for arm in cell.arms))
            self._due_s = -math.inf
            return

    def end(self) -> None:
        """Write everything that has arrived, and end the recording.

        Raises:
            FleetError: the disk refuses.
        """
        self.close()
        self._link.serve()
        self.recorder.write(status="finished")

    def close(self) -> None:
        """Close the client that fetches."""
        self._fetcher.close()


def record(
    link: BusClient, folder: Path, *, rotate_s: float, stopped: Callable[[], bool], connect: Callable[[], BusClient]
) -> Recorder:
    """Record until stopped; return the recorder, everything written.

    Args:
        rotate_s: Real seconds between two Parquet parts; rows are in the journal before.
        connect: Makes another client of the fleet, which fetches missed messages.

    Raises:
        FleetError: the disk refuses at the beginning or at the end; in between it is tried again.
    """
    with (
        lock_folder(folder),
        closing(Recorder.open(folder, link.fleet)) as recorder,
        closing(RecorderNode(link, recorder, connect, rotate_s=rotate_s)) as node,
    ):
        while not stopped():
            node.serve()
        node.end()
    return recorder


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Create the folder if it is missing, and lock it until the end of the block or of the process.

    Raises:
        FleetError: another process has locked it, or it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)  # the folder itself: no lock file is left in it
    except OSError as error:
        raise FleetError(f"Cannot write to '{folder}': {error.strerror}.") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise FleetError(f"Another process records in '{folder}'. Stop it, or choose another --out.") from error
    finally:
        os.close(handle)
