"""Options of commands come from the fields of dataclasses, and the same bounds hold where a value is made."""

from dataclasses import dataclass, fields
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from fleet.bus.exchange.channel import Channel
from fleet.bus.protocol.keys import CHANNEL, STATE_HZ
from fleet.errors import FleetError
from fleet.fields import check, option, options_of
from fleet.robot import ThermalLimits
from scenarios.cli.from_fields import From, Given, flags_of, with_fields
from scenarios.cli.main import COMMANDS, GROUPS, MOVED, load_command
from scenarios.live.gateway import ROLES
from scenarios.spec.options import ENDPOINT, PORT, Budget, LiveSpec, RunSpec, Shot, StudySpec
from twin.thermal.identify import AMBIENT_C


@dataclass(frozen=True, kw_only=True)
class Oven:
    """An oven."""

    heat_c: float = option("Temperature, °C.", 180.0, low=0, high=300)
    mode: str = option("fan or grill.", "fan", choices=("fan", "grill"))
    minutes: int | None = option("Time, min.", None, low=0, high=600, above=True)
    shelves: tuple[int, ...] = option("Shelves.", (), flag="--shelf", parse=int)
    clean: bool = option("Clean it afterwards.", False)
    maker: str = "nobody"

    def __post_init__(self) -> None:
        check(self)


def run(*words, **defaults) -> Given | BaseException:
    """What a command is given by its words; or its error."""
    received: list[Given] = []

    def bake(given: Annotated[Given, From(Oven, **defaults)], twice: bool = option("Again.", False)) -> None:
        """Bake."""
        received.append(given)

    app = typer.Typer()
    app.command()(with_fields(bake))
    done = CliRunner().invoke(app, [*words])
    return received[0] if received else done.exception or AssertionError(done.output)


def test_a_command_receives_what_is_given_and_no_defaults():
    assert run() == {}
    assert run("--heat-c", "90", "--twice") == {"heat_c": 90.0}
    assert run("--shelf", "1", "--shelf", "3", "--clean") == {"shelves": (1, 3), "clean": True}
    assert run("--mode", "fan") == {"mode": "fan"}  # given, although it is the default


def test_a_command_may_have_a_default_of_its_own():
    assert run(heat_c=100.0) == {"heat_c": 100.0}
    assert run("--heat-c", "90", heat_c=100.0) == {"heat_c": 90.0}


@pytest.mark.parametrize(
    ("word", "value", "said"),
    [
        ("heat-c", 301.0, "must be 0 to 300 (got 301)."),
        ("heat-c", float("nan"), "must be 0 to 300 (got nan)."),
        ("minutes", 0, "must be > 0 and at most 600 (got 0)."),
        ("mode", "gril", "No mode 'gril'; did you mean 'grill'? Allowed: fan, grill."),
    ],
)
def test_the_same_bounds_hold_on_the_command_line_and_in_python(word, value, said):
    error = run(f"--{word}", str(value))
    assert isinstance(error, FleetError)
    field = word.replace("-", "_")
    assert str(error) == (said if said.startswith("No ") else f"--{word} {said}")
    with pytest.raises(ValueError) as raised:  # noqa: PT011  # the sentence is compared below
        Oven(**{field: value})
    assert str(raised.value) == (said if said.startswith("No ") else f"Oven.{field} {said}")


def test_words_of_a_command_line_give_the_same_value():
    spec = LiveSpec(policy="wspt", speed=12345.678e-3, jobs="none", new_epoch=True)
    names = [name for name in options_of(LiveSpec)]
    received: list[Given] = []

    def live(given: Annotated[Given, From(LiveSpec)]) -> None:
        received.append(given)

    app = typer.Typer()
    app.command()(with_fields(live))
    assert CliRunner().invoke(app, list(flags_of(spec, *names))).exit_code == 0
    assert LiveSpec(**received[0]) == spec


@pytest.mark.parametrize("kind", [RunSpec, LiveSpec, StudySpec, Budget, Shot, Channel])
def test_defaults_are_allowed_and_each_option_has_a_sentence(kind):
    kind()
    defaults = {each.name: each.default for each in fields(kind)}
    for name, known in options_of(kind).items():
        assert known.help.endswith("."), name
        assert not known.problem(name, defaults[name]), name


def test_an_earlier_name_of_a_command_names_a_present_one():
    for old, new in MOVED.items():
        command, *options = new.partition(" --")[0], *new.split()[2:]
        assert command in COMMANDS, old
        flags = {flag for option in load_command(command).params for flag in getattr(option, "opts", ())}
        assert {word for word in options if word.startswith("--")} <= flags, old
        assert old not in {name.split()[0] for name in COMMANDS}, old
    assert {name.split()[0] for name in COMMANDS if " " in name} == set(GROUPS)


def test_defaults_that_the_help_states_are_those_of_the_modules_that_it_does_not_load():
    def default(command, name):
        return next(each.default for each in load_command(command).params if each.name == name)

    assert default("arm run", "rate_hz") == STATE_HZ
    assert default("bus router", "state_hz") == CHANNEL["arm", "state"].limit_hz
    ambient = next(each for each in load_command("twin identify").params if each.name == "ambient")
    assert f"default: {AMBIENT_C:g} is assumed" in ambient.help
    limits = ThermalLimits()
    assert (default("bus ros2", "warning_c"), default("bus ros2", "error_c")) == (limits.warning_c, limits.error_c)
    assert ENDPOINT == f"tcp/127.0.0.1:{PORT}" == default("bus watch", "endpoint")
    tokens = next(each for each in load_command("bus gateway").params if each.name == "tokens")
    assert ", ".join(ROLES) in tokens.help
