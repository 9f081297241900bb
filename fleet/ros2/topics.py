"""Protocol of ROS 2 over Zenoh (rmw_zenoh): keys, liveliness tokens, attachments.

Source: github.com/ros2/rmw_zenoh, docs/design.md, and liveliness_utils.cpp and attachment_helpers.cpp in
rmw_zenoh_cpp/src/detail; layout as of rmw_zenoh 0.1.2 (Humble), 0.2.4 (Jazzy) and later.
"""

import re
import struct
from dataclasses import dataclass
from hashlib import blake2b

from fleet.errors import BusError

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


def plain_name(name: str) -> str:
    """Make any name one part of a topic: other characters become `_`, so different names may give the same."""
    allowed = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name)).strip("_")
    return allowed if allowed[:1].isalpha() else f"n{allowed}"


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
