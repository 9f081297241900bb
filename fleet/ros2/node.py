"""A ROS 2 node over Zenoh, compatible with rmw_zenoh: `ros2 node list` shows it, and it publishes and subscribes.

It is a client of one router: rmw_zenoh's (`rmw_zenohd`) or the fleet's. It has no services and no parameters.

Source of keys, liveliness tokens and attachments: github.com/ros2/rmw_zenoh, docs/design.md, and liveliness_utils.cpp
and attachment_helpers.cpp in rmw_zenoh_cpp/src/detail; layout as of rmw_zenoh 0.1.2 (Humble), 0.2.4 (Jazzy) and later.
"""

import re
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Self

import zenoh

from fleet.bus.router import Connection
from fleet.errors import BusError
from fleet.ros2.conversion import plain_name

NO_HASH = "TypeHashNotSupported"
"""Stands for a type's hash in ROS 2 Humble, which has none."""
DOMAINS = range(233)
"""Values of `ROS_DOMAIN_ID`."""
GID_BYTES = 16
RELIABLE_LAST_10 = "::,10:,:,:,,"
"""Quality of service in a token: reliable, volatile, keep the last 10; empty fields are defaults of rmw_zenoh."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
_ATTACHED = struct.Struct(f"<qqB{GID_BYTES}s")


@dataclass(frozen=True)
class Topic:
    """A ROS 2 topic of one domain.

    Raises:
        BusError: ROS 2 does not allow the name or the domain.
    """

    name: str
    """Absolute: `/arm/joint_states`."""
    kind: str
    """Message type: `sensor_msgs/msg/JointState`."""
    hash: str
    """`RIHS01_…`, or `NO_HASH`."""
    domain: int = 0

    def __post_init__(self) -> None:
        if self.domain not in DOMAINS:
            raise BusError(f"A ROS domain is 0 to {DOMAINS[-1]} (got {self.domain}).")
        parts = self.name.split("/")
        if parts[0] or len(parts) < 2 or not all(_NAME.fullmatch(part) and "__" not in part for part in parts[1:]):
            raise BusError(
                f"'{self.name}' is no topic. Expected a name as /arm/joint_states: letters, digits and single _, no "
                "part beginning with a digit."
            )
        if _TYPE.fullmatch(self.kind) is None:
            raise ValueError(f"'{self.kind}' is no message type, as sensor_msgs/msg/JointState.")

    @property
    def key(self) -> str:
        """Key of its messages."""
        return f"{self._start}/{self.hash}"

    @property
    def any_hash(self) -> str:
        """Key expression of its messages of every ROS 2 version; for subscribers only."""
        return f"{self._start}/*"

    @property
    def _start(self) -> str:
        return f"{self.domain}/{self.name.strip('/')}/{dds_name(self.kind)}"


def dds_name(kind: str) -> str:
    """Name of a type in DDS: `sensor_msgs::msg::dds_::JointState_`."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def node_token(domain: int, session: str, node: str) -> str:
    """Liveliness token of a node; `session` is the id of its Zenoh session."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{node}"


def publisher_token(topic: Topic, session: str, node: str, entity: int, qos: str = RELIABLE_LAST_10) -> str:
    """Liveliness token of a publisher; `entity` is its number in the session, in which the node is 0."""
    name, kind = topic.name.replace("/", "%"), dds_name(topic.kind)
    return f"@ros2_lv/{topic.domain}/{session}/0/{entity}/MP/%/%/{node}/{name}/{kind}/{topic.hash}/{qos}"


def gid(token: str) -> bytes:
    """Unique 16 bytes of a publisher, from its token.

    rmw_zenoh uses another hash (XXH3). Only tools that look up the sender of a message would need the same.
    """
    return blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(number: int, time_ns: int, sender: bytes) -> bytes:
    """Attachment of a message; a subscriber of rmw_zenoh drops a message without one.

    Args:
        number: Number of the message, counted by publisher.
        time_ns: Time of sending, since 1970.
        sender: `gid` of the publisher.
    """
    return _ATTACHED.pack(number, time_ns, GID_BYTES, sender)


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


class Node(Connection):
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
        super().__init__(endpoint, timeout_s, stopped)
        self.name, self.domain = plain_name(name), domain
        self._now_ns, self._entities = now_ns, 0

    def open(self) -> Self:
        """Connect, and show the node in ROS 2.

        Raises:
            BusError: no router replied.
        """
        if self._session is None:
            session = super().open()._open()
            self._keep(session.liveliness().declare_token(node_token(self.domain, str(session.zid()), self.name)))
        return self

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
        self._keep(self._open().declare_subscriber(topic.any_hash, direct))
