"""Record the messages of arms and auctioneers once each, with known gaps.

Messages are durable once they are in a Parquet part; the card names the last complete part, so a crash duplicates no
row. Every sender numbers its messages: repeated ones are dropped, missing ones are fetched from the caches of the
publishers (`GapFetcher`), also those that a crash of the recorder lost, and lost ones become a row of `gaps`. Only the
operations of arms have no number: repeated ones are recognised by time and name, and lost ones are not noticed.
"""

import logging
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyarrow.parquet as pq
from msgspec import structs

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, Result
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ALARMS_PER_START, Alarm, Operation
from fleet.errors import BusError, FleetError
from fleet.events import EVENTS_PER_BOOT
from fleet.files import atomic_path
from scenarios.live.recording import (
    CARD,
    KINDS,
    RECORDING_FORMAT,
    SOURCES,
    Gap,
    Kind,
    Message,
    RecordingCard,
    SenderCount,
    Source,
    part_file,
    read_card,
    to_row,
    to_table,
)
from scenarios.result_folder import disk_errors, json_text, lock_folder

_LOG = logging.getLogger(__name__)

MAX_ROWS = 50_000
"""Rows in memory at which a part is written before it is due."""
MAX_WAITING = 4 * MAX_ROWS
"""Rows in memory on a full disk; further messages are dropped, and fetched once there is space."""
FETCH_S, PAUSE_S = 2.0, 3.0
"""Real seconds: how long the caches have to reply; between two attempts."""
ATTEMPTS = 4
"""Attempts before the messages count as lost."""
MAX_KEYS = 64
"""Senders asked in one attempt."""
SWEEP_S, SWEEP_KEYS = 60.0, 8
"""Real seconds between two sweeps, and senders asked in one, by turns: a cache may hold a thousand messages."""
TURN_S, BATCH = 0.5, 1000
"""Real seconds, and messages, after which a turn of the recorder ends."""
CELL_S, CELL_REPLY_S = 30.0, 5.0
"""Real seconds: between two requests for the cell, until one has a reply; until a request times out."""
BACKLOG = 200_000
"""Maximum number of queued messages: joining a fleet of 100 arms brings 100 000 at once."""
CONNECT_S = 0.5
"""Real seconds that the router has to accept the session that fetches missed messages."""
RETRY_S = 5.0
"""Real seconds until the next attempt to write a part after a disk error."""


@dataclass(frozen=True)
class Series:
    """The messages that a sender numbers, and the number of one of them."""

    sender: str
    """As in the card: `telemetry of arm_0`."""
    number: int
    epoch: str
    first: int
    """Least number since the last start of the sender."""
    continues: bool
    """Whether the numbers of an epoch continue when the sender starts again; its times are in no order then."""
    whole: bool = True
    """Whether cached messages from before the recording belong to it."""

    @property
    def name(self) -> str:
        """Name of the series; the numbers of an arm have no epoch, as it learns the epoch after its start."""
        return f"{self.sender}, epoch {self.epoch}" if self.epoch and self.continues else self.sender


def series_of(message: Message) -> Series:
    """Return the series that a message belongs to."""
    match message:
        case State():
            return Series(f"telemetry of {message.arm}", message.tick, message.epoch, 1, False, whole=False)
        case ArmEvent(number=number):
            first = _first_of_start(number, EVENTS_PER_BOOT)
            return Series(f"events of {message.arm}", number, message.epoch, first, False)
        case Result():
            return Series(f"results of {message.auctioneer}", message.number, message.epoch, 0, True)
        case Operation():
            return Series(f"operations of {message.auctioneer}", message.number, message.epoch, 0, True)
        case Alarm():
            first = _first_of_start(message.number, ALARMS_PER_START)
            return Series(f"alarms of {message.monitor}", message.number, "", first, False)


def _first_of_start(number: int, per_start: int) -> int:
    """First number since the start of a sender, of which each start has a block of this many numbers."""
    return number // per_start * per_start + 1


