"""What the command line says lies between the arms is what the shift is worked with, and what is recorded."""

import json

import pytest

from fleet.bus.exchange.channel import Channel, Partition
from fleet.errors import FleetError
from scenarios.cli.options import channel_of
from scenarios.spec.load import load

QUICK = ("--difficulty", "blind", "--policy", "least_difficulty")
HARD = ("--topology", "line", "--delay-s", 20, "--jitter-s", 5, "--loss", 0.2, "--partition", "30:60:left|right")
CUTS = (Partition(0.0, 10.0, (("left",),)), Partition(20.0, 30.0, (("right",),)))


def test_a_partition_is_read_from_a_text():
    assert Partition.parse("600:1200:a, b|c") == Partition(600.0, 1200.0, (("a", "b"), ("c",)))
    assert Partition.parse("0:1e3:arm:1") == Partition(0.0, 1000.0, (("arm:1",),))


@pytest.mark.parametrize("text", ["", "600", "600:1200", "a:b:left", "1200:600:left|right", "0:10:left|", "0:10:a,a"])
def test_a_text_that_is_no_partition_is_refused(text):
    with pytest.raises(ValueError, match=r"partition .*\(got|names 'a' twice"):
        Partition.parse(text)


def test_options_make_a_channel(small_toml):
    made = channel_of(load(small_toml), partitions=CUTS, topology="ring", delay_s=3.0)
    assert made == Channel(topology="ring", delay_s=3.0, partitions=CUTS)
    assert channel_of(load(small_toml)).perfect


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--topology", "rign"), "Error: No topology 'rign'; did you mean 'ring'?"),
        (("--partition", "soon"), "Error: --partition needs FROM_S:TO_S:ARM,ARM|ARM,ARM"),
        (("--partition", "0:9:lefft"), "Error: A partition names an unknown arm 'lefft'; did you mean 'left'?"),
    ],
)
@pytest.mark.parametrize("command", ["run", "compare"])
def test_a_channel_that_cannot_be_is_one_sentence(thermofleet, small_toml, command, options, said):
    told = thermofleet(command, small_toml, *options)
    assert told.code == 2
    assert " ".join(told.err.split()).startswith(said)


def test_a_run_records_its_channel_and_is_the_same_over_either_bus(thermofleet, small_toml, tmp_path):
    told = {}
    for bus in ("memory", "zenoh"):
        out = tmp_path / bus
        assert thermofleet("run", small_toml, *QUICK, *HARD, "--bus", bus, "--out", out).code == 0
        told[bus] = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert told["memory"]["channel"] == {
        "topology": "line",
        "delay_s": 20.0,
        "jitter_s": 5.0,
        "loss": 0.2,
        "partitions": [{"from_s": 30.0, "to_s": 60.0, "groups": [["left"], ["right"]]}],
    }
    assert told["memory"] | {"bus": "zenoh"} == told["zenoh"]
    assert (tmp_path / "memory/events.parquet").read_bytes() == (tmp_path / "zenoh/events.parquet").read_bytes()
    words = 2 * 19  # 18 ticks and the one of the reset, two links
    assert 0 < told["memory"]["metrics"]["messages"] < words


def test_a_comparison_says_what_lay_between(thermofleet, small_toml):
    call = ("compare", small_toml, "--difficulty", "blind", "--seeds", 2, "--policies", "round_robin")
    plain, hard = thermofleet(*call), thermofleet(*call, *HARD)
    assert "Channel" not in plain.out
    said = "Channel: line, 20 to 25 s late, 20 % lost, cut from 30 to 60 s."
    assert said in " ".join(hard.out.split())
    assert json.loads(thermofleet(*call, *HARD, "--json").out)["channel"]["delay_s"] == 20.0


def test_an_exchange_of_strangers_is_an_error_of_the_user(small_toml):
    from scenarios.prepare.fleet import open_exchange

    with pytest.raises(FleetError, match="unknown arm 'z'"):
        open_exchange("memory", ("a", "b"), "f", channel=Channel(partitions=(Partition(0.0, 1.0, (("z",),)),)))
