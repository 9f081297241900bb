"""Workers on a Ray cluster: one actor per CPU."""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import signal
from concurrent.futures import Future
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError

from fleet.errors import FleetError
from scenarios.processes import Result, WorkUnit

START_S = 60.0
"""Time to wait for a CPU that another program uses."""


@ray.remote(num_cpus=1, max_restarts=0)
class _Runner:
    def __init__(self) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as other workers do

    def ready(self) -> None:
        """Return when it runs."""

    def run(self, work: WorkUnit[Any]) -> Any:
        return work()


class Cluster:
    """A Ray cluster, and the number of our actors."""

    def __init__(self) -> None:
        self._actors = 0

    def start(self) -> Any:  # Ray makes the class of an actor's handle
        """A new actor; None if every CPU has one."""
        if self._actors >= int(ray.cluster_resources().get("CPU", 0)):
            return None
        self._actors += 1
        return _Runner.options(scheduling_strategy="SPREAD").remote()

    def stop(self, actor: Any) -> None:
        """End an actor, dead or not."""
        ray.kill(actor)
        self._actors -= 1


class RayWorker:
    """One actor."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        self._actor: Any = cluster.start()

    @property
    def started(self) -> bool:
        """Whether a CPU was free."""
        return self._actor is not None

    @property
    def ready(self) -> Any:
        """What ends when the actor begins to run."""
        return self._actor.ready.remote()

    def submit(self, work: WorkUnit[Result]) -> "Future[Result]":
        return self._actor.run.remote(work).future()

    def died(self, error: BaseException) -> bool:
        """Whether an error of its work says that the actor died, or its machine."""
        return isinstance(error, RayError) and not isinstance(error, RayTaskError)

    def renew(self) -> bool:
        """Replace an actor that died; False if its machine is gone, too."""
        self.close()
        self._actor = self._cluster.start()
        return self._actor is not None

    def close(self) -> None:
        if self._actor is not None:
            self._cluster.stop(self._actor)
            self._actor = None


def ray_workers(address: str) -> list[RayWorker]:
    """An actor for each free CPU of a cluster.

    Raises:
        FleetError: there is no cluster at this address, or it has no free CPU.
    """
    if not ray.is_initialized():
        try:
            ray.init(address=address, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise FleetError(
                f"There is no Ray cluster at '{address}' ({reason}). Start one with `ray start --head`, or give "
                "--workers."
            ) from error
    cluster = Cluster()
    workers: list[RayWorker] = []
    while (worker := RayWorker(cluster)).started:
        workers.append(worker)
    begun = {each.ready: each for each in workers}
    ready, waiting = ray.wait(list(begun), num_returns=len(begun), timeout=START_S) if begun else ([], [])
    for each in waiting:
        begun[each].close()  # its CPU is in use
    if not ready:
        raise FleetError(f"The Ray cluster at '{address}' had no free CPU for {START_S:g} s.")
    return [begun[each] for each in ready]
