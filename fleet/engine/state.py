"""What changes in the simulator during a shift.

Arrays have a leading env axis [env, ...]; a single shift is env = 1.
"""

from typing import NamedTuple, Self

import numpy as np

from fleet.heat.thermal import NODES
from fleet.robot import JOINTS

Array = np.ndarray

WAITING, RUNNING, DONE, GIVEN_UP, EXPIRED = range(5)
"""Status of a job."""
FINISH_JOB, FINISH_CYCLE, BROKEN = 1, 2, 3
"""Kinds of absence: an arm takes no more jobs; it gives its job back after the present cycle, too; or it stops at once
with a failure."""
ABSENCE = np.dtype([("arm", "i4"), ("begin", "i4"), ("end", "i4"), ("kind", "i4")], align=True)
"""Ticks from `begin` to `end` in which an arm takes no jobs; of kind 0 there is none."""


def no_absences() -> Array:
    """Absences of a shift without any, `ABSENCE` [0]."""
    return np.zeros(0, ABSENCE)


LANES = JOINTS + 1
"""Joints padded to what a processor takes at once."""

ARM = np.dtype(
    [
        ("temp_c", "f4", NODES),
        ("peak_c", "f4"),
        ("faults", "i4"),
        ("current_sq", "f4", LANES),
        ("friction_w", "f4", LANES),
        ("housing_c", "f4", LANES),
        ("above_warning_s", "f8"),
        ("busy_s", "f8"),
        ("lost_s", "f8"),
        ("energy_j", "f8"),
        ("progress_s", "f8"),
        ("phase_end_s", "f8"),
        ("clear_at_s", "f8"),
        ("moved_at_s", "f8"),
        ("plan", "i4"),
        ("job", "i4"),
        ("kind", "i4"),
        ("todo", "i4"),
        ("illegal", "i4"),
        ("mode", "i1"),
        ("last_award", "i1"),
        ("pending", "?"),
        ("absent", "i1"),
        ("break_tick", "i4"),
        ("broke", "?"),
        ("unused", "i1", 3),
    ],
    align=True,
)
"""All that changes of an arm, four cache lines, the last of which is all that claims need; see the properties of
`State`. `current_sq` and `friction_w` are the heat drive of the present phase of its plan, which ends when `progress_s`
is `phase_end_s`; `kind` is that of its job, and `pending` whether the job is still to be finished (False on the way
home). `absent` is the kind of the present absence, 0 for none, and
`break_tick` when the next break begins, or the present one began. `broke`: its last fault was a failure, not by
heat."""

JOB = np.dtype(
    [
        ("release_s", "f4"),
        ("due_s", "f4"),
        ("queued_s", "f4"),
        ("finished_s", "f4"),
        ("kind", "i4"),
        ("repetitions", "i4"),
        ("cycles", "i4"),
        ("returns", "i1"),
        ("status", "i1"),
        ("expires", "?"),
        ("passes", "i1"),
    ],
    align=True,
)
"""A job of a shift, half a cache line; see the properties of `State`. `passes` counts the decisions in which an idle
arm did not take it from a slot that others wait for; below 0 since it was put behind the others."""

ENV = np.dtype(
    [
        ("noise_key", "u8"),
        ("ambient_offset_k", "f8"),
        ("next_s", "f8"),
        ("tick", "i4"),
        ("fleet", "i4"),
        ("number", "i4"),
        ("unfinished", "i4"),
        ("given_up", "i4"),
        ("head", "i4"),
        ("turn", "i4"),
        ("alarm", "?"),
        ("changed", "?"),
        ("overfull", "?"),
        ("unused", "i1", 9),
    ],
    align=True,
)
"""A shift. `number` counts its jobs, `unfinished` those neither done nor given up; `head` is where its queue begins.
What is on offer stays as it is until `next_s`, the next release or due date, unless something has `changed`. `turn`
is the tick at which the next absence begins or ends. `alarm`: an arm at work has passed the warning limit in the last
step. `overfull`: more jobs can be claimed than have slots."""


class Column:
    """A field of the records of a `State`, as an array."""

    def __init__(self, records: str, name: str) -> None:
        self._records, self._name = records, name

    def __get__(self, state: "State", owner: type) -> Array:
        """View of the field in all records."""
        return getattr(state, self._records)[self._name]


