"""`thermofleet ask`: what would these jobs cost whom? Nothing changes by asking."""

from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.table import Table

from fleet.errors import BusError, FleetError
from scenarios.live_options import ENDPOINT, EndpointOption, FleetOption, the_fleet
from scenarios.live_submit import plain, read_jobs
from scenarios.terminal import out_console, say

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fleet.bus.trade import JobWord, Offer, Quote

ANSWER_S = 5.0
"""Real seconds to wait for arms; planning a motion that is new to an arm takes a while."""


def ask_command(
    file: Annotated[str, typer.Argument(help="Jobs as JSON: a list, or one job a line; - reads standard input.")] = "",
    kind: Annotated[str, typer.Option(help="Of one job instead of a file: pick_place, hold, press, sort.")] = "",
    place: Annotated[list[str] | None, typer.Option(help="Of the cell; twice for pick_place and sort.")] = None,
    payload: Annotated[float, typer.Option(help="kg")] = 0.0,
    repetitions: Annotated[int, typer.Option(help="Cycles.")] = 1,
    dwell: Annotated[float, typer.Option(help="s; of a hold or press, how long one repetition lasts.")] = 0.5,
    force: Annotated[float, typer.Option(help="N; of a press.")] = 0.0,
    timeout: Annotated[float, typer.Option(help="Real seconds to wait for arms.")] = ANSWER_S,
    as_json: Annotated[bool, typer.Option("--json", help="Print the quotes as JSON.")] = False,
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Ask every arm what jobs would cost it: difficulty, risk, peak temperature, finish, or why it cannot.

    A job takes as long as it is with the ways there and home; it is done when its last cycle is, after what is in hand.
    """
    from fleet.bus import keys
    from fleet.bus.link import Link
    from fleet.bus.trade import MOST_JOBS, Quote, QuoteRequest

    if bool(file) == bool(kind):
        raise FleetError("Give either a FILE of jobs or one job by --kind and --place.")
    words = read_jobs(file) if file else [one_job(kind, place or [], payload, repetitions, dwell, force)]
    if len(words) > MOST_JOBS:
        raise FleetError(f"At most {MOST_JOBS} jobs can be asked for at once (got {len(words)}).")
    with Link(endpoint, the_fleet(fleet, endpoint)) as link:
        request = QuoteRequest("dry run", tuple(words), dry_run=True)
        answers = link.ask_and_wait(keys.of_every_arm(link.fleet, "quote"), request, Quote, timeout_s=timeout)
        name = link.fleet
    quotes = {quote.arm: quote for quote in sorted(answers.words.values(), key=lambda quote: quote.arm)}
    if not quotes and not answers.refused:
        raise BusError(f"No arm of fleet '{name}' answered; is `thermofleet arm` running?")
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(list(quotes.values())), indent=1).decode())
    else:
        out_console.print(offers_table(words, quotes))
    for reason in answers.refused.values():
        say(f"Refused: {reason}" if reason else f"An arm did not answer within {timeout:g} s.")


def one_job(
    kind: str, places: "Sequence[str]", payload_kg: float, repetitions: int, dwell_s: float, force_n: float
) -> "JobWord":
    """The job of the options.

    Raises:
        FleetError: there is no such job.
    """
    from fleet.bus.trade import JobWord

    fields = {
        "name": kind,
        "kind": kind,
        "places": list(places),
        "payload_kg": payload_kg,
        "repetitions": repetitions,
        "dwell_s": dwell_s,
        "force_n": force_n,
    }
    try:
        return msgspec.convert(fields, JobWord)
    except msgspec.ValidationError as error:
        raise FleetError(f"No such job: {plain(error)}") from error


def offers_table(words: "Sequence[JobWord]", quotes: "Mapping[str, Quote]") -> Table:
    """Every offer, the jobs in their order and the arms under each."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("job")
    table.add_column("arm")
    for column in ("d", "P(warm)", "peak °C", "takes s", "done in s"):
        table.add_column(column, justify="right")
    table.add_column("")
    for index, word in enumerate(words):
        for row, (arm, quote) in enumerate(quotes.items()):
            offer = next((offer for offer in quote.offers if offer.job == word.name), None)
            table.add_row(
                "" if row else word.name, arm, *cells(offer), end_section=row == len(quotes) - 1 and index > 0
            )
    return table


def cells(offer: "Offer | None") -> list[str]:
    """An offer in words; a dash for what the arm does not know."""
    if offer is None:
        return ["–"] * 5 + ["no answer"]
    figures = (
        (offer.d, ".2f"),
        (offer.p_saturation, ".2f"),
        (offer.peak_c, ".1f"),
        (offer.duration_s, ".0f"),
        (offer.finish_in_s, ".0f"),
    )
    told = ["–" if value is None else format(value, form) for value, form in figures]
    return [*told, "" if offer.feasible else f"cannot: {offer.reason}"]
