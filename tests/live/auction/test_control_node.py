"""Each request of people over a real router, and who may send it."""

import json
import zlib

import pytest

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Result, Status, StatusRequest, Submission
from fleet.bus.protocol.messages import decode, encode
from fleet.bus.protocol.operator import Cancel, Change, Controlled, ControlRequest, Operation, Pause, Resume, Settle


def control(bus, name, action):
    """Return the reply to a request and the reason of a refusal."""
    replies = bus.ask(keys.of_jobs("f", "control"), ControlRequest(name, action, "ann"), Controlled)
    return next(iter(replies.messages.values()), None), next(iter(replies.refused.values()), "")


def test_every_request_is_answered_published_and_kept_over_a_restart(bus):
    node, arm = bus.auctioneer(), bus.arm("arm_0")
    operations, results = [], []
    watcher = bus.link()
    watcher.subscribe(keys.of_every_auction("f", "operation"), Operation, lambda _, each: operations.append(each))
    watcher.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, each: results.append(each))
    arm.commits = False
    bus.until(lambda: node.present)
    assert control(bus, "1", Pause())[0].paused == {"*": "ann"}
    node.submit(Submission((*bus.jobs("a"), *bus.jobs("b", place="bin")), "bob"))
    reply, _ = control(bus, "2", Cancel("a"))
    assert (reply.changed, reply.job.state) == (True, "cancelled")
    reply, _ = control(bus, "3", Change("b", due_s=900.0, value=2.0))
    assert (reply.changed, reply.job.state) == (True, "waiting")
    bus.kill(node)
    node = bus.auctioneer()
    assert node.auctioneer.ledger.jobs["b"].spec.due_s == 900.0
    assert not control(bus, "2", Cancel("a"))[0].changed
    bus.serve_for(1.0)
    assert bus.states(node) == ["cancelled", "waiting"]
    assert control(bus, "4", Resume("*"))[0].paused == {}
    bus.until(lambda: bus.states(node) == ["cancelled", "awarded"])
    assert control(bus, "5", Settle("b", "done")) == (None, "'b' is awarded; only an unfinished job can be settled.")
    assert control(bus, "6", Cancel("unknown")) == (None, "There is no job 'unknown'.")
    bus.until(lambda: any(each.number == 3 for each in operations))  # the first ones come again after the restart
    numbered = {(each.epoch, each.number): each.request.request for each in operations}
    assert numbered == {(node.epoch, number): str(number + 1) for number in range(4)}
    assert {each.request.by for each in operations} == {"ann"}
    assert {each.by for each in results if each.status.state == "cancelled"} == {"ann"}
    (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status).messages.values()
    assert [job.repetitions for job in status.jobs] == [1, 1]


def test_an_unfinished_job_is_settled(bus):
    node, arm = bus.auctioneer(), bus.arm("arm_0")
    node.submit(Submission(bus.jobs("a")))
    arm.apply_lease = lambda _: None  # it may commit, and says nothing more
    bus.until(lambda: bus.states(node) == ["finishing"])
    node.end()
    assert bus.states(node) == ["unfinished"]
    assert "over" in control(bus, "1", Settle("a", "redo"))[1]
    assert control(bus, "2", Settle("a", "done"))[0].job.state == "finished"
    bus.kill(node)
    assert bus.states(bus.auctioneer()) == ["finished"]


def test_an_auctioneer_with_a_poisonous_job_goes_on_reports_it_and_has_it_settled(bus):
    """Its journal has a number that was allowed in an earlier version; the job is awarded and finished elsewhere."""
    node = bus.auctioneer()
    node.submit(Submission((*bus.jobs("good"), *bus.jobs("poison", place="bin")), "bob"))
    path = node.journal.path
    bus.kill(node)
    lines = []
    for line in path.read_bytes().splitlines():
        content = json.loads(line)
        for record in content["records"]:
            for job in record.get("jobs", ()) if record["type"] == "jobs_accepted" else ():
                job |= {"dwell_s": 60_000.0} if job["name"] == "poison" else {}
        body = json.dumps(content["records"], separators=(",", ":")).encode()
        lines.append(b'{"crc":"%08x","records":%s}\n' % (zlib.crc32(body), body))
    path.write_bytes(b"".join(lines))
    results = []
    watcher = bus.link()
    watcher.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, each: results.append(each.status))
    arm = bus.arm("arm_0")
    for _ in range(2):  # the second start reads the compacted journal
        node = bus.auctioneer()
        bus.until(lambda: arm.done == ["good"])
        (status,) = bus.ask(keys.of_jobs("f", "status"), StatusRequest(("poison",)), Status).messages.values()
        assert [(job.state, job.reason.startswith("Put aside")) for job in status.jobs] == [("unfinished", True)]
        assert not node.submit(Submission(bus.jobs("poison", place="bin"))).jobs[0].accepted
        bus.kill(node)
    assert "60000" in path.with_suffix(".aside").read_text()
    node = bus.auctioneer()
    bus.until(lambda: any(each.job == "poison" and each.state == "unfinished" for each in results))
    assert control(bus, "1", Settle("poison", "redo"))[0].changed
    assert node.submit(Submission(bus.jobs("poison", place="bin"))).jobs[0].accepted
    bus.until(lambda: arm.done == ["good", "poison"])


@pytest.mark.parametrize("action", [Cancel("a"), Settle("a", "redo"), Change("a", due_s=None), Pause(), Resume("x")])
def test_every_action_travels_as_json(action):
    request = ControlRequest("1", action)
    assert decode(ControlRequest, encode(request)) == request
