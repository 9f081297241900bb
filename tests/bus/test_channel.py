"""The channel as a value: topologies against networkx's own, partitions, and what it refuses."""

import json
import pickle

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.exchange.channel import PERFECT, TOPOLOGIES, Channel, Partition

ARMS = ("a", "b", "c", "d", "e")


def named(count: int) -> tuple[str, ...]:
    return tuple(f"arm_{i}" for i in range(count))


@pytest.mark.parametrize("count", [1, 2, 3, 6])
@pytest.mark.parametrize(
    ("topology", "same"),
    [
        ("complete", nx.complete_graph),
        ("star", lambda n: nx.star_graph(n - 1)),
        ("ring", nx.cycle_graph),
        ("line", nx.path_graph),
    ],
)
def test_a_topology_by_name_is_that_of_networkx(topology, same, count):
    expected = nx.to_numpy_array(same(count), dtype=bool)
    np.fill_diagonal(expected, False)  # networkx's ring of one is a loop
    np.testing.assert_array_equal(Channel(topology=topology).links(named(count)), expected)


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_a_topology_by_name_carries_both_ways_and_never_to_oneself(topology):
    hears = Channel(topology=topology).links(ARMS)
    np.testing.assert_array_equal(hears, hears.T)
    assert not hears.diagonal().any()
    assert Channel(topology=topology).graph(ARMS).number_of_nodes() == len(ARMS)


@given(st.floats(0, 1.5), st.floats(0, 1.5), st.integers(0, 1000))
def test_whoever_reaches_farther_hears_all_the_same_and_more(one, other, seed):
    near, far = (
        Channel(topology="random_geometric", radius=radius, topology_seed=seed).links(ARMS)
        for radius in sorted((one, other))
    )
    assert (near <= far).all()


def test_random_places_are_uniform_in_the_unit_square():
    """Two points of the unit square are not farther apart than r < 1 with πr² − 8r³/3 + r⁴/2 (square line picking)."""
    r, arms = 0.4, named(2)
    hits = [Channel(topology="random_geometric", radius=r, topology_seed=s).links(arms)[0, 1] for s in range(3000)]
    expected = np.pi * r**2 - 8 / 3 * r**3 + r**4 / 2
    assert abs(np.mean(hits) - expected) < 4 * np.sqrt(expected * (1 - expected) / 3000)


def test_a_graph_of_names_is_taken_as_it_is():
    graph = nx.DiGraph([("a", "b"), ("c", "c")])
    hears = Channel(topology=graph).links(ARMS)
    assert np.argwhere(hears).tolist() == [[1, 0]]
    with pytest.raises(ValueError, match="The graph has an unknown arm 'z'"):
        Channel(topology=nx.path_graph(["a", "z"])).check(ARMS)


def test_a_partition_cuts_what_lies_between_groups_and_those_of_no_group_keep_together():
    cut = Partition(0.0, 1.0, (("a", "b"), ("c",))).cuts(ARMS)
    together = [{"a", "b"}, {"c"}, {"d", "e"}]
    for r, receiver in enumerate(ARMS):
        for s, sender in enumerate(ARMS):
            assert cut[r, s] == (not any({receiver, sender} <= group for group in together))


def test_only_the_default_is_perfect():
    assert PERFECT.perfect
    assert Channel() == PERFECT
    partition = Partition(0.0, 1.0, (("a",),))
    for changes in (
        {"topology": "ring"},
        {"delay_s": 1.0},
        {"jitter_s": 1.0},
        {"loss": 0.1},
        {"partitions": [partition]},
    ):
        assert not Channel(**changes).perfect


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"topology": "rign"}, "No topology 'rign'; did you mean 'ring'"),
        ({"delay_s": -1.0}, "delay_s must be 0 to 86400"),
        ({"delay_s": np.inf}, "delay_s must be 0 to 86400"),
        ({"delay_s": np.nan}, "delay_s must be 0 to 86400"),
        ({"jitter_s": -0.1}, "jitter_s must be 0 to 86400"),
        ({"loss": 1.5}, "loss must be 0 to 1"),
        ({"loss": np.nan}, "loss must be 0 to 1"),
        ({"radius": -1.0}, "radius must be 0 to 2"),
        ({"topology_seed": -1}, "topology_seed must be 0 to 4294967295"),
    ],
)
def test_a_channel_that_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        Channel(**arguments)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((5.0, 5.0, (("a",),)), "must end after it begins"),
        ((np.nan, 5.0, (("a",),)), "must end after it begins"),
        ((0.0, 5.0, ()), "needs groups"),
        ((0.0, 5.0, (("a",), ())), "needs groups"),
        ((0.0, 5.0, (("a", "b"), ("a",))), "names 'a' twice"),
    ],
)
def test_a_partition_that_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        Partition(*arguments)


def test_a_partition_of_strangers_is_refused_when_the_arms_are_known():
    channel = Channel(partitions=(Partition(0.0, 1.0, (("arm_a",),)),))
    with pytest.raises(ValueError, match=r"A partition names an unknown arm 'arm_a'.*Allowed: a, b"):
        channel.check(ARMS)


def test_a_channel_is_told_in_plain_values_and_travels_to_other_processes():
    partition = Partition(600.0, 1200.0, (("a", "b"), ("c",)))
    channel = Channel(topology="random_geometric", radius=0.3, topology_seed=4, loss=0.1, partitions=(partition,))
    assert json.loads(json.dumps(channel.described())) == {
        "topology": "random_geometric",
        "radius": 0.3,
        "topology_seed": 4,
        "delay_s": 0.0,
        "jitter_s": 0.0,
        "loss": 0.1,
        "partitions": [{"from_s": 600.0, "to_s": 1200.0, "groups": [["a", "b"], ["c"]]}],
    }
    assert pickle.loads(pickle.dumps(channel)) == channel
    told = json.loads(json.dumps(Channel(topology=nx.path_graph(["b", "a"])).described()))
    assert told["topology"] == {"directed": False, "edges": [["b", "a"]]}
