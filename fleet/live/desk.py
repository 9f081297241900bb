"""Requests of everybody about the jobs of a fleet: its auctioneer replies, or the first of its arms without one."""

import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import TypeVar

from msgspec import Struct
from msgspec.structs import replace

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    MOST_JOBS,
    Clock,
    ClockRequest,
    JobStatus,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.operator import Cleared, ClearRequest, Controlled, ControlRequest
from fleet.errors import Refused
from fleet.live.book import JobBook
from fleet.live.job_rules import Position, fitting
from fleet.live.records import JobEntry

_LOG = logging.getLogger(__name__)

Request = TypeVar("Request", bound=Struct)


class JobDesk(ABC):
    """Replies in the name of one participant, from its job book."""

    book: JobBook

    def __init__(self, name: str, speed: float, cell: Cell | None) -> None:
        """Start; `speed` is in fleet seconds per real second, and `cell` None refuses requests for the cell."""
        self._name, self._speed, self._cell = name, speed, cell

    def _declare_desk(self, link: BusClient) -> None:
        fleet = link.fleet
        link.reply_to(keys.of_jobs(fleet, "submit"), Submission, self._logged(self._submit))
        link.reply_to(keys.of_jobs(fleet, "clear"), ClearRequest, self._logged(self._clear))
        link.reply_to(keys.of_jobs(fleet, "control"), ControlRequest, self._logged(self._control))
        link.reply_to(keys.of_jobs(fleet, "status"), StatusRequest, self._reply_status)
        link.reply_to(keys.of_jobs(fleet, "cell"), CellRequest, self._reply_cell)
        link.reply_to(keys.of_clock(fleet), ClockRequest, self._reply_clock)

    def _logged(self, handle: Callable[[Request], Struct]) -> Callable[[Request], Struct]:
        """Return a handler of requests that logs what is refused."""

        def reply(request: Request) -> Struct:
            try:
                return handle(request)
            except Refused as error:
                _LOG.warning("Refused: %s", error)
                raise

        return reply

    @property
    @abstractmethod
    def time_s(self) -> float:
        """Fleet time."""

    @abstractmethod
    def _check_first(self) -> None:
        """Check that this participant replies for the fleet.

        Raises:
            AnotherReplies: another one does.
        """

    @abstractmethod
    def _trouble(self) -> str:
        """Return why this participant accepts and awards no jobs; "" if it does."""

    def _left_out(self) -> Mapping[str, str]:
        """Return why some arms are awarded no jobs for a while, by arm."""
        return {}

    @abstractmethod
    def _entries(self) -> Sequence[JobEntry]:
        """Return the jobs whose status everybody may know."""

    @abstractmethod
    def _status_of(self, entries: Sequence[JobEntry]) -> Sequence[JobStatus]: ...
    @abstractmethod
    def _submit(self, submission: Submission) -> SubmissionReply: ...
    @abstractmethod
    def _clear(self, request: ClearRequest) -> Cleared: ...
    @abstractmethod
    def _control(self, request: ControlRequest) -> Controlled: ...

    def _reply_status(self, request: StatusRequest) -> Status:
        self._check_first()
        entries, names, after = self._entries(), frozenset(request.jobs), Position.read(request.after)
        wanted = ((entry.position, entry) for entry in entries if not names or entry.name in names)
        following = sorted((each for each in wanted if each[0] > after), key=itemgetter(0))
        page = following[:MOST_JOBS]
        book = self.book
        reply = Status(
            self._name,
            self.time_s,
            (),
            {arm: tuple(sorted(taken)) for arm, taken in sorted(book.taken_space().items()) if taken},
            book.epoch,
            dict(book.operations.paused),
            self._trouble(),
            dict(self._left_out()),
            dict(Counter(entry.state for entry in entries)),
        )
        jobs = fitting(reply, self._status_of([entry for _, entry in page]))
        last = page[len(jobs) - 1][0] if jobs else after
        return replace(reply, jobs=jobs, next=last.text if len(jobs) < len(following) else "")

    def _reply_cell(self, _: CellRequest) -> Cell:
        self._check_first()
        if self._cell is None:
            raise Refused(f"'{self._name}' knows no cell.")
        return self._cell

    def _reply_clock(self, _: ClockRequest, /) -> Clock:
        self._check_first()
        return Clock(self.time_s, self._speed, self.book.epoch)
