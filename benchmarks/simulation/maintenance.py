"""What people do to the processes of a fleet, mistakes included, by a random stream of its own.

An arm or the auctioneer is started with an older copy of its journals or without them, the auctioneer for other arms,
and a second auctioneer beside the first. Where the product refuses that, a person restores the journals or starts with
`--new-epoch`. Arms have breaks, and the shift may end.

Not simulated, as the documented limits (docs/bus/auctioneer.md) permit that jobs are done twice then:

- lost journals, or a second auctioneer, while an arm is offline or the network is cut: so the other faults end before;
- copies from before another journal was lost or an arm left: nobody may know what was done in between;
- without an auctioneer, a copy of which a peer knows no later start, and what is left of jobs that have left the books.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any, NamedTuple

from benchmarks.simulation.participants import AUCTIONEER, CLIENT
from benchmarks.simulation.simulated_fleet import FIRST, Fleet
from benchmarks.simulation.world import Process, Violation
from fleet.breaks import Break
from fleet.bus.protocol import keys
from fleet.bus.protocol.operator import Cleared, ClearRequest
from fleet.live.consensus.grants import NUMBERS_PER_BOOT

LAST_DIGITS = (1, 2, 8)
"""Of the seeds with maintenance: the seeds by which earlier faults of the product were detected end otherwise."""
SECOND = "second auctioneer"
"""Process of it; its name on the bus may be that of the first."""
MAX_COPIES = 8
"""Kept of each process."""
ONLINE_S = 60.0
"""Real seconds to wait until all processes are online."""
REFUSED_S = 8.0
"""Real seconds after which a person sees that a process refuses its journals."""
QUIET_S = 40.0
"""Real seconds without other faults after journals are lost."""
RETRY_S = 3.0
"""Real seconds between two requests to free the space of an arm that has left."""
ENDED_S, BREAK_S = 40.0, 5.0
"""Real seconds after which no arm departs: after the end of the shift (leases, retries), and after the begin of a break
that ends the cycle."""


class Copy(NamedTuple):
    """Files of an exited process."""

    files: dict[str, bytes]
    first_number: int
    """Of the claims of its last start, without an auctioneer; otherwise 0."""


class Maintenance:
    """What people do in one shift.

    Attributes:
        absent: Arms outside the roster.
        ends_s: True second at which the shift ends, about; inf if it does not.
    """

    def __init__(self, fleet: Fleet, seed: int) -> None:
        self._fleet, self._world, self._rng = fleet, fleet.world, Random(f"maintenance {seed}")
        rng = self._rng
        self.absent: tuple[str, ...] = ()
        self.ends_s = self._ended_s = math.inf
        self._copies: dict[str, list[Copy]] = {}
        self._arm_forgets = False
        """An arm has left or lost its journals: what it has done only the auctioneer may know."""
        tasks = [self._lose_journals] if fleet.alone else [self._lose_journals, self._start_second, self._change_roster]
        self._tasks = [task for task in tasks if rng.random() < 0.6] or tasks
        self._gap_s = rng.choice([60.0, 120.0, 240.0])
        if self._change_roster in self._tasks and len(fleet.arms) > 2 and rng.random() < 0.5:
            self._set_roster(fleet.arms[:-1])
            fleet.build_auctioneer()

    def plan(self, until_s: float) -> None:
        """Plan breaks of the arms, the end of the shift, and what is done up to a true time."""
        rng, speed = self._rng, self._fleet.speed
        if rng.random() < 0.25:
            self.ends_s = rng.uniform(0.3, 1.0) * until_s
            self._plan_end()
        for builder in self._fleet.builders.values() if rng.random() < 0.5 else ():
            begins_s = [rng.uniform(0.0, until_s) * speed for _ in range(rng.randint(1, 3))]
            builder.breaks = tuple(
                Break(
                    name="break",
                    begin_s=begin_s,
                    end_s=begin_s + rng.uniform(3.0, 30.0) * speed,
                    finish=rng.choice(["cycle", "job"]),
                )
                for begin_s in begins_s
            )
        at_s = rng.expovariate(1.0 / self._gap_s)
        while at_s < until_s:
            self._world.at(at_s, self._begin)
            at_s += rng.expovariate(1.0 / self._gap_s)

    def _plan_end(self) -> None:
        fleet = self._fleet
        if not fleet.alone:
            self._world.at(self.ends_s, self._end_shift)
        for builder in fleet.builders.values() if fleet.alone else ():
            assert builder.membership is not None
            builder.membership = replace(builder.membership, horizon_s=self.ends_s * fleet.speed)

    def _end_shift(self) -> None:
        """Have the process of the auctioneer end the shift, also again after a restart."""
        process = self._world.processes[AUCTIONEER]
        node: Any = process.node
        if node is not None and not process.paused and not node.book.ended:
            self._ended_s = min(self._ended_s, self._world.now_s)
            process._call(node.end)
        self._world.after(1.0, self._end_shift)

    @property
    def ends(self) -> bool:
        """Whether the shift ends."""
        return self.ends_s < math.inf

    def check_departure(self, arm: str) -> None:
        """Check that an arm may leave home at this time.

        Raises:
            Violation: it has a break, or the shift is over.
        """
        fleet, builder, node = self._fleet, self._fleet.builders[arm], self._fleet.node(arm)
        if builder.machine is None or any(active.may_commit for active in node.executor.active):
            return
        time_s, late_s = builder.machine.time_s, BREAK_S * fleet.speed
        ended_s = time_s / fleet.speed - self.ends_s if fleet.alone else self._world.now_s - self._ended_s
        if ended_s > ENDED_S:
            raise Violation(f"'{arm}' leaves home after the end of the shift.")
        if any(each.finish == "cycle" and each.begin_s + late_s < time_s < each.end_s for each in builder.breaks):
            raise Violation(f"'{arm}' leaves home in a break.")

    def keep_copy(self, process: Process) -> None:
        """Copy the journals of an exited process, unless others have just lost theirs."""
        fleet, name = self._fleet, process.name
        number = fleet.builders[name].first_number if fleet.alone and name in fleet.builders else 0
        if self._world.now_s >= fleet.quiet_until_s and number is not None:
            copies = self._copies.setdefault(name, [])
            copies.append(Copy(process.disk.copy(), number))
            del copies[:-MAX_COPIES]

    # Inside

    def _begin(self) -> None:
        if self._world.now_s >= self._fleet.quiet_until_s and not self._fleet.redone:
            self._rng.choice(self._tasks)()

    def _when_online(self, task: Callable[[], None]) -> None:
        """End the other faults, and do a task as soon as all processes are online."""
        fleet, patience_s = self._fleet, self._world.now_s + ONLINE_S
        fleet.quiet_until_s = math.inf
        fleet.end_faults()

        def check() -> None:
            if all(map(self._is_online, fleet.names)):
                task()
            elif self._world.now_s < patience_s:
                self._world.after(0.5, check)
            else:
                fleet.quiet_until_s = self._world.now_s

        check()

    def _is_online(self, name: str) -> bool:
        node = self._fleet.node(name)
        return node is not None and (not self._fleet.alone or name not in self._fleet.arms or node.work_source._joined)

    def _be_quiet(self, seconds: float) -> None:
        """Let no faults begin, and lost jobs be submitted again."""
        self._fleet.quiet_until_s = self._fleet.forgetful_until_s = self._world.now_s + seconds

    def _log(self, what: str) -> None:
        self._world.log("person", what)

    # Journals

    def _lose_journals(self) -> None:
        if self._fleet.alone or self._rng.random() < 0.5:
            self._when_online(self._swap)
        else:
            self._swap_of_arm()

    def _swap_of_arm(self) -> None:
        """Have an arm start with an older copy of its journal or without it, beside an auctioneer and other faults."""
        name = self._rng.choice(self._fleet.arms)
        process = self._world.processes[name]
        if process.node is not None:
            files = self._rng.choice([{}, *(copy.files for copy in self._copies.get(name, []))])
            self._log(f"starts '{name}' with {'an older copy of' if files else 'deleted'} journals")
            self._forget(name)
            process.kill("is stopped")
            process.disk.restore(files)

    def _forget(self, name: str) -> None:
        self._fleet.forget(name)
        self._copies.clear()
        self._ended_s = math.inf
        self._arm_forgets |= name in self._fleet.arms

    def _swap(self) -> None:
        """Have a process, and maybe others, start with an older copy of its journals or without them."""
        fleet, rng = self._fleet, self._rng
        name = AUCTIONEER if not fleet.alone else rng.choice(fleet.arms)
        process = self._world.processes[name]
        choices = [copy.files for copy in self._copies.get(name, []) if self._is_noticed(name, copy.first_number)]
        choices += [{}] if self._may_delete(name) else []
        if not choices:
            fleet.quiet_until_s = self._world.now_s
            return
        files = rng.choice(choices)
        needs_remedy = fleet.alone or (name == AUCTIONEER and not files and any(self._epochs()))
        if fleet.alone and not files and rng.random() < 0.5:
            part = rng.choice(["awards", "grants"])
            files = {file: content for file, content in process.disk.copy().items() if not file.startswith(part)}
            needs_remedy = part == "grants"  # the grants of the arm name its claims
        self._log(f"starts '{name}' with {'an older copy of' if files else 'deleted'} journals: {sorted(files)}")
        self._forget(name)
        process.kill("is stopped")
        right = process.disk.copy()
        process.disk.restore(files)
        for other in fleet.names:
            if other != name and not fleet.alone and rng.random() < 0.2:
                self._world.processes[other].kill("is restarted too")
        self._be_quiet(QUIET_S)
        if needs_remedy:
            self._world.after(rng.choice([0.0, REFUSED_S, REFUSED_S]), self._remedy, process, right)

    def _is_noticed(self, name: str, first_number: int) -> bool:
        """Whether all peers know a later start of an arm without an auctioneer."""
        if not self._fleet.alone:
            return True
        peers = (self._fleet.node(arm).work_source.book for arm in self._fleet.arms if arm != name)
        return all(book.epoch and book.numbers.get(name, -1) >= first_number + NUMBERS_PER_BOOT for book in peers)

    def _may_delete(self, name: str) -> bool:
        return self._is_noticed(name, 0) and not (name == AUCTIONEER and self._arm_forgets)

    def _epochs(self) -> list[str]:
        return [builder.epoch for name, builder in self._fleet.builders.items() if name in self._fleet.arms]

    def _remedy(self, process: Process, right: dict[str, bytes]) -> None:
        """Restore the journals that a process refuses, or start it with `--new-epoch`.

        Raises:
            Violation: it has not refused them.
        """
        fleet, name = self._fleet, process.name
        if self._is_online(name) and not (name == AUCTIONEER and fleet.node(name)._epochs.objection):
            raise Violation(f"'{name}' takes part without the journals that others know.")
        process.kill("is stopped")
        if self._rng.random() < 0.3:
            self._log(f"restores the journals of '{name}'")
            process.disk.restore(right)
            return
        self._log(f"starts '{name}' with --new-epoch")
        if name == AUCTIONEER:
            process.disk.restore({})
            fleet.build_auctioneer(new_epoch=True)
            self._world.after(QUIET_S / 2, fleet.build_auctioneer)
        else:
            fleet.builders[name].new_epoch = True
            self._world.after(QUIET_S / 2, setattr, fleet.builders[name], "new_epoch", False)

    # A second auctioneer

    def _start_second(self) -> None:
        self._when_online(self._run_second)

    def _run_second(self) -> None:
        """Start another auctioneer for some time, maybe with a copy of the journal, and maybe restart the first."""
        fleet, rng, world = self._fleet, self._rng, self._world
        if not all(self._epochs()):  # the first one would have to be stopped if the second was the first to award
            fleet.quiet_until_s = world.now_s
            return
        copies = self._copies.get(AUCTIONEER, [])
        name, files = rng.choice(
            [(AUCTIONEER, {}), ("auctioneer_2", {}), *((AUCTIONEER, each.files) for each in copies)]
        )
        second = world.processes.get(SECOND) or Process(world, SECOND, lambda _: None)  # type: ignore[arg-type]
        second._build = fleet.auctioneer_builder(name=name)
        second.disk.restore(files)
        self._log(f"starts a second auctioneer '{name}' with {sorted(files)}")
        self._forget(AUCTIONEER)
        self._forget(name)
        if rng.random() < 0.6:
            world.after(rng.uniform(0.0, 3.0), world.processes[AUCTIONEER].kill, "is killed meanwhile")
        world.after(rng.uniform(0.0, 3.0), second.start)
        ends_s = rng.uniform(4.0, 20.0)
        world.after(ends_s, self._stop_second, second)
        self._be_quiet(ends_s + QUIET_S)

    def _stop_second(self, second: Process) -> None:
        self._forget(AUCTIONEER)  # which may have been replaced for some time
        second.kill("is stopped")

    # The roster

    def _set_roster(self, arms: tuple[str, ...]) -> None:
        fleet = self._fleet
        everyone = tuple(fleet.builders)
        fleet.arms = tuple(arm for arm in everyone if arm in arms)
        self.absent = tuple(arm for arm in everyone if arm not in arms)
        fleet.names = tuple(name for name in fleet.all_names if name not in self.absent)
        for arm in everyone:
            self._world.processes[arm].broken = arm in self.absent

    def _change_roster(self) -> None:
        """Have an arm leave for good or join, and restart the auctioneer for the present ones."""
        fleet, rng = self._fleet, self._rng
        leaving = [arm for arm in fleet.arms if arm != FIRST]
        if self.absent and (not leaving or rng.random() < 0.5):
            arm = rng.choice(self.absent)
            self._log(f"adds '{arm}'")
            self._set_roster((*fleet.arms, arm))
        elif leaving:
            arm = rng.choice(leaving)
            self._log(f"removes '{arm}' for good")
            fleet.doubt(arm)
            self._copies.clear()
            self._arm_forgets = True
            fleet.retire(self._world.processes[arm])
            self._set_roster(tuple(each for each in fleet.arms if each != arm))
            self._free_space(arm)
        else:
            return
        fleet.build_auctioneer()
        self._world.after(rng.uniform(0.0, 10.0), self._world.processes[AUCTIONEER].kill, "restarts for other arms")

    def _free_space(self, arm: str) -> None:
        """Free the space of an arm that has left; repeat the request until there is a reply."""
        if arm not in self.absent:
            return
        link: Any = self._world.processes[CLIENT].client

        def done(replies: Any) -> None:
            if not replies.messages:
                self._world.after(RETRY_S, self._free_space, arm)

        if self._world.processes[arm].up:
            self._world.after(RETRY_S, self._free_space, arm)
        else:
            self._fleet.is_home(arm)
            link.query(keys.of_jobs("f", "clear"), ClearRequest(arm, "a person"), Cleared, done, timeout_s=2.0)
