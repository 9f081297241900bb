"""Communication channels between arms: topology, delay, loss and partitions.

A channel is a plain value; `fleet.bus.exchange.delivery` applies it, in memory and over Zenoh alike.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, Literal, get_args

import networkx as nx
import numpy as np

from fleet.errors import nearest

Array = np.ndarray

TopologyName = Literal["complete", "star", "ring", "line", "random_geometric"]
TOPOLOGIES: tuple[TopologyName, ...] = get_args(TopologyName)


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

    def cuts(self, arms: Sequence[str]) -> Array:
        """Which links it cuts, bool, [receiver, sender].

        Raises:
            ValueError: a group names an unknown arm.
        """
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

    topology: TopologyName | nx.Graph = "complete"
    """Which arms receive from which; broadcasts are not forwarded. A star has the first arm in the middle; a ring and a
    line have the fleet's order. A networkx graph has names of arms as nodes: an edge connects both ways, a directed one
    from tail to head, and an arm without a node has no link."""
    radius: float = 0.5
    """For `random_geometric`: arms at random places in the unit square receive from those within this radius."""
    topology_seed: int = 0
    """For `random_geometric`: seed of the places."""
    delay_s: float = 0.0
    """Minimum delay of a broadcast, simulation seconds."""
    jitter_s: float = 0.0
    """Additional delay of each broadcast on each link, uniform from 0 to this."""
    loss: float = 0.0
    """Probability that a broadcast is lost on a link, independent for each."""
    partitions: tuple[Partition, ...] = ()
    """A broadcast in transit on a link is lost when a partition cuts the link."""

    def __post_init__(self) -> None:
        if isinstance(self.topology, str) and self.topology not in TOPOLOGIES:
            raise ValueError(f"No topology '{self.topology}'{nearest(self.topology, TOPOLOGIES)}")
        if not 0 <= self.radius < math.inf:
            raise ValueError(f"radius must be finite and >= 0 (got {self.radius}).")
        if self.topology_seed < 0:
            raise ValueError(f"topology_seed must be >= 0 (got {self.topology_seed}).")
        for name in ("delay_s", "jitter_s"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and >= 0 (got {value}).")
        if not 0 <= self.loss <= 1:
            raise ValueError(f"loss must be a probability, from 0 to 1 (got {self.loss}).")
        object.__setattr__(self, "partitions", tuple(self.partitions))

    @property
    def perfect(self) -> bool:
        """Whether every arm receives every broadcast at once."""
        return self.topology == "complete" and not (self.delay_s or self.by_chance or self.partitions)

    @property
    def by_chance(self) -> bool:
        """Whether loss or delay is random."""
        return bool(self.loss or self.jitter_s)

    def graph(self, arms: Sequence[str]) -> nx.Graph:
        """Which arms receive from which, as a graph of their names.

        Raises:
            ValueError: a node is no arm.
        """
        if not isinstance(self.topology, str):
            for node in self.topology:
                if node not in arms:
                    raise ValueError(f"The graph has an unknown arm '{node}'{nearest(str(node), arms)}")
            return self.topology
        graph = nx.Graph()
        graph.add_nodes_from(arms)
        match self.topology:
            case "complete":
                graph.add_edges_from(combinations(arms, 2))
            case "star":
                graph.add_edges_from((arms[0], arm) for arm in arms[1:])
            case "ring" | "line":
                nx.add_path(graph, arms)
                if self.topology == "ring":
                    graph.add_edge(arms[-1], arms[0])
            case "random_geometric":
                places = np.random.default_rng(self.topology_seed).random((len(arms), 2))
                near = zip(arms, places.tolist(), strict=True)
                pairs = combinations(near, 2)
                graph.add_edges_from((a, b) for (a, p), (b, q) in pairs if math.dist(p, q) <= self.radius)
        graph.remove_edges_from(list(nx.selfloop_edges(graph)))
        return graph

    def links(self, arms: Sequence[str]) -> Array:
        """Which arms receive from which, bool, [receiver, sender], False on the diagonal; raises as `graph`."""
        graph = self.graph(arms)
        links = np.array([[graph.has_edge(sender, receiver) for sender in arms] for receiver in arms])
        np.fill_diagonal(links, False)
        return links

    def check(self, arms: Sequence[str]) -> None:
        """Refuse a channel that names unknown arms.

        Raises:
            ValueError: names the arm, and the known ones.
        """
        self.graph(arms)
        for partition in self.partitions:
            partition.cuts(arms)

    @property
    def text(self) -> str:
        """Short text, as `ring, 30 to 35 s late, 20 % lost`."""
        named = self.topology if isinstance(self.topology, str) else "own graph"
        parts = [f"{named} of radius {self.radius:g}" if named == "random_geometric" else named]
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
        topology: object = self.topology if isinstance(self.topology, str) else _edges(self.topology)
        drawn = {"radius": self.radius, "topology_seed": self.topology_seed}
        return {
            "topology": topology,
            **(drawn if topology == "random_geometric" else {}),
            "delay_s": self.delay_s,
            "jitter_s": self.jitter_s,
            "loss": self.loss,
            "partitions": [asdict(partition) for partition in self.partitions],
        }


def _edges(graph: nx.Graph) -> dict[str, Any]:
    return {"directed": graph.is_directed(), "edges": sorted([str(tail), str(head)] for tail, head in graph.edges())}


PERFECT = Channel()
"""Every arm receives every broadcast at once."""
