"""A ROS 2 node over Zenoh, as rmw_zenoh makes one: seen by `ros2 node list`, heard by subscribers, hearing publishers.

It is a client of one router: rmw_zenoh's own (`rmw_zenohd`), or one of ours. There are no services and no parameters.
"""

import time
import weakref
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

import zenoh

from fleet.bus.client.router import open_client
from fleet.errors import BusError
from fleet.ros2.topics import Topic, attachment, gid, node_token, plain_name, publisher_token


class Publisher:
    """Sends messages of one topic until it is closed."""

    def __init__(self, session: zenoh.Session, topic: Topic, node: str, entity: int, now_ns: Callable[[], int]) -> None:
        """Declare it, and show it to the others."""
        token = publisher_token(topic, str(session.zid()), node, entity)
        self._sender, self._now_ns, self._sent = gid(token), now_ns, 0
        self._publisher = session.declare_publisher(topic.key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(token)

    def put(self, payload: bytes) -> None:
        """Send one message; dropped under congestion."""
        self._sent += 1
        self._publisher.put(payload, attachment=attachment(self._sent, self._now_ns(), self._sender))

    def close(self) -> None:
        """Be seen no more."""
        self._token.undeclare()
        self._publisher.undeclare()


class Node:
    """`with Node(endpoint, "name") as node:` is part of a ROS 2 domain until the end of the block."""

    def __init__(
        self,
        endpoint: str,
        name: str,
        *,
        domain: int = 0,
        timeout_s: float = 5.0,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Prepare a node at the router at `endpoint`, which has `timeout_s` to answer.

        Args:
            name: What ROS 2 does not allow in it becomes `_`.
            now_ns: ROS 2 stamps what is sent with the wall clock, ns since 1970.
        """
        self.name, self.domain = plain_name(name), domain
        self._endpoint, self._timeout_s, self._now_ns = endpoint, timeout_s, now_ns
        self._session: zenoh.Session | None = None
        self._entities = 0
        self._resources = ExitStack()
        # A process that ends without closing its session would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    def open(self) -> Self:
        """Connect, and be seen.

        Raises:
            BusError: no router answered.
        """
        if self._session is None:
            self._session = open_client(self._endpoint, timeout_s=self._timeout_s)
            self._resources.callback(self._session.close)
            token = self._session.liveliness().declare_token(
                node_token(self.domain, str(self._session.zid()), self.name)
            )
            self._resources.callback(lambda: token)  # kept: a forgotten token is undeclared
        return self

    def close(self) -> None:
        """Leave; twice is fine."""
        self._session = None
        try:
            self._resources.close()
        except zenoh.ZError as error:
            raise BusError(f"The ROS 2 node at {self._endpoint} did not close in order: {error}") from error

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def publisher(self, topic: Topic) -> Publisher:
        """What sends messages of a topic."""
        self._entities += 1
        return Publisher(self._open(), topic, self.name, self._entities, self._now_ns)

    def listen(self, topic: Topic, handle: Callable[[str, bytes], None]) -> None:
        """Hear all messages of a topic, from every ROS 2 version.

        Args:
            handle: Gets the type's hash, as the sender knows it, and the message; called on Zenoh's own thread, so it
                only hands over.
        """

        def came(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                handle(str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes())

        # The stub of zenoh types handlers by their internals.
        direct: Any = zenoh.handlers.Callback(came, indirect=False)
        subscriber = self._open().declare_subscriber(topic.any_hash, direct)
        self._resources.callback(lambda: subscriber)

    def _open(self) -> zenoh.Session:
        if self._session is None:
            raise BusError("This ROS 2 node is not open.")
        return self._session
