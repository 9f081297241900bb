"""Fleets of 1 000 and 10 000 arms: the table of loads, and the value that is lost if few arms are asked for a quote.

    python benchmarks/scaling.py [load] [ask] [--seeds 8] [--arms 64] [--arrivals 1.0] [--difficulty twin]

`load` is a calculation: the sizes of the messages are those of encoded examples, the rates those of the contract, and
the costs per message those of `COSTS`, which `docs/scaling.md` derives from measurements.
`ask` simulates shifts of one large cell: the arms of quickstart repeated, arrivals multiplied accordingly, every arm
with its own stations. The auctioneer matches jobs and arms by the quotes of k arms for each job. The arms are chosen by
what they publish anyway: free ones that can do the job, the coolest first, or at random. Each seed is the same shift
for all k, so differences are paired. Deterministic.
"""

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from agents.assignment import Matching
from agents.policy import WAIT, plans_of
from fleet.bus.protocol.auction import LEASE_S, Ack, Award, JobEstimate, JobSpec, PlanQuote, Quote, QuoteRequest
from fleet.bus.protocol.messages import State, encode
from fleet.bus.protocol.registry import STATE_HZ
from fleet.env.validation import actions_of
from fleet.env.vector import BatchEnv, Library
from fleet.live.arm.award_executor import RENEWALS
from fleet.live.auction.round import Timing
from fleet.observation import Observation
from scenarios.fault_price import weights_of
from scenarios.load import load
from scenarios.prepare.fleet import DifficultyName, prepare
from scenarios.run.batch import Randomisation, library_of
from scenarios.run.compare import interval
from scenarios.run.outcome import common_figures

Array = np.ndarray
ASKED = (1, 2, 3, 4, 6, 8)
JOB_S = 360.0
"""Real seconds between two jobs of an arm: quickstart has one job in 90 s for four arms."""
JOINTS, PLANS = 7, 2
DAY_S = 86_400.0


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
    quote_kb: float
    """Size of a quote, kB."""
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
        "award": len(encode(Award(name, "auctioneer", job, f"{arm}-abcd-000123", 0, 0))),
        "ack": len(encode(Ack(arm, name, True))),
    }


def load_of(arms: int, sites: int, *, state_hz: float, asked: int, costs: Costs = COSTS) -> Load:
    """The load of a fleet with one router per site and one more router for the auctioneer and the recorder.

    Jobs wait for a round as long as the round before takes, and at least 50 ms.

    Args:
        state_hz: States that each arm publishes a second.
        asked: Arms that are asked for a quote of a job; 0 for all.
    """
    bytes_of, limits = sizes(), Timing()
    jobs, per_job = arms / JOB_S, asked or arms
    round_s, round_jobs = 0.05, 1
    for _ in range(200):  # fixed point: a longer round collects more jobs
        round_jobs = max(1, min(limits.max_jobs, round(jobs * round_s)))
        replies = min(arms, per_job * round_jobs)
        work_s = replies * costs.request_s + per_job * round_jobs * costs.estimate_s + round_jobs * costs.award_s
        round_s = max(0.05, work_s)
    rounds = jobs / round_jobs
    replies = min(arms, per_job * round_jobs)
    per_quote = per_job * round_jobs / replies
    states, leases = arms * state_hz, arms * RENEWALS / LEASE_S
    queries = rounds * replies + jobs + leases  # each has a request and a reply
    quote_b = bytes_of["quote"] + per_quote * bytes_of["estimate"]
    # Auctioneer and recorder subscribe to states. A site's router receives each and sends it on once, to the hub.
    site = (2 * states + 4 * queries) / sites
    hub = 3 * states + 4 * queries
    received_b = states * bytes_of["state"] + rounds * replies * quote_b + (jobs + leases) * bytes_of["ack"]
    busy = states * costs.state_s + rounds * round_s * (1.0 if round_s > 0.05 else work_s / round_s)
    record_b = 2 * bytes_of["award"] + 3 * 150  # accepted, awarded, permitted, finished
    return Load(
        arms, sites, state_hz, asked, jobs, round_jobs, site, hub, received_b / 1e6,
        busy + leases * costs.request_s, round_s, quote_b / 1e3, states * bytes_of["state"] * DAY_S / 1e9,
        jobs * record_b * DAY_S / 1e6,
    )  # fmt: skip


