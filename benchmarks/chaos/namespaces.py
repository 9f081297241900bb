"""Partition by network namespaces, one per arm; needs root.

Every arm has a pair of virtual Ethernet interfaces to the router. A cut takes the router's end down, so packets are
lost as with a real cable. The fleet is not on loopback, so it uses TLS. Addresses are of 198.18.0.0/15, which is
reserved for benchmarks (RFC 2544). Namespaces of a killed run are removed by the next one.
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
    """`with Namespaces(arms, port) as namespaces:` makes a namespace per arm, and removes them at the end.

    Attributes:
        hosts: Address of the router from each arm's namespace, by arm.
    """

    by = "netns"

    def __init__(self, arms: Sequence[str], port: int) -> None:
        self._port, self._names = port, {arm: f"tf{os.getpid()}-{number}" for number, arm in enumerate(arms)}
        self.hosts = {arm: f"198.18.{number}.1" for number, arm in enumerate(arms)}
        self._resources = ExitStack()

    def __enter__(self) -> Self:
        """Make the namespaces.

        Raises:
            FleetError: this machine does not permit it; nothing is left behind.
        """
        remove_stale()
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
        """Return the part, to run in the arm's namespace with the router's address there."""
        there = tuple(word.replace(f"127.0.0.1:{self._port}", f"{self.hosts[arm]}:{self._port}") for word in part.argv)
        return replace(part, argv=("ip", "netns", "exec", self._names[arm], *there))

    def cut(self) -> None:
        """Take all links down."""
        for name in self._names.values():
            _ip("link", "set", name, "down")

    def heal(self) -> None:
        """Take all links up."""
        for name in self._names.values():
            _ip("link", "set", name, "up")

    def _make(self, name: str, host: str) -> None:
        """Make a namespace and its link, whose outer end has the name of the namespace."""
        inner = host.removesuffix(".1") + ".2"
        _ip("netns", "add", name)
        self._resources.callback(_remove, name)
        _ip("link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", name)
        _ip("addr", "add", f"{host}/30", "dev", name)
        _ip("link", "set", name, "up")
        for command in (
            ("addr", "add", f"{inner}/30", "dev", "eth0"),
            *(("link", "set", i, "up") for i in ("eth0", "lo")),
        ):
            _ip("-n", name, *command)


def unavailable_reason() -> str:
    """Return why namespaces cannot be made here; "" if they can."""
    if not sys.platform.startswith("linux") or shutil.which("ip") is None:
        return "network namespaces need Linux and its command ip"
    if os.geteuid() != 0:
        return "network namespaces need root"
    try:
        with Namespaces(["probe"], 1):
            return ""
    except FleetError as error:
        return str(error)


def remove_stale() -> None:
    """Remove the namespaces of processes that no longer exist."""
    for line in _ip("netns", "list").splitlines():
        match = _NAMED.match(line)
        if match is not None and not os.path.exists(f"/proc/{match['pid']}"):
            _remove(match.group())


def _remove(name: str) -> None:
    """Remove a namespace and its link, if they exist."""
    for command in (("link", "del", name), ("netns", "del", name)):
        subprocess.run(["ip", *command], capture_output=True, timeout=_COMMAND_S, check=False)


def _ip(*words: str) -> str:
    try:
        done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=_COMMAND_S, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        reason = (getattr(error, "stderr", None) or str(error)).strip()
        raise FleetError(f"'ip {' '.join(words)}' failed: {reason}") from error
    return done.stdout
