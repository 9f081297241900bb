"""The wall clock of a participant jumps: by an hour, a day, ten years, there and back, while it works.

A small library (wall_clock.c) stands before the C library of each participant, so that all of it sees the jump: Python,
Zenoh and what else asks for the time of day. Nobody needs root for that, and no other process is touched.
"""

import math
import os
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from struck import CannotStrike, Fleet

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest

SOURCE = Path(__file__).with_suffix(".c")
EACH_S, OFF_S = 1.5, 1.0
"""Real seconds between two jumps; by which an arm may be off the fleet's time."""
HOUR_S, DAY_S, YEAR_S = 3600, 86_400, 31_557_600


class WallClocks:
    """The wall clocks of the participants of a fleet, each a file with its seconds ahead of the true one."""

    def __init__(self, folder: Path) -> None:
        """Make the library and the folder of clocks.

        Raises:
            CannotStrike: there is no C compiler, or the library has no effect here.
        """
        compiler = shutil.which("cc")
        if compiler is None or not sys.platform.startswith("linux"):
            raise CannotStrike("a wall clock that jumps needs Linux and a C compiler, cc")
        self._folder = folder
        folder.mkdir(parents=True)
        library = [compiler, "-shared", "-fPIC", "-O1", "-o", str(folder / "wall_clock.so"), str(SOURCE)]
        built = subprocess.run(library, capture_output=True, text=True, check=False)
        if built.returncode:
            raise CannotStrike(
                f"{compiler} did not build {SOURCE.name}: {(built.stderr.splitlines() or ['it says nothing'])[0]}"
            )
        self._prove()

    def env(self, name: str) -> Mapping[str, str]:
        """The environment in which a participant lives by its own clock."""
        self.put(name, 0)
        return {"LD_PRELOAD": str(self._folder / "wall_clock.so"), "WALL_CLOCK": str(self._folder / name)}

    def put(self, name: str, ahead_s: int) -> None:
        """Set a clock; in place, as its owner has the file mapped."""
        with (self._folder / name).open("r+b" if (self._folder / name).exists() else "wb") as file:
            file.write(struct.pack("q", ahead_s))

    def _prove(self) -> None:
        """See a process jump, so that no harmless jump is one that never was."""
        code = "import sys, time\nfor _ in sys.stdin: print(time.time(), time.monotonic(), flush=True)"
        with subprocess.Popen(
            [sys.executable, "-c", code], env=os.environ | self.env("proof"), text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        ) as process:  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            seen: list[tuple[float, ...]] = []
            for ahead_s in (0, YEAR_S):
                self.put("proof", ahead_s)
                process.stdin.write("\n")
                process.stdin.flush()
                seen.append(tuple(map(float, process.stdout.readline().split())))
            process.stdin.close()
        jumped_s, passed_s = (second - first for first, second in zip(*seen, strict=True))
        if not (abs(jumped_s - YEAR_S) < 60 and 0 <= passed_s < 60):
            raise CannotStrike(f"the clock was to jump by {YEAR_S} s, and jumped by {jumped_s:.0f} s")


def clock_jump(fleet: Fleet) -> float:
    """One participant after the other sees its wall clock jump, and at the end all jump back."""
    clocks = fleet.clocks
    assert isinstance(clocks, WallClocks)
    arm = fleet.working() or fleet.arms[0]
    other = next(name for name in fleet.arms if name != arm)
    jumps = {
        f"arm-{arm}": HOUR_S,
        fleet.auction: -DAY_S,
        f"arm-{other}": 10 * YEAR_S,
        "router": -HOUR_S,
        "record": DAY_S,
    }
    worst_s = 0.0
    for jumped in (jumps, dict.fromkeys(jumps, 0)):
        for name, ahead_s in jumped.items():
            clocks.put(name, ahead_s)
            unwell_s = fleet.until(lambda: any(map(fleet.unwell, fleet.arms)), EACH_S)
            off_s = furthest_off_s(fleet)
            worst_s = max(worst_s, off_s)
            if math.isfinite(unwell_s) or off_s > OFF_S:
                fleet.wrong.append(f"'{name}' jumped to {ahead_s:+d} s: an arm was unwell or {off_s:.1f} s off")
    fleet.note(f"{len(jumps)} wall clocks jumped there and back, no arm was more than {worst_s:.1f} s off")
    return math.nan


def furthest_off_s(fleet: Fleet) -> float:
    """By how many real seconds the arm that is furthest off differs from the fleet's time; infinite if nobody tells."""
    asked_s = time.monotonic()
    answers = fleet.link.query_and_wait(keys.of_clock(fleet.link.fleet), ClockRequest(), Clock, timeout_s=2.0)
    for clock in answers.messages.values():
        middle_s = asked_s + 0.5 * answers.took_s
        states = [fleet.states[arm] for arm in fleet.arms]
        return max(abs((said.time_s - clock.time_s) / clock.speed + middle_s - heard_s) for heard_s, said in states)
    return math.inf
