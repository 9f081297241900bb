"""A ROS 2 node over Zenoh, compatible with rmw_zenoh: `ros2 node list` shows it, and it publishes and subscribes.

It is a client of one router: rmw_zenoh's (`rmw_zenohd`) or the fleet's. It has no services and no parameters.
"""

import time
import weakref
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

import zenoh

from fleet.bus.client.router import connect
from fleet.errors import BusError
from fleet.ros2.topics import Topic, attachment, gid, node_token, plain_name, publisher_token


class Publisher:
    """Sends messages of one topic until it is closed."""

    def __init__(self, session: zenoh.Session, topic: Topic, node: str, entity: int, now_ns: Callable[[], int]) -> None:
        token = publisher_token(topic, str(session.zid()), node, entity)
        self._sender, self._now_ns, self._sent = gid(token), now_ns, 0
        self._publisher = session.declare_publisher(topic.key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(token)

    def put(self, payload: bytes) -> None:
        """Send one message; dropped under congestion."""
        self._sent += 1
        self._publisher.put(payload, attachment=attachment(self._sent, self._now_ns(), self._sender))

    def close(self) -> None:
        """Withdraw the publisher and its token."""
        self._token.undeclare()
        self._publisher.undeclare()


class Node:
    """`with Node(endpoint, "name") as node:` is part of a ROS 2 domain until the end of the block.

    Args:
        endpoint: The router, which has `timeout_s` to reply.
        stopped: Wait for a router until this is true, instead of `timeout_s`.
        name: Characters that ROS 2 does not allow in it become `_`.
        now_ns: Wall clock for the time stamps of messages, ns since 1970.
    """

    def __init__(
        self,
        endpoint: str,
        name: str,
        *,
        domain: int = 0,
        timeout_s: float = 5.0,
        stopped: Callable[[], bool] | None = None,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.name, self.domain = plain_name(name), domain
        self._endpoint, self._timeout_s, self._stopped, self._now_ns = endpoint, timeout_s, stopped, now_ns
        self._session: zenoh.Session | None = None
        self._entities = 0
        self._resources = ExitStack()
        # A process that exits without closing its session would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    def open(self) -> Self:
        """Connect, and show the node in ROS 2.

        Raises:
            BusError: no router replied.
        """
        if self._session is None:
            self._session = connect(self._endpoint, self._timeout_s, self._stopped)
            self._resources.callback(self._session.close)
            token = self._session.liveliness().declare_token(
                node_token(self.domain, str(self._session.zid()), self.name)
            )
            self._resources.callback(lambda: token)  # kept: a token without a reference is undeclared
        return self

    def close(self) -> None:
        """Leave the domain; does nothing if not open."""
        self._session = None
        try:
            self._resources.close()
        except zenoh.ZError as error:
            raise BusError(f"The ROS 2 node at {self._endpoint} did not close: {error}") from error

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def publisher(self, topic: Topic) -> Publisher:
        """Publisher of a topic."""
        self._entities += 1
        return Publisher(self._open(), topic, self.name, self._entities, self._now_ns)

    def listen(self, topic: Topic, handle: Callable[[str, bytes], None]) -> None:
        """Subscribe to a topic, for publishers of every ROS 2 version.

        Args:
            handle: Called with the sender's hash of the type, and the message; on a thread of Zenoh, so it must be
                fast.
        """

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                handle(str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes())

        # The stub of zenoh types handlers by their internals.
        direct: Any = zenoh.handlers.Callback(receive, indirect=False)
        subscriber = self._open().declare_subscriber(topic.any_hash, direct)
        self._resources.callback(lambda: subscriber)

    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError("This ROS 2 node is not open.")
        return self._session