class State(NamedTuple):
    """All that changes during the shifts; kernels write into the records, whose fields the properties show."""

    env: Array
    """`ENV` [env]."""
    arms: Array
    """`ARM` [env, arm]."""
    jobs: Array
    """`JOB` [env, job]; the jobs of a shift are the first of its row."""
    failed_arm: Array
    """Arms that a job faulted so far, int [env, job, MOST_FAULTS - 1], −1 for none."""
    after: Array
    """Jobs that must be done first, int [env, job, n], −1 for none."""
    queue: Array
    """Waiting jobs, released or not, by queueing time, int [env, job], from `head` to the number of jobs."""
    absences: Array
    """`ABSENCE` [env, absence]."""

    def of_jobs(self, jobs: slice) -> Self:
        """Views of the state with some of the jobs."""
        names = ("jobs", "failed_arm", "after", "queue")
        return self._replace(**{name: getattr(self, name)[:, jobs] for name in names})

    def copy(self, envs: slice = slice(None), jobs: slice = slice(None)) -> Self:
        """The state of some envs and of their first jobs in arrays of its own."""
        return type(self)(*(values[envs].copy() for values in self.of_jobs(jobs)))

    def changed(self, **fields: Array | float) -> Self:
        """A copy in which some of the properties have other values."""
        other = self.copy()
        for name, value in fields.items():
            getattr(other, name)[...] = value
        return other

    def named(self) -> dict[str, Array]:
        """The properties by name."""
        return {name: getattr(self, name) for name, kind in vars(State).items() if isinstance(kind, property | Column)}

    tick = Column("env", "tick")
    """Decision intervals that are over, int [env]."""
    fleet = Column("env", "fleet")
    """Which fleet of the tables, int [env]."""
    number = Column("env", "number")
    """Number of jobs, int [env]."""
    unfinished = Column("env", "unfinished")
    """Jobs neither done nor given up, int [env]."""

    @property
    def done(self) -> Array:
        """Jobs done, int [env]."""
        return self.env["number"] - self.env["unfinished"] - self.env["given_up"]

    temp_c = Column("arms", "temp_c")
    """[env, arm, node]."""

    @property
    def housing_c(self) -> Array:
        """What each arm estimates its housing temperatures to be, [env, arm, joint]."""
        return self.arms["housing_c"][..., :JOINTS]

    mode = Column("arms", "mode")
    """IDLE, WORKING or FAULTED, int [env, arm]."""
    job = Column("arms", "job")
    """Index of the current job, int [env, arm], −1 for none."""
    plan = Column("arms", "plan")
    """Row of the plan table along which the arm is away from home, int [env, arm]; −1 at home."""
    progress_s = Column("arms", "progress_s")
    """How far along it, in its time since leaving home, [env, arm]; a fault stops it."""
    todo = Column("arms", "todo")
    """Cycles the arm set out to do, int [env, arm]."""
    clear_at_s = Column("arms", "clear_at_s")
    """When the fault will be cleared, inf while too hot or not faulted, [env, arm]."""
    moved_at_s = Column("arms", "moved_at_s")
    """When a person will move the faulted arm home, inf if it is there or not faulted, [env, arm]."""
    last_award = Column("arms", "last_award")
    """1 the last claim was won, −1 lost, 0 none was made, int [env, arm]."""
    absent = Column("arms", "absent")
    """FINISH_JOB, FINISH_CYCLE or BROKEN in an absence, else 0, int [env, arm]."""
    faults = Column("arms", "faults")
    """Count so far, int [env, arm]."""
    illegal = Column("arms", "illegal")
    """Illegal actions so far, int [env, arm]."""
    peak_c = Column("arms", "peak_c")
    """Hottest motor so far, [env, arm]."""
    above_warning_s = Column("arms", "above_warning_s")
    """[env, arm]."""
    busy_s = Column("arms", "busy_s")
    """Time away from home, [env, arm]."""
    lost_s = Column("arms", "lost_s")
    """Time faulted, [env, arm]."""
    energy_j = Column("arms", "energy_j")
    """Electrical energy turned to heat, [env, arm]. Over closed cycles mechanical work sums to zero."""
    kind = Column("jobs", "kind")
    """Kind of job, int [env, job]."""
    release_s = Column("jobs", "release_s")
    """[env, job]."""
    due_s = Column("jobs", "due_s")
    """[env, job]."""
    repetitions = Column("jobs", "repetitions")
    """int [env, job]."""
    expires = Column("jobs", "expires")
    """Whether the job expires if it waits after its due date, begun before or not, bool [env, job]."""
    status = Column("jobs", "status")
    """WAITING, RUNNING, DONE, GIVEN_UP or EXPIRED, int [env, job]."""
    queued_s = Column("jobs", "queued_s")
    """When the job was released or last returned, [env, job]."""
    cycles = Column("jobs", "cycles")
    """Cycles finished and kept, int [env, job]."""
    returns = Column("jobs", "returns")
    """How many times a fault returned it to the queue, int [env, job]."""
    finished_s = Column("jobs", "finished_s")
    """NaN until done, [env, job]."""
