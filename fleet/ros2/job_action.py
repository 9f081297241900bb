"""An action server of ROS 2 that submits jobs to the fleet: `thermofleet_msgs/action/DoJob`.

Needs `rclpy` and the package in `fleet/ros2/thermofleet_msgs`, built in a ROS 2 workspace. It works with every
middleware of ROS 2, DDS too, because it uses rclpy.
"""

# ROS 2 is not on the package index as a whole, so its types are unknown here.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import logging
import time
from collections import defaultdict
from typing import Any  # classes that ROS 2 generates

import msgspec
import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from thermofleet_msgs.action import DoJob

from fleet.bus.client import BusClient
from fleet.bus.protocol.auction import SETTLED, JobSpec, JobStatus
from fleet.live.job_client import JobClient
from fleet.ros2.conversion import plain_name

_LOG = logging.getLogger(__name__)

TURN_S = 0.02
"""Real seconds of one wait for ROS 2."""


class JobAction:
    """`with JobAction(link) as jobs: jobs.serve(until_s)` in a loop; the link is open.

    A goal is accepted, submitted and followed; its result is the outcome of the job. An invalid job is aborted with
    the reason. The feedback is the state of the job, whenever it changes.
    """

    def __init__(self, link: BusClient, *, domain: int | None = None) -> None:
        self._link = link
        self._client = JobClient(link, "ROS 2", self._report)
        self._goals: dict[str, list[tuple[Any, Future]]] = defaultdict(list)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("thermofleet_jobs", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self.name = f"/{plain_name(link.fleet)}/do_job"
        self._server = ActionServer(
            self._node, DoJob, self.name, execute_callback=self._execute, cancel_callback=self._cancel
        )

    def __enter__(self) -> "JobAction":
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.destroy()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def serve(self, until_s: float) -> None:
        """Serve goals until the real second `until_s`."""
        while time.monotonic() < until_s:
            self._executor.spin_once(timeout_sec=TURN_S)
            self._link.serve()
            self._client.step()

    async def _execute(self, goal: Any) -> Any:
        try:
            spec = job_of(goal.request, "ros2-" + bytes(goal.goal_id.uuid).hex())
        except msgspec.ValidationError as error:
            goal.abort()
            return _filled(DoJob.Result(), JobStatus("?", "given_up", reason=f"No possible job: {error}."))
        ended = Future(executor=self._executor)
        self._goals[spec.name].append((goal, ended))
        self._client.submit(spec)
        status = await ended
        if status.state == "finished":
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return _filled(DoJob.Result(), status)

    def _cancel(self, goal: Any) -> CancelResponse:
        own = [job for job, goals in self._goals.items() if any(each.goal_id == goal.goal_id for each, _ in goals)]
        for job in own:
            if reason := self._client.cancel(job):
                _LOG.warning("Job '%s' is not cancelled: %s", job, reason)
                return CancelResponse.REJECT
        return CancelResponse.ACCEPT

    def _report(self, status: JobStatus) -> None:
        for goal, ended in self._goals[status.job]:
            if status.state in SETTLED:
                ended.set_result(status)
            else:
                goal.publish_feedback(_filled(DoJob.Feedback(), status))
        if status.state in SETTLED:
            del self._goals[status.job]
            self._client.forget(status.job)


def job_of(goal: Any, name: str) -> JobSpec:
    """The job of a goal.

    Args:
        name: For a goal without one.

    Raises:
        msgspec.ValidationError: it is no possible job.
    """
    fields = {field: getattr(goal, field) for field in JobSpec.__struct_fields__}
    fields |= {"name": goal.name or name, "places": list(goal.places), "after": list(goal.after)}
    fields["due_s"] = None if goal.due_s < 0 else goal.due_s
    return msgspec.convert(fields, JobSpec)


def _filled(message: Any, status: JobStatus) -> Any:
    """A result or feedback with the state of a job."""
    for field in ("state", "arm", "cycles", "reason"):
        setattr(message, field, getattr(status, field))
    return message
