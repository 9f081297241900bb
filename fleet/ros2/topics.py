"""How ROS 2 speaks over Zenoh (rmw_zenoh): its keys, its liveliness tokens, what is attached to every message.

Source: github.com/ros2/rmw_zenoh, docs/design.md, and liveliness_utils.cpp and attachment_helpers.cpp in
rmw_zenoh_cpp/src/detail; layout as of rmw_zenoh 0.1.2 (Humble), 0.2.4 (Jazzy) and later.
"""

import re
import struct
from dataclasses import dataclass
from hashlib import blake2b

from fleet.errors import BusError

NO_HASH = "TypeHashNotSupported"
"""In place of a type's hash where the ROS version knows none: Humble."""
DOMAINS = range(233)
"""Of `ROS_DOMAIN_ID`; rmw_zenoh itself would take any number."""
GID_BYTES = 16
RELIABLE_LAST_10 = "::,10:,:,:,,"
"""Quality of service in a token: reliable, volatile, keep the last 10; what is left out is rmw_zenoh's default."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
_ATTACHED = struct.Struct(f"<qqB{GID_BYTES}s")


@dataclass(frozen=True)
class Topic:
    """A ROS 2 topic of one domain.

    Raises:
        BusError: the name or the domain is none that ROS 2 allows.
    """

    name: str
    """Absolute, as `/arm/joint_states`."""
    kind: str
    """As `sensor_msgs/msg/JointState`."""
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
        """Key under which its messages travel."""
        return f"{self._start}/{self.hash}"

    @property
    def any_hash(self) -> str:
        """Key expression for its messages whatever ROS version sends them; never for a put."""
        return f"{self._start}/*"

    @property
    def _start(self) -> str:
        return f"{self.domain}/{self.name.strip('/')}/{dds_name(self.kind)}"


def dds_name(kind: str) -> str:
    """`sensor_msgs/msg/JointState` as DDS writes it: `sensor_msgs::msg::dds_::JointState_`."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def plain_name(name: str) -> str:
    """Any name as one part of a topic: what ROS 2 does not allow becomes `_`; different names may become the same."""
    allowed = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name)).strip("_")
    return allowed if allowed[:1].isalpha() else f"n{allowed}"


def node_token(domain: int, session: str, node: str) -> str:
    """Token by which others see a node; `session` is the id of its Zenoh session."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{node}"


def publisher_token(topic: Topic, session: str, node: str, entity: int, qos: str = RELIABLE_LAST_10) -> str:
    """Token by which others see a publisher; `entity` is its number in the session, the node's own is 0."""
    name, kind = topic.name.replace("/", "%"), dds_name(topic.kind)
    return f"@ros2_lv/{topic.domain}/{session}/0/{entity}/MP/%/%/{node}/{name}/{kind}/{topic.hash}/{qos}"


def gid(token: str) -> bytes:
    """16 bytes that tell a publisher from all others, from its token.

    rmw_zenoh takes another hash (XXH3); nothing needs both to agree but tools that look up who sent a message.
    """
    return blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(number: int, time_ns: int, sender: bytes) -> bytes:
    """What must be attached to a message: a subscriber of rmw_zenoh drops one that has it not.

    Args:
        number: Counts the messages of one publisher.
        time_ns: When it was sent, since 1970.
        sender: `gid` of the publisher.
    """
    return _ATTACHED.pack(number, time_ns, GID_BYTES, sender)
