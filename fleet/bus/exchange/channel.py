"""Communication channels between arms: topology, delay, loss and partitions.

A channel is a value; `fleet.bus.exchange.memory.Exchange` applies it.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

from fleet.errors import nearest
from fleet.fields import MAX_SEED, check, check_instance, option

if TYPE_CHECKING:  # slow to import, and the help of commands does not need it
    import numpy as np

    Array = np.ndarray

TopologyName = Literal["complete", "star", "ring", "line", "random_geometric"]
TOPOLOGIES: tuple[TopologyName, ...] = get_args(TopologyName)
MAX_DELAY_S = 86_400.0
_PANEL = "Communication between arms"


@dataclass(frozen=True)
class Partition:
    """A period in which arms receive only from their own group."""

    from_s: float
    to_s: float
    """End, exclusive."""
    groups: tuple[tuple[str, ...], ...]
    """Names of arms; arms in no group are one more group."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.from_s) and self.from_s < self.to_s):
            raise ValueError(f"A partition must end after it begins (got from {self.from_s} s to {self.to_s} s).")
        if not self.groups or not all(self.groups):
            raise ValueError(f"A partition needs groups of at least one arm each (got {self.groups}).")
        named = [arm for group in self.groups for arm in group]
        for arm in named:
            if named.count(arm) > 1:
                raise ValueError(f"A partition names '{arm}' twice; every arm is in one group.")

    @classmethod
    def parse(cls, text: str) -> "Partition":
        """The partition of a text such as `600:1200:arm_0,arm_1|arm_2,arm_3`.

        Raises:
            ValueError: the text has another form.
        """
        begin, _, rest = text.partition(":")
        end, _, groups = rest.partition(":")
        try:
            from_s, to_s = float(begin), float(end)
        except ValueError:
            raise ValueError(
                f"--partition needs FROM_S:TO_S:ARM,ARM|ARM,ARM, as in 600:1200:arm_0,arm_1|arm_2 (got '{text}')."
            ) from None
        arms = (tuple(arm.strip() for arm in group.split(",") if arm.strip()) for group in groups.split("|"))
        return cls(from_s, to_s, tuple(arms))

    def cuts(self, arms: Sequence[str]) -> "Array":
        """Which links it cuts, bool, [receiver, sender].

        Raises:
            ValueError: a group names an unknown arm.
        """
        import numpy as np

        group = np.full(len(arms), -1)
        for number, members in enumerate(self.groups):
            for arm in members:
                if arm not in arms:
                    raise ValueError(f"A partition names an unknown arm '{arm}'{nearest(arm, arms)}")
                group[list(arms).index(arm)] = number
        return group[:, None] != group[None, :]


@dataclass(frozen=True, kw_only=True)
class Channel:
    """How broadcasts reach peers. The default is perfect: every arm receives every broadcast at once."""

    topology: TopologyName = option(
        "Which arms receive each other's messages: complete, star, ring, line, random_geometric.",
        "complete",
        choices=TOPOLOGIES,
        panel=_PANEL,
    )
    """A star has the first arm in the middle; a ring and a line have the fleet's order. Nothing is forwarded."""
    radius: float = option("random_geometric: range of an arm in a unit square.", 0.5, low=0, high=2, panel=_PANEL)
    topology_seed: int = option("random_geometric: seed of the arms' positions.", 0, low=0, high=MAX_SEED, panel=_PANEL)
    delay_s: float = option(
        "Minimum delay of a message, s of simulated time.", 0.0, low=0, high=MAX_DELAY_S, panel=_PANEL
    )
    jitter_s: float = option(
        "Maximum additional delay per message and link, uniform, s of simulated time.",
        0.0,
        low=0,
        high=MAX_DELAY_S,
        panel=_PANEL,
    )
    loss: float = option(
        "Probability that a message is lost on a link, independent for each.", 0.0, low=0, high=1, panel=_PANEL
    )
    partitions: tuple[Partition, ...] = option(
        "FROM_S:TO_S:ARM,ARM|ARM,ARM: between these times messages stay inside each group. May be repeated.",
        (),
        flag="--partition",
        parse=Partition.parse,
        panel=_PANEL,
    )
    """A broadcast in transit on a link is lost when a partition cuts the link."""

    def __post_init__(self) -> None:
        check(self)
        for name in ("radius", "topology_seed"):
            if self.topology != "random_geometric" and (given := getattr(self, name)) != getattr(type(self), name):
                raise ValueError(
                    f"{name} is for the topology random_geometric (got {given:g} and {self.topology}): give this "
                    f"topology, too, or leave {name} out."
                )
        object.__setattr__(self, "partitions", tuple(self.partitions))

    @property
    def perfect(self) -> bool:
        """Whether every arm receives every broadcast at once."""
        return self.topology == "complete" and not (self.delay_s or self.by_chance or self.partitions)

    @property
    def by_chance(self) -> bool:
        """Whether loss or delay is random."""
        return bool(self.loss or self.jitter_s)

    def links(self, arms: Sequence[str]) -> "Array":
        """Which arms receive from which, bool, [receiver, sender], False on the diagonal."""
        import numpy as np

        index = np.arange(len(arms))
        apart = abs(index[:, None] - index)
        match self.topology:
            case "complete":
                links = np.ones_like(apart, dtype=bool)
            case "star":
                links = (index[:, None] == 0) | (index == 0)
            case "line":
                links = apart == 1
            case "ring":
                links = (apart == 1) | (apart == len(arms) - 1)
            case "random_geometric":
                points = np.random.default_rng(self.topology_seed).random((len(arms), 2)).tolist()
                links = np.array([[math.dist(p, q) <= self.radius for q in points] for p in points])
        np.fill_diagonal(links, False)
        return links

    def check(self, arms: Sequence[str]) -> None:
        """Refuse a channel whose partitions name unknown arms.

        Raises:
            ValueError: names the arm, and the known ones.
        """
        for partition in self.partitions:
            partition.cuts(arms)

    @property
    def text(self) -> str:
        """Short text, as `ring, 30 to 35 s late, 20 % lost`."""
        random = self.topology == "random_geometric"
        parts = [f"{self.topology} of radius {self.radius:g}" if random else self.topology]
        if self.jitter_s:
            parts.append(f"{self.delay_s:g} to {self.delay_s + self.jitter_s:g} s late")
        elif self.delay_s:
            parts.append(f"{self.delay_s:g} s late")
        if self.loss:
            parts.append(f"{100 * self.loss:g} % lost")
        parts += [f"cut from {cut.from_s:g} to {cut.to_s:g} s" for cut in self.partitions]
        return ", ".join(parts)

    def described(self) -> dict[str, Any]:
        """The channel as JSON values, for a recording."""
        values = asdict(self)
        values["partitions"] = list(values["partitions"])
        if self.topology != "random_geometric":
            del values["radius"], values["topology_seed"]
        return values


def check_channel(value: object) -> None:
    """Check that an argument of a function is a channel.

    Raises:
        ArgumentError: it is not.
    """
    check_instance("channel", value, Channel, "fleet.bus.exchange.channel.Channel(topology='star')")


PERFECT = Channel()
"""Every arm receives every broadcast at once."""
