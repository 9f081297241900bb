"""Options of the command line that say what lies between the arms, and the channel they make."""

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from fleet.bus.channel import TOPOLOGIES, Channel, Partition
from fleet.errors import FleetError
from scenarios.scenario import Scenario

ChannelMaker = Callable[[Scenario], Channel]
"""Makes the channel that the options describe for the arms of a scenario."""


def with_channel(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of `channel_of`; it is handed a `ChannelMaker` as `channel`."""
    options = list(inspect.signature(channel_of).parameters.values())[1:]
    own = inspect.signature(command)

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        fields = {option.name: given.pop(option.name) for option in options}
        command(**given, channel=functools.partial(channel_of, **fields))

    kept = [parameter for parameter in own.parameters.values() if parameter.name != "channel"]
    ordered = [*kept, *(option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options)]
    with_options.__signature__ = own.replace(parameters=ordered)  # type: ignore[attr-defined]  # what typer reads
    return with_options


def channel_of(
    scenario: Scenario,
    topology: Annotated[str, typer.Option(help=f"Who hears whom: {', '.join(TOPOLOGIES)}.")] = "complete",
    radius: Annotated[float, typer.Option(help="Of random_geometric: how far an arm hears in a unit square.")] = 0.5,
    topology_seed: Annotated[int, typer.Option(help="Of random_geometric: draws where the arms lie.")] = 0,
    delay_s: Annotated[float, typer.Option(help="How long a word between arms takes at least, in the shift.")] = 0.0,
    jitter_s: Annotated[float, typer.Option(help="How much longer it may take; each word draws its own.")] = 0.0,
    loss: Annotated[float, typer.Option(help="Probability that a word is lost on a link.")] = 0.0,
    partition: Annotated[
        list[str] | None,
        typer.Option(help="FROM_S:TO_S:ARM,ARM|ARM,ARM: for a time arms hear only their group. May be repeated."),
    ] = None,
) -> Channel:
    """The channel that the options describe.

    Raises:
        FleetError: names the option, what it was and what it may be.
    """
    named: Any = topology  # checked by the channel
    try:
        channel = Channel(
            topology=named,
            radius=radius,
            topology_seed=topology_seed,
            delay_s=delay_s,
            jitter_s=jitter_s,
            loss=loss,
            partitions=tuple(partition_of(text) for text in partition or ()),
        )
        channel.check([arm.name for arm in scenario.arms])
    except ValueError as error:
        raise FleetError(_as_option(str(error))) from error
    return channel


def partition_of(text: str) -> Partition:
    """The partition that a text such as `600:1200:arm_0,arm_1|arm_2,arm_3` means.

    Raises:
        ValueError: it means none.
    """
    begin, _, rest = text.partition(":")
    end, _, groups = rest.partition(":")
    try:
        from_s, to_s = float(begin), float(end)
    except ValueError:
        raise ValueError(
            f"--partition needs FROM_S:TO_S:ARM,ARM|ARM,ARM, as in 600:1200:arm_0,arm_1|arm_2 (got '{text}')."
        ) from None
    named = (tuple(arm.strip() for arm in group.split(",") if arm.strip()) for group in groups.split("|"))
    return Partition(from_s, to_s, tuple(named))


def _as_option(complaint: str) -> str:
    """A complaint of the channel about a field, in the words of the command line."""
    field, space, rest = complaint.partition(" ")
    known = field in inspect.signature(channel_of).parameters
    return f"--{field.replace('_', '-')}{space}{rest}" if known else complaint