class Recorder:
    """Keeps every message once, in memory until `write`. `open` starts or continues a recording.

    Attributes:
        counts: Messages by series: `telemetry of arm_0`.
        missing: Gaps that are still being fetched.
        parts: Number of the last complete part.
        cell: Description of the cell, for the card.
    """

    def __init__(self, folder: Path, card: RecordingCard) -> None:
        self.folder, self.fleet = folder, card.fleet
        self.counts = card.senders
        self.missing = list(card.missing)
        self.parts, self.cell = card.parts, card.cell
        self._written = card.rows
        self._rows: list[Message | Gap] = []

    @classmethod
    def open(cls, folder: Path, fleet: str) -> "Recorder":
        """Start or continue a recording in an existing folder.

        Raises:
            FleetError: the folder cannot be written, holds something else, or a recording of another fleet.
        """
        if (folder / CARD).exists():
            card = read_card(folder)
        elif any(folder.iterdir()):
            raise FleetError(f"'{folder}' holds other files; --out needs a new folder or an earlier recording.")
        else:
            card = RecordingCard(RECORDING_FORMAT, "recording", fleet, 0, {})
        if card.fleet != fleet:
            raise FleetError(f"'{folder}' is a recording of fleet '{card.fleet}', not of '{fleet}'.")
        recorder = cls(folder, card)
        recorder.write()
        return recorder

    @property
    def waiting(self) -> int:
        """Number of rows that are in no part yet."""
        return len(self._rows)

    def add(self, _: str, message: Message, *, numbered: bool = True) -> None:
        """Keep a message, unless it was kept before or memory is full; all but the operations of arms have numbers."""
        take = self._take if numbered else self._take_unnumbered
        if self.waiting < MAX_WAITING and take(message):
            self._rows.append(message)

    def subscribe(self, link: BusClient, source: Source, name: str | None = None) -> None:
        """Subscribe to the messages of a sender, or of all by default, with those that are cached."""
        key = keys.build(link.fleet, source.role, source.topic, name)
        link.subscribe(key, source.message, partial(self.add, numbered=source.numbered), history=True)

    def abandon(self, gap: Gap, reason: str) -> None:
        """Fetch a gap no more: it becomes a row."""
        if gap in self.missing:
            self.missing.remove(gap)
            self._rows.append(structs.replace(gap, reason=reason))

    def write(self, *, status: str = "recording") -> None:
        """Write all rows as a new part, and the card; a status other than `recording` ends the recording.

        Raises:
            FleetError: a disk error; no row is lost, and the next call tries again.
        """
        if status != "recording":
            for gap in list(self.missing):
                self.abandon(gap, "the recording ended before they were fetched")
        rows: dict[Kind, list[dict[str, object]]] = {kind: [] for kind in KINDS}
        for record in self._rows:
            kind, row = to_row(record)
            rows[kind].append(row)
        for kind in KINDS:
            part = part_file(self.folder, kind, self.parts + 1)
            if rows[kind]:
                with self._draft(part) as draft:
                    pq.write_table(to_table(kind, rows[kind]), draft, write_page_checksum=True)
            else:  # of an attempt that a crash ended before it wrote the card
                part.unlink(missing_ok=True)
        card = RecordingCard(
            format=RECORDING_FORMAT,
            status=status,
            fleet=self.fleet,
            parts=self.parts + bool(self._rows),
            senders={name: count for name, count in self.counts.items() if count.kept},
            missing=tuple(self.missing),
            rows={kind: self._written.get(kind, 0) + len(rows[kind]) for kind in KINDS},
            cell=self.cell,
        )
        with self._draft(self.folder / CARD) as draft:
            draft.write_bytes(json_text(card).encode())
        self.parts, self._written = card.parts, card.rows
        self._rows.clear()

    # Inside

    def _take(self, message: Message) -> bool:
        """Count a message; return whether it is new."""
        series = series_of(message)
        number, time_s = series.number, message.time_s
        count = self.counts.setdefault(series.name, SenderCount())
        begins = bool(series.epoch) and series.epoch not in count.epochs
        restarted = not series.continues and number <= count.last and (begins or time_s > count.time_s)
        if number <= count.last and not restarted:
            if self._fill(series, count, time_s):
                return True
            if not series.continues or time_s <= count.time_s:
                count.twice += 1
                return False
            reason = "these numbers were used twice: the journal of the sender was replaced by an older copy"
            repeated = Gap(series.sender, number, count.last, count.time_s, time_s, reason, series.epoch)
            self._rows.append(repeated)
            count.last = number - 1
        if begins:
            count.epochs += (series.epoch,)
        expected = series.first if restarted or series.first > count.last else count.last + 1
        if not count.kept:  # earlier messages: as many as the sender may have cached
            expected = max(series.first, number - HISTORY) if series.whole else number
        if expected < number:
            after_s = 0.0 if begins else max(count.time_s, 0.0)
            gap = Gap(series.sender, expected, number - 1, after_s, time_s, epoch=series.epoch)
            self.missing.append(gap)
            count.missed += number - expected
        count.kept += 1
        count.last = number
        count.time_s = time_s if begins or restarted else max(count.time_s, time_s)
        return True

    def _take_unnumbered(self, operation: Message) -> bool:
        """Count an operation of an arm; return whether it is new."""
        assert isinstance(operation, Operation), "all other messages have numbers"
        count = self.counts.setdefault(f"operations of {operation.auctioneer}", SenderCount())
        request = operation.time_s, operation.request.request
        if request in count.requests:
            count.twice += 1
            return False
        count.kept += 1
        count.time_s = max(count.time_s, operation.time_s)
        count.requests = (*count.requests, request)[-HISTORY:]
        return True

    def _fill(self, series: Series, count: SenderCount, time_s: float) -> bool:
        """Whether a late message belongs to a gap, which then shrinks or splits."""
        number = series.number
        for gap in self.missing:
            own = gap.sender == series.sender and gap.first <= number <= gap.last
            own &= gap.epoch == series.epoch or (not series.continues and "" in (gap.epoch, series.epoch))
            # The first event of a start may have the time of a clock that is not set yet; its number tells the start.
            if own and (series.continues or series.first > 1 or gap.after_s <= time_s <= gap.time_s):
                self.missing.remove(gap)
                if gap.first < number:
                    self.missing.append(structs.replace(gap, last=number - 1, time_s=time_s))
                if number < gap.last:
                    self.missing.append(structs.replace(gap, first=number + 1, after_s=time_s))
                count.kept, count.missed = count.kept + 1, count.missed - 1
                count.time_s = max(count.time_s, time_s)  # an auctioneer's times are in no order
                return True
        return False

    @contextmanager
    def _draft(self, path: Path) -> Iterator[Path]:
        """A draft of a file, durable before it takes its name; the name is durable when the block ends.

        So after a power failure no later file, which relies on this one, exists without it.
        """
        try:
            with atomic_path(path) as draft:
                yield draft
                with draft.open("rb") as file:
                    os.fsync(file.fileno())
            folder = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            raise FleetError(f"Cannot write '{path}': {error.strerror or error}.") from error


