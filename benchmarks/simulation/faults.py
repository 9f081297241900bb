"""Faults of a simulated fleet, and their end."""

from typing import TYPE_CHECKING, Any

from participants import AUCTIONEER, CLIENT
from world import Process

from fleet.bus.protocol import keys
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Action,
    Cancel,
    Change,
    Cleared,
    ClearRequest,
    Controlled,
    ControlRequest,
    Pause,
    Resume,
    Settle,
)

if TYPE_CHECKING:
    from shift import Shift

LONGEST_WRITES = 60
"""Changing disk calls until a planned crash, at most."""


def _one(shift: "Shift") -> Process:
    return shift.world.processes[shift.rng.choice(shift.names)]


def _arm(shift: "Shift", *, busy: bool = False) -> Process:
    """A process of an arm; with `busy`, one with a job if there is one, preferably in its last cycle."""
    names = list(shift.arms)
    if busy:
        held = {name: shift.node(name).executor.active for name in names if shift.node(name) is not None}
        names = (
            [name for name, active in held.items() if any(each.may_commit for each in active)]
            or [name for name, active in held.items() if active]
            or names
        )
    return shift.world.processes[shift.rng.choice(names)]


def kill(shift: "Shift") -> None:
    """Kill any process."""
    _one(shift).kill("is killed")


def kill_at_work(shift: "Shift") -> None:
    """Kill an arm at work."""
    _arm(shift, busy=True).kill("is killed at work")


def lose_power(shift: "Shift") -> None:
    """Cut the power of any machine."""
    _one(shift).kill("loses power", power=True)


def lose_rack(shift: "Shift") -> None:
    """Kill some processes at once, some of them by a loss of power."""
    for name in shift.names:
        if shift.rng.random() < 0.5:
            shift.world.processes[name].kill("is killed with others", power=shift.rng.random() < 0.5)


def crash_at_write(shift: "Shift") -> None:
    """Let a process crash in one of its next disk calls."""
    disk = _one(shift).disk
    disk.power, disk.crash_in = shift.rng.random() < 0.5, shift.rng.randint(1, LONGEST_WRITES)


def fill_disk(shift: "Shift") -> None:
    """Fill a disk for some time."""
    disk = _one(shift).disk
    disk.full = True
    shift.world.after(shift.rng.uniform(0.5, 30.0), setattr, disk, "full", False)


def fill_log_disk(shift: "Shift") -> None:
    """Fill the disk of the logs for some time."""
    shift.watch.log.full = True
    shift.world.after(shift.rng.uniform(0.5, 30.0), setattr, shift.watch.log, "full", False)


def break_disk(shift: "Shift") -> None:
    """Let one of the next writes fail."""
    _one(shift).disk.broken = shift.rng.randint(1, 10)


def stop(shift: "Shift") -> None:
    """Stop a process for some time."""
    _one(shift).pause(shift.rng.choice([0.5, 2.5, 3.0, 6.1, 20.0]) * shift.rng.uniform(0.9, 1.1))


def stop_at_work(shift: "Shift") -> None:
    """Stop an arm at work for some time, and maybe kill some others."""
    arm = _arm(shift, busy=True)
    _kill_others(shift, arm)
    arm.pause(shift.rng.choice([0.5, 2.5, 3.0, 6.1, 20.0]) * shift.rng.uniform(0.9, 1.1))


def cut(shift: "Shift") -> None:
    """Cut the network in two groups for some time."""
    group = {name: shift.rng.randrange(2) for name in shift.world.processes}
    _cut(shift, group, shift.rng.choice([1.0, 5.0, 10.0, 40.0]))


def cut_off_at_work(shift: "Shift") -> None:
    """Cut one arm at work off for some time, and maybe kill some others."""
    arm = _arm(shift, busy=True)
    _cut(shift, {arm.name: 1}, shift.rng.choice([3.0, 7.0, 15.0, 40.0]))
    _kill_others(shift, arm)


def _kill_others(shift: "Shift", arm: Process) -> None:
    share = shift.rng.choice([0.0, 0.0, 0.5, 1.0])
    for name in shift.names:
        if name != arm.name and shift.rng.random() < share:
            shift.world.processes[name].kill("is killed meanwhile")


def swizzle(shift: "Shift") -> None:
    """Cut processes off one after another, and connect them again in another order, as FoundationDB does."""
    names = [name for name in shift.world.processes if shift.rng.random() < 0.6]
    after_s = 0.0
    for group in (1, 0):
        shift.rng.shuffle(names)
        for number, name in enumerate(names):
            shift.world.after(after_s, _isolate, shift, name, group * (number + 1))
            after_s += shift.rng.uniform(0.0, 4.0)


def _isolate(shift: "Shift", name: str, group: int) -> None:
    if shift.healed:
        return
    groups = {process.name: process.group for process in shift.world.processes.values()} | {name: group}
    shift.world.split({name: group for name, group in groups.items() if group})


def lose_router(shift: "Shift") -> None:
    """Let nobody reach anybody for some time."""
    _cut(shift, {name: i for i, name in enumerate(shift.world.processes)}, shift.rng.choice([0.5, 3.0, 10.0]))


def _cut(shift: "Shift", group: dict[str, int], seconds: float) -> None:
    shift.world.split(group)
    shift.world.after(seconds * shift.rng.uniform(0.7, 1.3), shift.world.split, {})


