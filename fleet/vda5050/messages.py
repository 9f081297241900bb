"""Messages of VDA 5050, as far as a station of fixed arms has them. Field names are those of the standard.

Source: VDA 5050, versions 1.1, 2.0 and 2.1, chapter 6 and the tables of its topics. What is sent is valid in all three;
of what is received, unknown fields are ignored.
"""

from datetime import datetime
from typing import Annotated, Any, Literal

import msgspec

VERSION = "2.0.0"
MOST_ACTIONS = 128
Identifier = Annotated[str, msgspec.Meta(max_length=63)]
BlockingType = Literal["NONE", "SOFT", "HARD"]
ActionStatus = Literal["WAITING", "INITIALIZING", "RUNNING", "PAUSED", "FINISHED", "FAILED"]
ConnectionState = Literal["ONLINE", "OFFLINE", "CONNECTIONBROKEN"]
Number = Annotated[int, msgspec.Meta(ge=0, le=2**32)]


class Sent(msgspec.Struct, rename="camel", frozen=True, kw_only=True):
    """Header of every message that is sent."""

    header_id: int
    timestamp: datetime
    manufacturer: str
    serial_number: str
    version: str = VERSION


class Parameter(msgspec.Struct, rename="camel", frozen=True):
    """One parameter of an action."""

    key: str
    value: Any
    """Any JSON value."""


class Action(msgspec.Struct, rename="camel", frozen=True):
    """Something to do."""

    action_type: str
    action_id: Identifier
    blocking_type: BlockingType = "HARD"
    action_parameters: tuple[Parameter, ...] = ()


Actions = Annotated[tuple[Action, ...], msgspec.Meta(max_length=MOST_ACTIONS)]


class Node(msgspec.Struct, rename="camel", frozen=True):
    """A place of an order; a station has one."""

    node_id: str
    sequence_id: Number
    released: bool
    actions: Actions = ()


class Order(msgspec.Struct, rename="camel", frozen=True):
    """Topic `order`, received."""

    order_id: Identifier
    order_update_id: Number
    nodes: tuple[Node, ...]
    edges: tuple[Any, ...] = ()


class InstantActions(msgspec.Struct, rename="camel", frozen=True):
    """Topic `instantActions`, received."""

    actions: Actions = ()
    instant_actions: Actions = ()
    """The same in version 1.1."""


class ActionState(msgspec.Struct, rename="camel", frozen=True):
    """Progress of an action."""

    action_id: str
    action_type: str
    action_status: ActionStatus
    result_description: str = ""


class Reference(msgspec.Struct, rename="camel", frozen=True):
    """What an error refers to."""

    reference_key: str
    reference_value: str


class Error(msgspec.Struct, rename="camel", frozen=True):
    """An error; a WARNING needs nobody's help."""

    error_type: str
    error_description: str
    error_references: tuple[Reference, ...] = ()
    error_level: Literal["WARNING", "FATAL"] = "WARNING"


class Battery(msgspec.Struct, rename="camel", frozen=True):
    """A station has mains supply."""

    battery_charge: float = 100.0
    charging: bool = False


class Safety(msgspec.Struct, rename="camel", frozen=True):
    """Not known to the fleet: the emergency stop of an arm belongs to its controller."""

    e_stop: Literal["NONE"] = "NONE"
    field_violation: bool = False


class State(Sent, frozen=True, kw_only=True):
    """Topic `state`, sent."""

    order_id: str
    order_update_id: int
    last_node_id: str
    last_node_sequence_id: int
    node_states: tuple[()] = ()
    edge_states: tuple[()] = ()
    driving: bool = False
    paused: bool = False
    operating_mode: Literal["AUTOMATIC"] = "AUTOMATIC"
    action_states: tuple[ActionState, ...]
    battery_state: Battery = Battery()
    errors: tuple[Error, ...]
    safety_state: Safety = Safety()


class Connection(Sent, frozen=True, kw_only=True):
    """Topic `connection`, sent."""

    connection_state: ConnectionState
