"""The replies to one query as they arrive, up to a largest number."""

import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import msgspec
import zenoh

from fleet.bus.client.replies import Replies
from fleet.bus.protocol.messages import MalformedMessage

Reply = TypeVar("Reply", bound=msgspec.Struct)

MOST_REPLIES = 1024
"""Replies to one query that are read: one of each arm of the largest fleet."""


class PendingQuery(Generic[Reply]):
    """A query that is not complete. Zenoh's thread calls `receive` and `finish`, which only queue calls.

    Attributes:
        token: Cancels the query when more replies arrive than are read.
    """

    def __init__(
        self,
        kind: type[Reply],
        *,
        most: int,
        post: Callable[..., None],
        each: Callable[[Reply], None],
        reject: Callable[[str], None],
        done: Callable[[Replies[Reply]], None],
    ) -> None:
        """Start the clock; arguments as of `fleet.bus.client.client.BusClient.query`.

        Args:
            post: Queues a call for the thread of the client.
            reject: Gets the reason why a reply is malformed.
        """
        self.token = zenoh.CancellationToken()
        self._kind, self._most, self._post, self._each, self._reject, self._done = kind, most, post, each, reject, done
        self._replies: Replies[Reply] = Replies()
        self._start_s = time.monotonic()
        self._arrived = 0

    def receive(self, reply: zenoh.Reply) -> None:
        """Queue a reply."""
        self._arrived += 1
        if self._arrived <= self._most:
            self._post(self._take, reply)
        elif self._arrived == self._most + 1:
            self._post(self._stop)

    def finish(self) -> None:
        """Queue the end: no reply follows."""
        self._post(self._complete)

    def _take(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            self._replies.miss(_error_in(reply))
            return
        replier = str(reply.ok.key_expr)
        try:
            payload = reply.ok.payload.to_bytes()
            message = self._replies.take(replier, str(reply.ok.encoding), payload, self._kind)
        except MalformedMessage as error:
            self._reject(f"reply under '{replier}': {error}")
        else:
            if message is not None:
                self._each(message)

    def _stop(self) -> None:
        self._replies.miss(f"More than {self._most} replies to one query; no more are read.")
        self.token.cancel()  # and so calls `finish`

    def _complete(self) -> None:
        self._replies.took_s = time.monotonic() - self._start_s
        self._done(self._replies)


def _error_in(reply: zenoh.Reply) -> str:
    # Any: Zenoh's stubs do not state that a reply has either `ok` or `err`.
    error: Any = reply.err
    return "" if error is None else error.payload.to_bytes().decode(errors="replace")