def lose_messages(shift: "Shift") -> None:
    """Lose, double and delay messages for some time."""
    world, rng = shift.world, shift.rng
    world.loss, world.doubling = rng.choice([0.0, 0.05, 0.3, 0.7]), rng.choice([0.0, 0.05, 0.3])
    world.slow = rng.choice([1.0, 3.0, 30.0])
    world.after(rng.uniform(1.0, 30.0), calm, shift)


def calm(shift: "Shift") -> None:
    """End the loss of messages."""
    shift.world.loss, shift.world.doubling, shift.world.slow = 0.0, 0.0, 1.0


def overheat(shift: "Shift") -> None:
    """Let an arm fault."""
    process = _arm(shift, busy=True)
    node: Any = process.node
    machine = shift.builders[process.name].machine
    if node is not None and machine is not None:
        if node.executor.active:
            shift.faults.setdefault(node.executor.active[0].job, []).append(process.name)
        machine.fail(shift.rng.uniform(1.0, 20.0) * shift.speed)


def break_machine(shift: "Shift") -> None:
    """Kill an arm that does not start again for some time; a person moves it home and frees its space."""
    process = _arm(shift, busy=True)
    process.broken = True
    process.kill("breaks down")
    shift.world.after(shift.rng.uniform(3.0, 15.0), clear, shift, process.name)
    shift.world.after(shift.rng.uniform(20.0, 60.0), setattr, process, "broken", False)


def move_home(shift: "Shift") -> None:
    """Cut a working arm off; a person moves it home and frees its space, and its process lives on."""
    process = _arm(shift, busy=True)
    _cut(shift, {process.name: 1}, shift.rng.choice([10.0, 20.0]))
    shift.world.after(shift.rng.uniform(4.0, 12.0), clear, shift, process.name)


def clear(shift: "Shift", arm: str) -> None:
    """Have a person move an arm home, and free its space unless that is refused."""
    process = shift.world.processes[arm]
    if process.up and process.group == 0:
        return  # a person sees on the bus that it is there
    node: Any = process.node
    machine = shift.builders[arm].machine
    shift.world.log("person", f"moves '{arm}' home, and asks to free its space")
    if node is not None and machine is not None:
        shift.unsure |= {active.job for active in node.executor.active if active.may_commit}
        machine.move_home()
        machine.set_time(node.clock.now_s(process.real_s))  # it does nothing in the time before, either
    shift.is_home(arm)
    link: Any = shift.world.processes[CLIENT].client
    link.query(keys.of_jobs("f", "clear"), ClearRequest(arm, "a person"), Cleared, lambda _: None, timeout_s=2.0)


def steer(shift: "Shift") -> None:
    """Have a person cancel, settle or change a job, or pause arms; a person knows what was done."""
    if not shift.submitter.accepted:
        return
    node: Any = shift.node(AUCTIONEER) if AUCTIONEER in shift.names else None
    entries = {} if node is None else node.auctioneer.ledger.jobs
    unfinished = [name for name, entry in entries.items() if entry.state == "unfinished"]  # a person sees them
    job = shift.rng.choice(unfinished or list(shift.submitter.accepted))
    arm = shift.rng.choice([ALL_ARMS, *shift.arms])
    actions: list[Action] = [Cancel(job), Change(job, value=shift.rng.random()), Pause(arm), Resume()]
    if shift.finished.get(job):
        actions.append(Settle(job, "done"))
    elif not shift.begun.get(job):
        actions.append(Settle(job, "redo"))
    request(shift, shift.rng.choice(actions))


def request(shift: "Shift", action: Action) -> None:
    """Send a request of a person, again until there is a reply or the fleet is healed; and sometimes once more."""
    if isinstance(action, Cancel):
        shift.cancelled.add(action.job)
    message = ControlRequest(str(shift.world.now_s), action, "a person")
    shift.world.log("person", f"requests {action}")
    link: Any = shift.world.processes[CLIENT].client

    def send() -> None:
        link.query(keys.of_jobs("f", "control"), message, Controlled, done, timeout_s=2.0)

    def done(replies: Any) -> None:
        if not (replies.messages or any(replies.refused.values()) or shift.healed):
            send()

    send()
    if not shift.healed and shift.rng.random() < 0.3:
        shift.world.after(shift.rng.uniform(0.0, 30.0), send)


def kill_supervisor(shift: "Shift") -> None:
    """Kill the supervisor, and with it all processes."""
    if shift.rng.random() < 0.3:
        shift.watch.kill()


FAULTS = (
    *(kill, kill_at_work, lose_power, crash_at_write, crash_at_write, fill_disk, break_disk, stop, stop_at_work, cut),
    *(cut_off_at_work, cut_off_at_work, lose_router, lose_messages, lose_messages, overheat, break_machine, move_home),
    *(kill_supervisor, fill_log_disk, lose_rack, swizzle, steer, steer),
)


def heal(shift: "Shift") -> None:
    """End all faults; the network stays as slow as it is."""
    calm(shift)
    shift.healed = True
    shift.world.split({})
    shift.watch.log.full = False
    for process in shift.world.processes.values():
        process.disk.full, process.disk.broken, process.disk.crash_in, process.broken = False, 0, 0, False
        process._resume(process.boot)
    shift.world.log("shift", "heals")
