"""The numbers that participants of the bus reckon with, as tables for docs/bus.md, read from where they are set."""

from fleet.bus.contract import schemas
from fleet.bus.link import HEARTBEAT_S
from fleet.bus.router import LEASE_MS, Limits
from fleet.bus.trade import MOST_JOBS
from fleet.live.admission import MOST_JOBS as MOST_KEPT
from fleet.live.contractor import ASK_AGAIN_S, RENEWALS, REPORT_AGAIN_S, Terms
from fleet.live.overview import FRESH_S
from fleet.live.timing import DRIFT, Timing
from scenarios.contract_page import table
from scenarios.router_cli import STATE_HZ


def time_table() -> str:
    """Durations in real seconds."""
    timing, terms = Timing(), Terms()
    again_s, most_s = REPORT_AGAIN_S
    short_s, attempts = timing.lease_s * (1 - DRIFT), timing.attempts
    rows = [
        (f"{LEASE_MS / 1000:g}", "all", "without a sign of life a Zenoh session is gone, and its token with it"),
        (f"{FRESH_S:g}", "all", "an arm whose state is older is not present, whatever its token says"),
        ("0.1", "arm", "between two `state` words"),
        (f"{HEARTBEAT_S:g}", "all", "after a remembered word its number is repeated, so that gaps are seen"),
        (f"{timing.window_s:g}", "auctioneer", "a round closes, if not every present arm has answered before"),
        (f"{terms.valid_s:g}", "arm", "`valid_s`: it takes an award on its quote"),
        (f"{timing.ack_s:g}", "auctioneer", f"without an `Ack` the same award is sent again, {attempts} times in all"),
        (f"{timing.lease_s:g}", "auctioneer", "`lease_s`: length of a lease"),
        (f"{short_s:.2f}", "arm", f"how long it counts that lease: {DRIFT:.0%} shorter, as clocks differ in rate"),
        (f"{timing.hold_s:.2f}", "auctioneer", f"how long it counts it: {DRIFT:.0%} and {timing.margin_s:g} s longer"),
        (f"{timing.lease_s / RENEWALS:g}", "arm", "between two requests to renew"),
        (f"{terms.ahead_s:g}", "arm", "before its last cycle could begin it asks for leave to finish"),
        (f"{ASK_AGAIN_S:g}", "arm", "until it asks for leave again"),
        (f"{again_s:g} to {most_s:g}", "arm", "between two reports of the same, longer each time"),
        (f"{terms.patience_s:g}", "arm", "after the end of a lease it gives the job back of its own accord"),
    ]
    return table(("real s", "of", "what"), rows)


def limit_table() -> str:
    """How large, how many, how often."""
    longest = schemas()["JobWord"]["properties"]["name"]["maxLength"]
    rows = [
        (f"{Limits().message_bytes:,} bytes", "any message with its attachment; the router drops more without a word"),
        (f"{STATE_HZ:g} a second", "`state` words of one session; the router drops more (`--state-hz`)"),
        (f"{MOST_JOBS}", "jobs in one word; of more, a `Status` holds those that may still change first"),
        (f"{MOST_KEPT:,}", "jobs that one auctioneer keeps, finished ones included"),
        (f"{longest}", "characters of a job's name"),
    ]
    return table(("limit", "of"), rows)
