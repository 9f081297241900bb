"""The station of VDA 5050 as a state machine; tests/adapters/test_vda5050.py has MQTT and the published schemas."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobStatus
from fleet.vda5050.station import Station


class Fleet:
    """In place of a `JobClient`: keeps what the station asks for."""

    def __init__(self, on_change):
        self.on_change, self.jobs, self.cancelled, self.refuses = on_change, {}, [], ""

    def submit(self, spec):
        self.jobs[spec.name] = spec

    def cancel(self, job):
        self.cancelled.append(job)
        return self.refuses

    def pause(self, _paused):
        return self.refuses

    def forget(self, job):
        self.jobs.pop(job)


class Master:
    """A station and its master control."""

    def __init__(self):
        self.station = Station(self._fleet, lambda: None)

    def _fleet(self, on_change):
        self.fleet = Fleet(on_change)
        return self.fleet

    def order(self, name="o1", actions=(), update=0, nodes=1, **more):
        node = {"nodeId": "cell", "sequenceId": 0, "released": True, "actions": list(actions)}
        order = {"orderId": name, "orderUpdateId": update, "nodes": [node] * nodes, "edges": []} | more
        self.station.receive("order", json.dumps(order).encode())

    def instant(self, kind, field="actions"):
        action = {"actionType": kind, "actionId": kind, "blockingType": "NONE"}
        self.station.receive("instantActions", json.dumps({field: [action]}).encode())

    def told(self):
        return {state.action_id: state.action_status for state in self.station.action_states}

    def errors(self):
        return [error.error_type for error in self.station.errors]

    def end(self, job, state="finished", **more):
        self.fleet.on_change(JobStatus(job, state, **more))


def action(name, blocking="NONE", kind="hold", **parameters):
    parameters = {"places": ["clamp"], "dwell_s": 5} | parameters
    listed = [{"key": key, "value": value} for key, value in parameters.items()]
    return {"actionType": kind, "actionId": name, "blockingType": blocking, "actionParameters": listed}


@given(st.lists(st.sampled_from(["NONE", "SOFT", "HARD"]), max_size=12))
def test_hard_actions_are_alone_and_others_are_together(blocking):
    """Brute force: two jobs may overlap unless one waits, directly or not, for the other."""
    master = Master()
    master.order(actions=[action(str(i), each) for i, each in enumerate(blocking)])
    waits: dict[int, set[int]] = {}
    for i in range(len(blocking)):
        own = {int(name.rpartition(":")[2]) for name in master.fleet.jobs[f"o1:{i}"].after}
        waits[i] = own.union(*(waits[each] for each in own))
    for later in range(len(blocking)):
        for earlier in range(later):
            assert (earlier in waits[later]) == ("HARD" in (blocking[earlier], blocking[later])) or any(
                each == "HARD" for each in blocking[earlier + 1 : later]
            )


def test_an_order_becomes_jobs_and_their_states_become_those_of_its_actions():
    master = Master()
    master.order(actions=[action("a"), action("b", kind="pick_place", places=["x", "y"], repetitions=3)])
    spec = master.fleet.jobs["o1:b"]
    assert (spec.kind, spec.places, spec.repetitions, spec.dwell_s) == ("pick_place", ("x", "y"), 3, 5.0)
    assert master.told() == {"a": "WAITING", "b": "WAITING"}
    master.end("o1:a", "awarded", arm="arm_0", cycles=0)
    master.end("o1:b", "awarded", arm="arm_1", cycles=2)
    assert master.told() == {"a": "INITIALIZING", "b": "RUNNING"}
    master.order("o2", actions=[action("c")])
    assert master.errors() == ["orderError"]
    master.end("o1:a")
    master.end("o1:b", "unfinished", reason="the shift ended")
    assert master.told() == {"a": "FINISHED", "b": "FAILED"}
    master.order("o2", actions=[action("c")])
    assert (master.errors(), list(master.fleet.jobs)) == ([], ["o2:c"])
    master.order("o2", actions=[action("c")])  # sent again
    assert master.errors() == []
    master.order("o2", actions=[action("c"), action("d")], update=1)
    assert master.errors() == ["orderUpdateError"]


@pytest.mark.parametrize(
    ("order", "error"),
    [
        ({"nodes": 2}, "noRouteError"),
        ({"edges": [{}]}, "noRouteError"),
        ({"actions": [action("a", dwell_s=60000)]}, "validationError"),
        ({"actions": [action("a", kind="drop")]}, "validationError"),
        ({"actions": [action("a"), action("a")]}, "validationError"),
        ({"orderUpdateId": -1}, "validationError"),
        ({"orderId": "o" * 64}, "validationError"),
    ],
)
def test_an_impossible_order_is_an_error_and_no_job(order, error):
    master = Master()
    master.order(**order)
    assert (master.errors(), master.fleet.jobs, master.station.jobs) == ([error], {}, None)


@pytest.mark.parametrize("payload", [b"", b"{}", b"\xff", b"[" * 100_000, b'{"orderId":1}'])
def test_what_is_no_order_is_an_error(payload):
    master = Master()
    master.station.receive("order", payload)
    assert master.errors() == ["validationError"]


def test_cancel_and_pause_are_passed_on_and_end_when_the_fleet_says_so():
    master = Master()
    master.instant("cancelOrder")
    assert (master.told(), master.errors()) == ({"cancelOrder": "FAILED"}, ["noOrderToCancel"])
    master.order(actions=[action("a"), action("b")])
    master.fleet.refuses = "the bus cannot"
    master.instant("cancelOrder", field="instantActions")  # as in version 1.1
    master.instant("startPause")
    assert master.told() | {"stateRequest": ""} == {
        "a": "WAITING", "b": "WAITING", "cancelOrder": "FAILED", "startPause": "FAILED", "stateRequest": "",
    }  # fmt: skip
    master.fleet.refuses = ""
    master.instant("startPause")
    assert master.station.paused
    master.instant("cancelOrder")
    assert master.told()["cancelOrder"] == "RUNNING"
    master.end("o1:a", "given_up", reason="cancelled")
    assert master.told()["cancelOrder"] == "RUNNING"
    master.end("o1:b")
    assert master.told() == {"a": "FAILED", "b": "FINISHED", "cancelOrder": "FINISHED", "startPause": "FINISHED"}
    master.instant("fly")
    assert (master.told()["fly"], master.errors()) == ("FAILED", ["unsupportedAction"])
