"""The planned motion of a scenario's job as a recording."""

import numpy as np

from fleet.errors import FleetError, nearest
from fleet.motion import RATE_HZ
from scenarios.prepare.fleet import prepare_arm
from scenarios.progress import Progress, quiet
from scenarios.spec.jobs import works_of
from scenarios.spec.load import load
from twin.logs.reader import SUFFIXES as LOGS
from twin.logs.recording import Recording

SUFFIX = ".toml"
"""Of scenario files."""


def motion_of(job: str, arm: str | None = None, progress: Progress = quiet) -> tuple[Recording, int]:
    """One cycle of the arm's first plan for a job stream of a scenario, with its first payload; and its most cycles.

    Args:
        job: SCENARIO/JOB.
        arm: Default: the first arm of the scenario that can do the job.

    Raises:
        FleetError: there is no such scenario, job or arm, or the arm cannot do the job.
    """
    file, suffix, stream = job.partition(f"{SUFFIX}/")  # names of jobs may have slashes
    name, slash, stream = (file + suffix[:-1], suffix, stream) if suffix else job.rpartition("/")
    if not slash or job.lower().endswith(LOGS):
        raise FleetError(f"--plan must be a file, or SCENARIO/JOB as quickstart/hold_part; there is no file '{job}'.")
    scenario = load(name)
    streams = {each.name: each for each in scenario.jobs}
    if stream not in streams:
        raise FleetError(f"'{name}' has no job '{stream}'{nearest(stream, streams)}")
    works, tried = works_of(scenario, streams[stream]), [each.name for each in scenario.arms] if arm is None else [arm]
    for each in tried:
        robot = prepare_arm(scenario, each, difficulty="blind", progress=progress)
        plans = [plan for work in works for plan in robot.plans.get(work, ())]
        if plans:
            break
    else:
        raise FleetError(f"No plan of {', '.join(tried)} for '{stream}': `thermofleet layout {name}` shows why.")
    work, profile = plans[0].work, np.asarray(plans[0].cycle.profile, dtype=float)
    q, qd, tau = profile.transpose(1, 0, 2)
    places = " → ".join(place.name for place in work.places)
    title = f"{job} by {robot.robot.name}: {work.kind} {work.payload_kg:g} kg at {places}"
    motion = Recording(name=title, time_s=np.arange(len(profile)) / RATE_HZ, q=q, qd=qd, tau=tau)
    return motion, streams[stream].repetitions[1]
