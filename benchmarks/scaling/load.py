"""The load of a fleet in a steady state, calculated from message sizes, rates and costs per message."""

from dataclasses import dataclass

from fleet.bus.protocol.auction import LEASE_S, Ack, Award, JobEstimate, JobSpec, PlanQuote, Quote, QuoteRequest
from fleet.bus.protocol.keys import STATE_HZ
from fleet.bus.protocol.messages import State, encode
from fleet.live.arm.awards import RENEWALS
from fleet.live.leases import Timing

JOB_S = 340.0
"""Real seconds between two jobs of an arm: quickstart has one job in 85 s for four arms."""
JOINTS, PLANS = 7, 2
DAY_S, SHORTEST_S = 86_400.0, 0.05
"""A day, and the shortest time between two rounds."""


@dataclass(frozen=True, kw_only=True)
class Costs:
    """CPU-seconds per message, on one core; see docs/scaling.md for the commands that measure them."""

    forward_s: float = 17.5e-6
    """A router, for each message that it receives or sends over one connection."""
    state_s: float = 32e-6
    """The auctioneer's process, for each state that it receives."""
    request_s: float = 43e-6
    """The auctioneer's process, for a quote without jobs, decoded and validated, or another reply."""
    estimate_s: float = 12e-6
    """The auctioneer's process, for each job in a quote."""
    award_s: float = 1.2e-3
    """The auctioneer's process, for an award with its acknowledgement and its journal record."""


COSTS = Costs()


@dataclass(frozen=True)
class Load:
    """Load of a fleet in a steady state, per real second."""

    arms: int
    sites: int
    state_hz: float
    asked: int
    """Arms that are asked for a quote of a job; 0 for all."""
    jobs: float
    """Jobs that arrive in the whole fleet."""
    round_jobs: int
    """Jobs of a round."""
    site_router: float
    """Messages that the router of a site receives and sends."""
    hub_router: float
    """The same for the router of the auctioneer and the recorder."""
    hub_mb: float
    """Bytes that the router of the auctioneer receives, MB."""
    auctioneer: float
    """Share of a core."""
    round_s: float
    """Duration of a round: the auctioneer's work on quotes and awards."""
    full_round_s: float
    """The same for a round with as many jobs as a round may have, as after a stop."""
    quote_kb: float
    """Size of a quote in a full round, kB."""
    recorder_gb: float
    """States and results of a day, before compression, GB."""
    journal_mb: float
    """The auctioneer's journal records of a day, MB."""


def job_of(number: int) -> JobSpec:
    """Return a job of typical length."""
    return JobSpec(
        name=f"load_tray_left {number:07d}", kind="pick_place", places=("rack_left", "tray_left"), payload_kg=1.0
    )


def estimate_of(job: str) -> JobEstimate:
    """Return an estimate of typical length: two plans."""
    difficulty = tuple(0.0123456789 * (1 + joint) for joint in range(JOINTS))
    heat = (51.23456789, 9.123456789, 0.0123456789, difficulty, sum(difficulty))
    return JobEstimate(job, tuple(PlanQuote(plan, *heat, 123.456789, 234.56789) for plan in range(PLANS)))


def quote_of(arm: str, auction: str, *estimates: JobEstimate) -> Quote:
    """Return a quote of typical length."""
    return Quote(arm, auction, f"{arm}-abcd-000123", 5.0, "t" * 12, 12345.678, "idle", 20.123, 1, estimates)


def state_of(arm: str, tick: int) -> State:
    """Return a state of typical length."""
    return State(arm, tick, 123456.789, "working", (45.678,) * JOINTS, 34.567, q=(1.23456,) * JOINTS)


def sizes() -> dict[str, int]:
    """Bytes of typical messages, payload only; a quote and a request without and with one job."""
    job, name, arm = job_of(12345), "auction-0123abcd-000123456", "arm_0123"
    empty = len(encode(quote_of(arm, name)))
    return {
        "state": len(encode(state_of(arm, 1234567))),
        "request": len(encode(QuoteRequest(name, ()))),
        "job": len(encode(job)) + 1,
        "quote": empty,
        "estimate": len(encode(quote_of(arm, name, estimate_of(job.name)))) - empty,
        "award": len(encode(Award(name, name, "auctioneer", f"{arm}-abcd-000123", job, epoch="0123abcd"))),
        "ack": len(encode(Ack(arm, name, True))),
    }


