"""Epochs: an auctioneer whose journal is lost, or an older copy, must not have jobs done again that arms have done.

The epoch is the name of a journal, which arms get with every award and keep on disk. Before an arm counts as present,
the auctioneer asks what it has finished and what it has. If an arm knows another epoch, the journal was lost: no jobs
are accepted, unless a new epoch was requested. Then the auctioneer adopts what the arms know.
"""

import logging
import time
from collections.abc import Iterable

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.history import History, HistoryRequest
from fleet.errors import BusError, JournalError
from fleet.live.auction.auctioneer import Auctioneer

_LOG = logging.getLogger(__name__)

REPLY_S = 1.0
"""Real seconds that an arm has to reply."""
MAX_NAMED = 5
"""Jobs that an error names."""
REMEDY = (
    "Stop the auctioneer and bring the journal back, or start with --new-epoch: then jobs that the arms have done are "
    "not done again, and all other jobs of the old journal must be submitted again."
)


def ask_arms(link: BusClient) -> tuple[History, ...]:
    """Return what the present arms have done and have."""
    key = keys.of_every_arm(link.fleet, "history")
    return tuple(link.query_and_wait(key, HistoryRequest(), History, timeout_s=REPLY_S).messages.values())


def check_begin(fleet: str, histories: Iterable[History]) -> None:
    """Check that no arm knows an epoch, so that an auctioneer may begin with an empty journal.

    Raises:
        BusError: an arm does.
    """
    for history in histories:
        if history.epoch:
            raise BusError(f"The journal is empty, but fleet '{fleet}' has worked: {describe(history)}. {REMEDY}")


def describe(history: History) -> str:
    """Return what an arm knows, in words."""
    names = [job.name for job in history.finished[-MAX_NAMED:]]
    done = f"{len(history.finished)} finished job(s), the last ones {', '.join(names)}" if names else "no finished job"
    return f"'{history.arm}' knows the epoch '{history.epoch}', {done}, and has {len(history.awards)} job(s)"


class EpochCheck:
    """Which arms have sent their history, and whether it is one of this auctioneer's journal."""

    def __init__(self, link: BusClient, auctioneer: Auctioneer) -> None:
        """Start; no arm is admitted yet."""
        self._link, self._auctioneer = link, auctioneer
        self._asked_s: dict[str, float] = {}
        """Real second of the last request to each arm that has not sent its history."""
        self._admitted: set[str] = set()
        self._foreign: dict[str, str] = {}
        """Why an arm gets no work, by arm."""

    @property
    def objection(self) -> str:
        """Why no jobs are accepted; "" if they are."""
        return next(iter(self._foreign.values()), "")

    def admitted(self, arms: Iterable[str]) -> frozenset[str]:
        """Return those of these arms whose history fits; request the others'."""
        arms = frozenset(arms)
        for arm in arms - self._admitted - self._foreign.keys():
            self._ask(arm)
        return arms & self._admitted

    def forget(self, arm: str) -> None:
        """Forget an arm that has left: it may come back with another history."""
        self._admitted.discard(arm)
        self._foreign.pop(arm, None)
        self._asked_s.pop(arm, None)

    def _ask(self, arm: str) -> None:
        real_s = time.monotonic()
        if real_s < self._asked_s.get(arm, -REPLY_S) + REPLY_S:
            return
        self._asked_s[arm] = real_s

        def done(replies: Replies[History]) -> None:
            if "" in replies.refused.values():  # it did not reply in time
                return
            for history in replies.messages.values():
                if not self._accept(history):
                    return
            self._admitted.add(arm)  # an arm of another maker may have no history

        self._link.query(
            keys.of_arm(self._link.fleet, arm, "history"), HistoryRequest(), History, done, timeout_s=REPLY_S
        )

    def _accept(self, history: History) -> bool:
        """Adopt what an arm knows; return whether it fits and is on disk."""
        ledger = self._auctioneer.ledger
        if history.epoch not in ("", ledger.epoch) and not ledger.succeeds:
            self._foreign[history.arm] = (
                f"No jobs are accepted: the journal has the epoch '{ledger.epoch}', but {describe(history)}. {REMEDY}"
            )
            _LOG.error("%s", self._foreign[history.arm])
            return False
        try:
            self._auctioneer.adopt(history, time.monotonic())
        except JournalError as error:
            _LOG.error("The history of '%s' is not recorded: %s", history.arm, error)
            return False
        return True
