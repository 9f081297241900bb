"""A fleet as one stationary vehicle of VDA 5050: an order has one node, and each action of it is a job.

| VDA 5050 | fleet |
|---|---|
| action of the node: type `hold`, `pick_place`, `press`, `sort`; parameters as in `JobSpec` | submission |
| blocking type HARD | the job waits for those before it, and those after it wait for it |
| action states | status of the jobs |
| `cancelOrder`, `startPause`, `stopPause` | cancel, pause, resume |
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import msgspec

from fleet.bus.protocol.auction import SETTLED, JobSpec, JobStatus
from fleet.job import Kind
from fleet.live.job_client import JobClient
from fleet.vda5050.messages import Action, ActionState, ActionStatus, Error, InstantActions, Order, Reference

MOST_ERRORS = 16
MOST_INSTANT = 16
"""Instant actions whose states are kept."""
_FIELDS = tuple(name for name in JobSpec.__struct_fields__ if name not in ("name", "kind", "after"))


@dataclass(eq=False)
class Jobs:
    """Jobs of the present order: their actions by name of the job."""

    order: Order
    actions: dict[str, Action]
    statuses: dict[str, JobStatus]

    @property
    def ended(self) -> bool:
        """Whether all jobs have ended."""
        return all(status.state in SETTLED for status in self.statuses.values())


class Station:
    """State machine of the station, without a connection to MQTT.

    Args:
        client: Makes the client of the fleet; it calls the given function when a job changes.
        changed: Called when the state has changed.
    """

    def __init__(self, client: Callable[[Callable[[JobStatus], None]], JobClient], changed: Callable[[], None]) -> None:
        self.errors: list[Error] = []
        self.paused = False
        self.jobs: Jobs | None = None
        self._instant: dict[str, ActionState] = {}
        self._cancelling = ""
        self._changed = changed
        self._client = client(self._apply_status)

    def step(self) -> None:
        """Send requests to the fleet that are due."""
        self._client.step()

    def receive(self, topic: str, payload: bytes) -> None:
        """Apply a message of master control; one that is no order is an error of the state."""
        try:
            if topic == "order":
                self._apply_order(msgspec.json.decode(payload, type=Order))
            elif topic == "instantActions":
                self._apply_instant(msgspec.json.decode(payload, type=InstantActions))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            self._fail("validationError", f"{topic}: {error}.")
        self._changed()

    @property
    def action_states(self) -> tuple[ActionState, ...]:
        """States of the actions of the present order, then of instant actions."""
        own = () if self.jobs is None else (self._state_of(name) for name in self.jobs.actions)
        return (*own, *self._instant.values())

    # Orders

    def _apply_order(self, order: Order) -> None:
        old, at = self.jobs, Reference("orderId", order.order_id)
        if old is not None and old.order.order_id == order.order_id:
            if order.order_update_id != old.order.order_update_id:
                self._fail("orderUpdateError", "A station finishes an order before it gets the next; send another.", at)
            return  # sent again
        if old is not None and not old.ended:
            self._fail("orderError", f"Order '{old.order.order_id}' is not finished; wait, or cancel it.", at)
            return
        if order.edges or len(order.nodes) != 1 or not order.nodes[0].released:
            self._fail("noRouteError", "A station does not drive: an order has one released node and no edges.", at)
            return
        try:
            specs = jobs_of(order)
        except msgspec.ValidationError as error:
            self._fail("validationError", f"{error}.", at)
            return
        for name in () if old is None else old.actions:
            self._client.forget(name)
        self.errors.clear()
        self._instant.clear()
        actions = dict(zip((spec.name for spec in specs), order.nodes[0].actions, strict=True))
        self.jobs = Jobs(order, actions, {name: JobStatus(name, "waiting") for name in actions})
        for spec in specs:
            self._client.submit(spec)

    def _apply_status(self, status: JobStatus) -> None:
        if self.jobs is None or status.job not in self.jobs.actions:
            return
        self.jobs.statuses[status.job] = status
        if self._cancelling and self.jobs.ended:
            self._set_instant(self._cancelling, "cancelOrder", "FINISHED")
            self._cancelling = ""
        self._changed()

    def _state_of(self, name: str) -> ActionState:
        assert self.jobs is not None
        action, status = self.jobs.actions[name], self.jobs.statuses[name]
        said = [f"{status.arm}, {status.cycles} cycles done"] if status.arm else []
        said += [status.reason] if status.reason else []
        return ActionState(action.action_id, action.action_type, _status_of(status, self.paused), "; ".join(said))

    # Instant actions

    def _apply_instant(self, message: InstantActions) -> None:
        for action in (*message.actions, *message.instant_actions):
            reason = self._do_instant(action)
            status = "FAILED" if reason else "RUNNING" if self._cancelling == action.action_id else "FINISHED"
            self._set_instant(action.action_id, action.action_type, status, reason)

    def _do_instant(self, action: Action) -> str:
        """Do an instant action; return why it fails, or ""."""
        match action.action_type:
            case "stateRequest":
                return ""  # every message is answered with a state
            case "startPause" | "stopPause" as kind:
                if not (reason := self._client.pause(kind == "startPause")):
                    self.paused = kind == "startPause"
                return reason
            case "cancelOrder":
                if self.jobs is None or self.jobs.ended:
                    self._fail("noOrderToCancel", "There is no order at work.", Reference("actionId", action.action_id))
                    return "There is no order at work."
                open_jobs = [name for name, status in self.jobs.statuses.items() if status.state not in SETTLED]
                reasons = [reason for name in open_jobs if (reason := self._client.cancel(name))]
                if not reasons and not self.jobs.ended:
                    self._cancelling = action.action_id
                return next(iter(reasons), "")
            case other:
                self._fail("unsupportedAction", f"Unknown: '{other}'.", Reference("actionId", action.action_id))
                return f"A station knows cancelOrder, startPause, stopPause and stateRequest, not '{other}'."

    def _set_instant(self, action: str, kind: str, status: ActionStatus, reason: str = "") -> None:
        self._instant[action] = ActionState(action, kind, status, reason)
        while len(self._instant) > MOST_INSTANT:
            del self._instant[next(iter(self._instant))]

    def _fail(self, kind: str, description: str, *references: Reference) -> None:
        self.errors = [*self.errors, Error(kind, description, references)][-MOST_ERRORS:]


def jobs_of(order: Order) -> tuple[JobSpec, ...]:
    """Jobs of an order, in the order of its actions.

    Raises:
        msgspec.ValidationError: an action is no possible job; names it.
    """
    specs: list[JobSpec] = []
    barrier: list[str] = []
    """The last HARD one: all later jobs wait for it."""
    beside: list[str] = []
    """Those since then: the next HARD one waits for them."""
    for action in order.nodes[0].actions:
        if action.action_type not in get_args(Kind):
            raise msgspec.ValidationError(
                f"Action '{action.action_id}': a station does {', '.join(get_args(Kind))} (got '{action.action_type}')"
            )
        hard = action.blocking_type == "HARD"
        after = (beside or barrier) if hard else barrier
        fields: dict[str, Any] = {each.key: each.value for each in action.action_parameters if each.key in _FIELDS}
        fields |= {"name": f"{order.order_id}:{action.action_id}", "kind": action.action_type, "after": after}
        try:
            specs.append(msgspec.convert(fields, JobSpec))
        except msgspec.ValidationError as error:
            raise msgspec.ValidationError(f"Action '{action.action_id}': {error}") from error
        barrier, beside = ([specs[-1].name], []) if hard else (barrier, [*beside, specs[-1].name])
    if len({spec.name for spec in specs}) != len(specs):
        raise msgspec.ValidationError("Two actions have the same actionId")
    return tuple(specs)


def _status_of(status: JobStatus, paused: bool) -> ActionStatus:
    match status.state:
        case "finished":
            return "FINISHED"
        case "given_up" | "unfinished":
            return "FAILED"
        case "waiting":
            return "WAITING"
        case _:
            return "PAUSED" if paused else "RUNNING" if status.cycles or status.state == "finishing" else "INITIALIZING"