def load_of(arms: int, sites: int, *, state_hz: float, asked: int, costs: Costs = COSTS) -> Load:
    """The load of a fleet with one router per site and one more router for the auctioneer and the recorder.

    Jobs wait for a round as long as the round before takes, and at least `SHORTEST_S`.

    Args:
        state_hz: States that each arm publishes a second.
        asked: Arms that are asked for a quote of a job; 0 for all.
    """
    bytes_of, limits = sizes(), Timing()
    jobs, per_job = arms / JOB_S, asked or arms

    def work_s(count: float) -> float:
        replies = min(arms, per_job * count)
        return replies * costs.request_s + per_job * count * costs.estimate_s + count * costs.award_s

    round_jobs = 1
    for _ in range(200):  # fixed point: a longer round collects more jobs
        round_jobs = max(1, min(limits.max_jobs, round(jobs * max(SHORTEST_S, work_s(round_jobs)))))
    rounds, replies = jobs / round_jobs, min(arms, per_job * round_jobs)
    full = per_job * limits.max_jobs
    states, leases = arms * state_hz, arms * RENEWALS / LEASE_S
    queries = rounds * replies + jobs + leases  # each has a request and a reply
    received_b = (
        states * bytes_of["state"]
        + rounds * (replies * bytes_of["quote"] + per_job * round_jobs * bytes_of["estimate"])
        + (jobs + leases) * bytes_of["ack"]
    )
    record_b = 2 * bytes_of["award"] + 3 * 150  # accepted, awarded, permitted, finished
    return Load(
        arms=arms,
        sites=sites,
        state_hz=state_hz,
        asked=asked,
        jobs=jobs,
        round_jobs=round_jobs,
        # Auctioneer and recorder subscribe to states. A site's router receives each and sends it on once, to the hub.
        site_router=(2 * states + 4 * queries) / sites,
        hub_router=3 * states + 4 * queries,
        hub_mb=received_b / 1e6,
        auctioneer=states * costs.state_s + rounds * work_s(round_jobs) + leases * costs.request_s,
        round_s=work_s(round_jobs),
        full_round_s=work_s(limits.max_jobs),
        quote_kb=(bytes_of["quote"] + full / min(arms, full) * bytes_of["estimate"]) / 1e3,
        recorder_gb=states * bytes_of["state"] * DAY_S / 1e9,
        journal_mb=jobs * record_b * DAY_S / 1e6,
    )


def print_loads() -> None:
    """Print the sizes and the table of loads."""
    print("bytes of messages:", ", ".join(f"{name} {size}" for name, size in sizes().items()))
    columns = (
        "arms", "sites", "state Hz", "asked", "jobs/s", "jobs/round", "site msg/s", "hub msg/s", "hub MB/s",
        "hub cores", "auct. cores", "round s", "full round s", "quote kB", "rec. GB/day", "jour. MB/day",
    )  # fmt: skip
    print("".join(f"{name:>13}" for name in columns))
    for arms, sites in ((64, 1), (256, 2), (1000, 10), (10_000, 100)):
        for state_hz, asked in ((STATE_HZ, 0), (STATE_HZ, 6), (1.0, 6)):
            at = load_of(arms, sites, state_hz=state_hz, asked=asked)
            cells = (
                at.arms, at.sites, f"{at.state_hz:g}", at.asked or "all", f"{at.jobs:.2f}", at.round_jobs,
                f"{at.site_router:.0f}", f"{at.hub_router:.0f}", f"{at.hub_mb:.2f}",
                f"{at.hub_router * COSTS.forward_s:.2f}", f"{at.auctioneer:.2f}", f"{at.round_s:.3f}",
                f"{at.full_round_s:.2f}", f"{at.quote_kb:.1f}", f"{at.recorder_gb:.1f}", f"{at.journal_mb:.1f}",
            )  # fmt: skip
            print("".join(f"{cell:>13}" for cell in cells))