def print_loads() -> None:
    """Print the sizes and the table of loads."""
    print("bytes of messages:", ", ".join(f"{name} {size}" for name, size in sizes().items()))
    columns = (
        "arms", "sites", "state Hz", "asked", "jobs/s", "jobs/round", "site msg/s", "hub msg/s", "hub MB/s",
        "hub cores", "auct. cores", "round s", "quote kB", "rec. GB/day", "jour. MB/day",
    )  # fmt: skip
    print("".join(f"{name:>13}" for name in columns))
    for arms, sites in ((64, 1), (256, 2), (1000, 10), (10_000, 10), (10_000, 100)):
        for state_hz, asked in ((STATE_HZ, 0), (STATE_HZ, 6), (1.0, 6)):
            at = load_of(arms, sites, state_hz=state_hz, asked=asked)
            cells = (
                at.arms, at.sites, f"{at.state_hz:g}", at.asked or "all", f"{at.jobs:.2f}", at.round_jobs,
                f"{at.site_router:.0f}", f"{at.hub_router:.0f}", f"{at.hub_mb:.2f}",
                f"{at.hub_router * COSTS.forward_s:.2f}", f"{at.auctioneer:.2f}", f"{at.round_s:.3f}",
                f"{at.quote_kb:.1f}", f"{at.recorder_gb:.1f}", f"{at.journal_mb:.1f}",
            )  # fmt: skip
            print("".join(f"{cell:>13}" for cell in cells))


class AskFew(Matching):
    """Matching by the quotes of `asked` arms for each job; scope central.

    The jobs of a round share the free arms as cards are dealt, so that all of them can be awarded.
    """

    def __init__(self, asked: int | None, by: str, seed: int) -> None:
        """Prepare; None asks all arms, `by` is `coolest` or `random`."""
        self.quotes = self.rounds = self.jobs = 0
        self._asked, self._by, self._rng = asked, by, np.random.default_rng(np.random.SeedSequence([seed, 1]))

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The claims of the arms that are asked."""
        seen = list(observations.values())
        plans = plans_of(seen[0])
        able = np.stack([one.action_mask[1:-1].reshape(-1, plans).any(axis=1) for one in seen])  # [arm, slot]
        slots = np.flatnonzero(able.any(axis=0)).tolist()
        if not slots:
            return dict.fromkeys(observations, WAIT)
        self.rounds += 1
        self.jobs += len(slots)
        if self._asked is None:
            self.quotes += int(able.sum())
            return super().act(observations)
        chosen = np.zeros_like(able)
        free = np.flatnonzero(able.any(axis=1))
        key = self._rng.random(len(free)) if self._by == "random" else [-float(seen[arm].headroom_k) for arm in free]
        turn = free[np.argsort(key, kind="stable")].tolist()
        for _ in range(self._asked):
            for slot in slots:
                arm = next((arm for arm in turn if able[arm, slot] and not chosen[arm, slot]), None)
                if arm is not None:
                    chosen[arm, slot] = True
                    turn.remove(arm)
                    turn.append(arm)
        self.quotes += int(chosen.sum())
        asked = {
            name: replace(one, action_mask=_masked(one.action_mask, chosen[i], plans))
            for i, (name, one) in enumerate(observations.items())
        }
        return super().act(asked)


def _masked(mask: Array, slots: Array, plans: int) -> Array:
    masked = mask.copy()
    masked[1:-1] *= np.repeat(slots, plans).astype(mask.dtype)
    return masked


_PER_ARM = (
    "thermal_step", "to_ambient", "root_capacity", "rates", "modes", "sensor_noise_k", "copper_w_per_a2", "idle_w",
    "rest_current_sq", "rest_friction_w", "start_c", "work", "housing_keep", "housing_gain", "housing_winding",
    "housing_ambient", "housing_idle_w", "start_housing_c",
)  # fmt: skip


def large_cell(arms: int, difficulty: DifficultyName, arrivals: float = 1.0) -> Library:
    """Return quickstart with its four arms repeated, arrivals multiplied, and stations and space of its own for each.

    Args:
        arms: A multiple of four.
        arrivals: Jobs per arm, relative to quickstart.
    """
    if arms % 4 or arms < 4:
        raise ValueError(f"The number of arms must be a multiple of four (got {arms}).")
    times, rate = arms // 4, arms / 4 * arrivals
    one = library_of([prepare(load("quickstart"), difficulty=difficulty)], Randomisation(arrivals=(rate, rate)))
    tables = one.tables._replace(
        ambient_c=np.tile(one.tables.ambient_c, (1, 1, times)),
        feasible=np.tile(one.tables.feasible, (1, 1, times)),
        too_heavy=np.tile(one.tables.too_heavy, (1, 1, times)),
        stations=np.zeros_like(one.tables.stations),
        excluded=np.zeros_like(one.tables.excluded),
        **{name: np.concatenate([getattr(one.tables, name)] * times, axis=1) for name in _PER_ARM},
    )
    near = tuple(((a + 1) % arms,) for a in range(arms))  # peers are not read
    return Library(tuple(f"arm_{a}" for a in range(arms)), one.slots, tables, one.draw, near)


def shifts(library: Library, seeds: Sequence[int], asked: int | None, by: str) -> Iterator[tuple[float, ...]]:
    """Value, jobs finished, faults, minutes above the warning limit and quotes a job of each seed's shift."""
    for seed in seeds:
        env = BatchEnv(
            library, 1, seed=[seed], weights=weights_of(load("quickstart")), autoreset=False, decisions="events"
        )
        policy, over = AskFew(asked, by, seed), False
        obs, _ = env.reset()
        while not over:
            mask, actions = obs["action_mask"], np.full((1, len(env.agents)), WAIT)
            if mask[0, :, 1:-1].any():
                known = {arm: env.layout.read(obs["observation"][0, a], mask[0, a]) for a, arm in enumerate(env.agents)}
                actions[0] = actions_of(env.agents, policy.act(known))
            obs, _, ended, cut, _ = env.step(actions)
            over = bool((ended | cut)[0])
        shift = library.draw(np.random.SeedSequence(seed))
        value, dt_s = library.tables.value[shift.fleet, shift.kind], library.tables.dt_s
        at = common_figures(env.state, 0, value, shift.due_s, dt_s)
        quotes = policy.quotes / max(policy.jobs, 1)
        yield at["value"], at["finished"], at["faults"], at["above_warning_min"], quotes


