"""ROS 2 messages as bytes: CDR, little endian, after a header of four bytes. Needs the extra `ros2` (rosbags).

The types used here are the same in every ROS 2 version from Humble on, and so are their hashes.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from fleet.bus.protocol.messages import MalformedMessage
from fleet.ros2.conversion import Diagnostic, Joints

JOINT_STATE = "sensor_msgs/msg/JointState"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
MAX_ITEMS = 4096
"""Largest length of a list in a message that is read."""
SPARE_BYTES, _SPARE_STEP = 16, 4
"""Bytes that may follow a message; rosbags ignores up to 3 of them."""
_NS = 1_000_000_000
_SECONDS = range(-(2**31), 2**31)

_STORE = get_typestore(Stores.ROS2_JAZZY)
_STORE.max_sequence_length = MAX_ITEMS
_TYPES: dict[str, Any] = dict(_STORE.types)


def type_hash(kind: str) -> str:
    """Type hash `RIHS01_…` of ROS 2 Iron and later (REP 2016)."""
    return _STORE.hash_rihs01(kind)


def definition(kind: str) -> str:
    """Definition of a type and of those in it, as in a `.msg` file."""
    return _STORE.generate_msgdef(kind, ros_version=2)[0]


def message(kind: str, **fields: Any) -> Any:  # rosbags makes its classes at run time
    """A message with some fields; the others are zero or empty."""
    filled: dict[str, Any] = {}
    fields_of: Any = _STORE.fielddefs[kind][1]  # nested tuples of several forms
    for name, (node, of) in fields_of:
        if name in fields:
            filled[name] = fields[name]
        elif node == Nodetype.NAME:
            filled[name] = message(of)
        elif node == Nodetype.BASE:
            filled[name] = {"string": "", "bool": False}.get(of[0], 0)
        else:
            filled[name] = np.empty(0, np.uint8) if of[0][1] in (("uint8", 0), ("octet", 0)) else []
    return _TYPES[kind](**filled)


def write(content: Any, kind: str) -> bytes:
    """Encode a message of rosbags."""
    return bytes(_STORE.serialize_cdr(content, kind))


def write_joints(joints: Joints) -> bytes:
    """Encode a JointState.

    Raises:
        ValueError: ROS 2 cannot represent its time.
    """
    arrays = [np.array(values, dtype=np.float64) for values in (joints.q, joints.qd, joints.tau)]
    return write(
        _TYPES[JOINT_STATE](header(joints.time_s), [plain_text(name) for name in joints.names], *arrays), JOINT_STATE
    )


def read_joints(payload: bytes) -> Joints:
    """Decode a JointState.

    Raises:
        MalformedMessage: it is no JointState, or its lists are of different lengths.
    """
    joints = read(payload, JOINT_STATE)
    stamp = joints.header.stamp
    names = tuple(joints.name)
    lists = {"position": joints.position, "velocity": joints.velocity, "effort": joints.effort}
    for field, values in lists.items():
        if len(values) not in (0, len(names)):
            raise MalformedMessage(f"A JointState of {len(names)} name(s) has {len(values)} value(s) of {field}.")
    q, qd, tau = (tuple(values.tolist()) for values in lists.values())
    return Joints(stamp.sec + stamp.nanosec / _NS, names, q, qd, tau)


def write_diagnostics(time_s: float, diagnostics: Sequence[Diagnostic]) -> bytes:
    """Encode a DiagnosticArray.

    Raises:
        ValueError: ROS 2 cannot represent its time.
    """
    status, pair = _TYPES["diagnostic_msgs/msg/DiagnosticStatus"], _TYPES["diagnostic_msgs/msg/KeyValue"]
    statuses = [
        status(
            level=each.level,
            name=plain_text(each.name),
            message=plain_text(each.message),
            hardware_id=plain_text(each.hardware),
            values=[pair(key=plain_text(key), value=plain_text(value)) for key, value in each.values],
        )
        for each in diagnostics
    ]
    return write(_TYPES[DIAGNOSTICS](header(time_s), statuses), DIAGNOSTICS)


def read_diagnostics(payload: bytes) -> tuple[Diagnostic, ...]:
    """Decode a DiagnosticArray.

    Raises:
        MalformedMessage: it is no DiagnosticArray.
    """
    return tuple(
        Diagnostic(
            level=status.level,
            name=status.name,
            message=status.message,
            hardware=status.hardware_id,
            values=tuple((pair.key, pair.value) for pair in status.values),
        )
        for status in read(payload, DIAGNOSTICS).status
    )


def read(payload: bytes, kind: str) -> Any:  # rosbags makes its classes at run time
    """Decode a message; up to `SPARE_BYTES` may follow it, as after `rclpy.serialization.serialize_message`.

    That function returns its whole buffer. Fast DDS sizes it with padding before the elements of empty lists, and
    fills no padding: the bytes there are whatever was in memory.

    Raises:
        MalformedMessage: it is no message of this type.
    """
    try:
        for spare in range(0, SPARE_BYTES + 1, _SPARE_STEP):
            try:
                return _STORE.deserialize_cdr(payload[: len(payload) - spare], kind)
            except SerdeError as error:
                if spare == SPARE_BYTES or "size mismatch" not in str(error):
                    raise
    except SerdeError as error:
        raise MalformedMessage(f"Not a {kind}: {error}") from error


def header(time_s: float, frame: str = "") -> Any:  # see read
    """A std_msgs/Header.

    Raises:
        ValueError: ROS 2 cannot represent its time.
    """
    return _TYPES["std_msgs/msg/Header"](stamp=stamp(time_s), frame_id=plain_text(frame))


def stamp(time_s: float) -> Any:  # see read
    """A builtin_interfaces/Time.

    Raises:
        ValueError: ROS 2 cannot represent it.
    """
    sec, nanosec = divmod(round(time_s * _NS), _NS) if abs(time_s) < 2**32 else (_SECONDS.stop, 0)
    if sec not in _SECONDS:
        raise ValueError(f"A ROS 2 time is {_SECONDS[0]} to {_SECONDS[-1]} s (got {time_s:g}).")
    return _TYPES["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)


def plain_text(text: str) -> str:
    """Text without zeros: a string of CDR ends with one."""
    return text.replace("\0", "\N{REPLACEMENT CHARACTER}")
