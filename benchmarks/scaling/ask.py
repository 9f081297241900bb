"""The value that is lost if few arms are asked for a quote of a job, in simulated shifts of one large cell."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from agents.policy import WAIT, plans_of
from agents.rules import Matching
from fleet.env.validation import actions_of
from fleet.env.vector import BatchEnv, Library
from fleet.observation import Observation
from scenarios.evaluate.statistics import interval
from scenarios.prepare.batch import library_of
from scenarios.prepare.fleet import Randomisation, prepare
from scenarios.run.metrics import common_figures
from scenarios.spec.jobs import weights_of
from scenarios.spec.load import load
from scenarios.spec.options import DifficultyName

Array = np.ndarray
ASKED = (1, 2, 3, 4, 6, 8)


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
    rate = arms / 4 * arrivals
    randomise = Randomisation(arrivals=(rate, rate))
    return repeated(library_of(prepare(load("quickstart"), difficulty=difficulty, randomise=randomise)), arms // 4)


def repeated(one: Library, times: int, peers: int = 1) -> Library:
    """Return a fleet several times, without stations or space that arms share; each observes its next few peers."""
    arms = len(one.arms) * times
    tables = one.tables._replace(
        ambient_c=np.tile(one.tables.ambient_c, (1, 1, times)),
        feasible=np.tile(one.tables.feasible, (1, 1, times)),
        too_heavy=np.tile(one.tables.too_heavy, (1, 1, times)),
        stations=np.zeros_like(one.tables.stations),
        excluded=np.zeros_like(one.tables.excluded),
        **{name: np.concatenate([getattr(one.tables, name)] * times, axis=1) for name in _PER_ARM},
    )
    near = tuple(tuple((a + n) % arms for n in range(1, peers + 1)) for a in range(arms))  # peers are not read
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
    library = large_cell(arms, difficulty, arrivals)
    full = np.array(list(shifts(library, range(seeds), None, "coolest")))
    print(f"{arms} arms, {arrivals:g} × arrivals, {seeds} shifts, {difficulty}; loss of value with 95 % interval")
    columns = (("asked", 14), ("quotes/job", 12), ("finished", 10), ("value", 9), ("loss %", 9), ("interval", 18))
    print("".join(f"{name:>{width}}" for name, width in (*columns, ("faults", 8), ("hot min", 9))))

    def line(name: str, rows: Array) -> None:
        loss = 100.0 * (full[:, 0] - rows[:, 0]) / full[:, 0]
        of_loss = interval(loss)
        bounds = "" if of_loss.note else f"{of_loss.low:.2f} … {of_loss.high:.2f}"
        mean = rows.mean(axis=0)
        print(
            f"{name:>14}{mean[4]:>12.1f}{mean[1]:>10.1f}{mean[0]:>9.1f}{loss.mean():>9.2f}"
            f"{bounds:>18}{mean[2]:>8.2f}{mean[3]:>9.1f}",
            flush=True,
        )

    line("all", full)
    for by in ("coolest", "random"):
        for asked in ASKED:
            line(f"{asked} {by}", np.array(list(shifts(library, range(seeds), asked, by))))