def print_asked(arms: int, seeds: int, difficulty: DifficultyName, arrivals: float) -> None:
    """Print the table of value against the number of arms that are asked."""
    library, rng = large_cell(arms, difficulty, arrivals), np.random.default_rng(np.random.SeedSequence(0))
    full = np.array(list(shifts(library, range(seeds), None, "coolest")))
    print(
        f"{arms} arms, {arrivals:g} × arrivals, {seeds} shifts, {difficulty}; asked: arms for each job; loss of value with 95 % interval"
    )
    print(
        f"{'asked':>14}{'quotes/job':>12}{'finished':>10}{'value':>9}{'loss %':>9}{'interval':>18}{'faults':>8}{'hot min':>9}"
    )

    def line(name: str, rows: Array) -> None:
        loss = 100.0 * (full[:, 0] - rows[:, 0]) / full[:, 0]
        low, high = interval(loss, rng)
        mean = rows.mean(axis=0)
        print(
            f"{name:>14}{mean[4]:>12.1f}{mean[1]:>10.1f}{mean[0]:>9.1f}{loss.mean():>9.2f}{f'{low:.2f} … {high:.2f}':>18}"
            f"{mean[2]:>8.2f}{mean[3]:>9.1f}",
            flush=True,
        )

    line("all", full)
    for by in ("coolest", "random"):
        for asked in ASKED:
            line(f"{asked} {by}", np.array(list(shifts(library, range(seeds), asked, by))))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", choices=("load", "ask"), default=("load", "ask"))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--arms", type=int, default=64)
    parser.add_argument("--arrivals", type=float, default=1.0, help="jobs per arm, relative to quickstart")
    parser.add_argument("--difficulty", choices=("twin", "blind"), default="twin")
    arguments = parser.parse_args()
    if "load" in arguments.tables:
        print_loads()
    if "ask" in arguments.tables:
        print_asked(arguments.arms, arguments.seeds, arguments.difficulty, arguments.arrivals)


if __name__ == "__main__":
    main()
