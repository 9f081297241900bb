"""Arms in network namespaces of their own, each on a cable that can be pulled: the kernel's partition, for root alone.

Every arm has a pair of virtual Ethernet interfaces to the router's side; a cut takes the router's end down, so packets
are lost on the way as with a real cable. Beyond loopback the bus wants certificates, so such a fleet runs with TLS, as
one on several machines does. Addresses are of 198.18.0.0/15, which is kept for measurements (RFC 2544). What is left
behind by a campaign that was killed is cleared away by the next.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Self

from fleet.errors import FleetError
from fleet.live.supervisor import Part

_NAMED = re.compile(r"tf(?P<pid>\d+)-\d+")
_COMMAND_S = 10.0


class Namespaces:
    """`with Namespaces(arms, port) as cables:` gives each arm a namespace, until the end of the block.

    Attributes:
        hosts: Addresses under which the router is reached from there, by arm.
    """

    by = "netns"

    def __init__(self, arms: Sequence[str], port: int) -> None:
        self._port, self._names = port, {arm: f"tf{os.getpid()}-{number}" for number, arm in enumerate(arms)}
        self.hosts = {arm: f"198.18.{number}.1" for number, arm in enumerate(arms)}
        self._resources = ExitStack()

    def __enter__(self) -> Self:
        """Make them.

        Raises:
            FleetError: this machine does not let us; nothing is left behind.
        """
        clear_away()
        try:
            for arm, name in self._names.items():
                self._make(name, self.hosts[arm])
        except BaseException:
            self._resources.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    def through(self, part: Part, arm: str) -> Part:
        """The part in the arm's namespace, where the router has another address."""
        there = tuple(word.replace(f"127.0.0.1:{self._port}", f"{self.hosts[arm]}:{self._port}") for word in part.argv)
        return replace(part, argv=("ip", "netns", "exec", self._names[arm], *there))

    def cut(self) -> None:
        """Pull all the cables."""
        for name in self._names.values():
            _ip("link", "set", name, "down")

    def heal(self) -> None:
        """Plug them in again."""
        for name in self._names.values():
            _ip("link", "set", name, "up")

    def _make(self, name: str, host: str) -> None:
        """A namespace and a cable, whose end here has the namespace's name."""
        inner = host.removesuffix(".1") + ".2"
        _ip("netns", "add", name)
        self._resources.callback(_forget, name)
        _ip("link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", name)
        _ip("addr", "add", f"{host}/30", "dev", name)
        _ip("link", "set", name, "up")
        for command in (
            ("addr", "add", f"{inner}/30", "dev", "eth0"),
            *(("link", "set", i, "up") for i in ("eth0", "lo")),
        ):
            _ip("-n", name, *command)


def why_not() -> str:
    """Why there can be no namespaces here; "" if there can."""
    if not sys.platform.startswith("linux") or shutil.which("ip") is None:
        return "network namespaces need Linux and its command ip"
    if os.geteuid() != 0:
        return "network namespaces need root"
    try:
        with Namespaces(["probe"], 1):
            return ""
    except FleetError as error:
        return str(error)


def clear_away() -> None:
    """Forget what campaigns left behind that are no longer there."""
    for line in _ip("netns", "list").splitlines():
        found = _NAMED.match(line)
        if found is not None and not os.path.exists(f"/proc/{found['pid']}"):
            _forget(found.group())


def _forget(name: str) -> None:
    """Take away a namespace and its cable, as far as they are there."""
    for command in (("link", "del", name), ("netns", "del", name)):
        subprocess.run(["ip", *command], capture_output=True, timeout=_COMMAND_S, check=False)


def _ip(*words: str) -> str:
    try:
        done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=_COMMAND_S, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        said = (getattr(error, "stderr", None) or str(error)).strip()
        raise FleetError(f"'ip {' '.join(words)}' failed: {said}") from error
    return done.stdout
