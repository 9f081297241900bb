"""Let the wall clocks of participants jump by an hour, a day and ten years, and back, while they work.

A small library (wall_clock.c) is preloaded into each participant, so that Python, Zenoh and all other code see the
jump. This needs no root, and affects no other process.
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

from benchmarks.chaos.fleet_under_test import CannotInject, Fleet
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest

SOURCE = Path(__file__).with_suffix(".c")
BETWEEN_JUMPS_S, MAX_ERROR_S = 1.5, 1.0
"""Real seconds between two jumps; largest permitted growth of the error of an arm's fleet time, which is
seconds after a restart of the auctioneer."""
HOUR_S, DAY_S, YEAR_S = 3600, 86_400, 31_557_600


class WallClocks:
    """Wall clocks of a fleet: a file per participant with its offset in seconds."""

    def __init__(self, folder: Path) -> None:
        """Build the library, and make the folder of clocks.

        Raises:
            CannotInject: there is no C compiler, or the library has no effect here.
        """
        compiler = shutil.which("cc")
        if compiler is None or not sys.platform.startswith("linux"):
            raise CannotInject("a wall clock that jumps needs Linux and a C compiler, cc")
        self._folder = folder
        folder.mkdir(parents=True)
        library = [compiler, "-shared", "-fPIC", "-O1", "-o", str(folder / "wall_clock.so"), str(SOURCE)]
        built = subprocess.run(library, capture_output=True, text=True, check=False)
        if built.returncode:
            raise CannotInject(
                f"{compiler} did not build {SOURCE.name}: {(built.stderr.splitlines() or ['no message'])[0]}"
            )
        self._check_effect()

    def env(self, name: str) -> Mapping[str, str]:
        """Return the environment variables that give a participant its own clock."""
        self.put(name, 0)
        return {"LD_PRELOAD": str(self._folder / "wall_clock.so"), "WALL_CLOCK": str(self._folder / name)}

    def put(self, name: str, ahead_s: int) -> None:
        """Set a clock, in place, because the participant has mapped the file."""
        with (self._folder / name).open("r+b" if (self._folder / name).exists() else "wb") as file:
            file.write(struct.pack("q", ahead_s))

    def _check_effect(self) -> None:
        """Check that a jump has an effect in a process."""
        code = "import sys, time\nfor _ in sys.stdin: print(time.time(), time.monotonic(), flush=True)"
        with subprocess.Popen(
            [sys.executable, "-c", code], env=os.environ | self.env("check"), text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        ) as process:  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            seen: list[tuple[float, ...]] = []
            for ahead_s in (0, YEAR_S):
                self.put("check", ahead_s)
                process.stdin.write("\n")
                process.stdin.flush()
                seen.append(tuple(map(float, process.stdout.readline().split())))
            process.stdin.close()
        jumped_s, passed_s = (second - first for first, second in zip(*seen, strict=True))
        if not (abs(jumped_s - YEAR_S) < 60 and 0 <= passed_s < 60):
            raise CannotInject(f"the clock was to jump by {YEAR_S} s, and jumped by {jumped_s:.0f} s")


def clock_jump(fleet: Fleet) -> float:
    """Let the wall clocks of the participants jump one after the other, then all back."""
    clocks = fleet.clocks
    assert isinstance(clocks, WallClocks)
    arm = fleet.victim()
    other = next(name for name in fleet.arms if name != arm)
    jumps = {
        f"arm-{arm}": HOUR_S,
        fleet.auction: -DAY_S,
        f"arm-{other}": 10 * YEAR_S,
        "router": -HOUR_S,
        "record": DAY_S,
    }
    worst_s, before_s = 0.0, largest_error_s(fleet)
    if math.isinf(before_s):
        fleet.violations.append("no auctioneer replied before the wall clocks jumped")
    for jumped in (jumps, dict.fromkeys(jumps, 0)):
        for name, ahead_s in jumped.items():
            clocks.put(name, ahead_s)
            absent_s = fleet.wait_until(lambda: any(map(fleet.is_absent, fleet.arms)), BETWEEN_JUMPS_S)
            off_s = largest_error_s(fleet)
            worst_s = max(worst_s, off_s)
            if math.isfinite(absent_s) or off_s > before_s + MAX_ERROR_S:
                fleet.violations.append(f"'{name}' jumped to {ahead_s:+d} s: an arm was absent or {off_s:.1f} s off")
    fleet.note(f"{len(jumps)} wall clocks jumped there and back, no arm was more than {worst_s:.1f} s off")
    return math.nan


def largest_error_s(fleet: Fleet) -> float:
    """Return the largest error of an arm's fleet time, real seconds; infinite without a clock."""
    sent_s = time.monotonic()
    replies = fleet.client.query_and_wait(keys.of_clock(fleet.client.fleet), ClockRequest(), Clock, timeout_s=2.0)
    for clock in replies.messages.values():
        middle_s = sent_s + 0.5 * replies.took_s
        states = [fleet.states[arm] for arm in fleet.arms]
        return max(
            abs((state.time_s - clock.time_s) / clock.speed + middle_s - received_s) for received_s, state in states
        )
    return math.inf