class GapFetcher:
    """Fetches what a recorder misses from the caches of the publishers: call `step` often.

    An advanced subscriber asks a cache once when it detects a gap. If the router or the publisher is away at that
    moment, the messages stay missing. So a second session subscribes to the same keys with history, which sends the
    whole cache. Where no gap is known it does the same from time to time: a sender's last message may be missing.

    Args:
        connect: Makes a client of the fleet, which is not open yet.
    """

    def __init__(self, recorder: Recorder, connect: Callable[[], BusClient]) -> None:
        self._recorder, self._connect = recorder, connect
        self._link: BusClient | None = None
        self._asked: tuple[str, ...] = ()
        self._tries: Counter[str] = Counter()
        self._due_s = self._swept_s = 0.0
        self._swept = 0

    def step(self, real_s: float) -> None:
        """Handle replies; begin or end an attempt if it is due."""
        if self._link is not None:
            self._link.serve()
        if real_s < self._due_s:
            return
        if self._link is not None:
            self.close()
            self._count()
            self._due_s = real_s + PAUSE_S
        elif senders := tuple(dict.fromkeys(gap.sender for gap in self._recorder.missing))[:MAX_KEYS]:
            self._due_s = real_s + FETCH_S
            self._begin(senders)
        elif real_s >= self._swept_s + SWEEP_S:
            self._due_s, self._swept_s = real_s + FETCH_S, real_s
            self._begin(self._next_senders())

    def close(self) -> None:
        """End the attempt."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _next_senders(self) -> tuple[str, ...]:
        """Return the senders of the next sweep: those of results and operations, which are few, first.

        Of an auctioneer that is known by its results the only operation may be what is missing, of an arm that is known
        by its states the only event or operation, and of an auctioneer that is not known, "*", all.
        """
        known = sorted({name.partition(", epoch")[0] for name in self._recorder.counts} - {""}, reverse=True)
        of_arms = (name.partition(" of ")[2] for name in known if name.startswith(("events", "telemetry")))
        arms = list(dict.fromkeys(of_arms))
        central = {name.partition(" of ")[2] for name in known if name.startswith(("results", "operations"))}
        auctioneers = sorted(central.difference(arms)) or ["*"]
        both = [f"{kind} of {name}" for kind in ("results", "operations") for name in auctioneers]
        start, self._swept = self._swept % max(1, len(arms)), self._swept + SWEEP_KEYS
        turn = dict.fromkeys((arms[start:] + arms)[:SWEEP_KEYS])
        return (*both[:SWEEP_KEYS], *(f"{kind} of {name}" for name in turn for kind in ("events", "operations")))

    def _begin(self, senders: tuple[str, ...]) -> None:
        link = self._connect()
        try:
            link.open()
        except BusError:  # no router: the next attempt is due soon, and this one does not count
            return
        self._link, self._asked = link, senders
        for sender in senders:
            kind, _, name = sender.partition(" of ")
            for source in (each for each in SOURCES if each.kind == kind):
                self._recorder.subscribe(link, source, None if name == "*" else name)

    def _count(self) -> None:
        """Abandon the gaps of senders after `ATTEMPTS` requests."""
        missing = {gap.sender for gap in self._recorder.missing}
        self._tries = Counter({sender: self._tries[sender] + (sender in self._asked) for sender in missing})
        for gap in list(self._recorder.missing):
            if self._tries[gap.sender] >= ATTEMPTS:
                self._recorder.abandon(gap, f"not in the cache of its publisher, asked {ATTEMPTS} times")
        self._tries = Counter({sender: count for sender, count in self._tries.items() if count < ATTEMPTS})


class RecorderNode:
    """Records what a fleet publishes: call `serve` until the end, then `end`."""

    def __init__(
        self, link: BusClient, recorder: Recorder, connect: Callable[[], BusClient], *, rotate_s: float
    ) -> None:
        """Subscribe.

        Args:
            link: Open client of the bus.
            connect: Makes another client of the fleet, not open yet, which fetches missed messages.
            rotate_s: Real seconds between two Parquet parts.
        """
        self._link, self.recorder, self._rotate_s = link, recorder, rotate_s
        self._fetcher = GapFetcher(recorder, connect)
        self._due_s, self._failure = time.monotonic() + rotate_s, ""
        self._ask_cell_s = -math.inf
        for source in SOURCES:
            recorder.subscribe(link, source)

    def serve(self, until_s: float = math.inf) -> None:
        """Handle messages for a turn, and do what is due; after a disk error they are tried again later."""
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
                self._failure = ""
        except FleetError as error:
            if not self._failure:
                _LOG.error("Not recorded yet: %s", error)
            self._failure, self._due_s = str(error), min(self._due_s, real_s + RETRY_S)

    def _keep_cell(self, replies: Replies[Cell]) -> None:
        """Keep the description of the cell without the work of its arms; it is written with the next part."""
        for cell in replies.messages.values():
            self.recorder.cell = structs.replace(cell, arms=tuple(structs.replace(arm, works=()) for arm in cell.arms))
            self._due_s = -math.inf
            return

    def end(self) -> None:
        """Write everything that has arrived, and end the recording.

        Raises:
            FleetError: a disk error.
        """
        self.close()
        self._link.serve()
        self.recorder.write(status="finished")

    def close(self) -> None:
        """Close the client that fetches."""
        self._fetcher.close()


def record(
    link: BusClient,
    folder: Path,
    *,
    rotate_s: float,
    stopped: Callable[[], bool],
    connect: Callable[[], BusClient],
    on_ready: Callable[[], object] = lambda: None,
) -> Recorder:
    """Record until stopped, or until the certificate expires; return the recorder, everything written.

    Args:
        rotate_s: Real seconds between two Parquet parts.
        connect: Makes another client of the fleet, which fetches missed messages.
        on_ready: Called once the folder is open.

    Raises:
        FleetError: a disk error at the beginning or at the end; in between it is tried again.
    """
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with (
        lock_folder(folder),
        closing(RecorderNode(link, Recorder.open(folder, link.fleet), connect, rotate_s=rotate_s)) as node,
    ):
        on_ready()
        while not (stopped() or link.expiry):
            node.serve()
        node.end()
    return node.recorder
