"""Who may claim what, and who gets it: slots, legal actions, and one winner per job and station."""

from dataclasses import dataclass

import numpy as np

from fleet.sim.state import DONE, WAITING, State, World
from fleet.telemetry import IDLE, WORKING

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Claims:
    """Outcome of one round of claims."""

    won: Array
    """Index of the job each arm was awarded, int [env, arm], −1 for none."""
    lost: Array
    """A legal claim that somebody else won, bool [env, arm]."""
    illegal: Array
    """An action outside the mask, bool [env, arm]."""
    wanted: Array
    """The job each arm legally claimed, int [env, arm], −1 for none."""


@dataclass(frozen=True, eq=False)
class Board:
    """What hangs out to be claimed at the beginning of a step."""

    on_offer: Array
    """Of `slots`, int [env, slot]."""
    mask: Array
    """Of `legal`, bool [env, arm, slot + 1]."""


def board(world: World, state: State) -> Board:
    """The jobs on offer, and who may claim them."""
    on_offer = slots(world, state)
    return Board(on_offer, legal(world, state, on_offer))


def per_slot(values: Array, on_offer: Array) -> Array:
    """[env, arm, slot] of something known per [env, arm, job]; empty slots hold that of some job."""
    envs, arms = values.shape[:2]
    return values[np.arange(envs)[:, None, None], np.arange(arms)[:, None], on_offer[:, None, :]]


def slots(world: World, state: State) -> Array:
    """Jobs on offer, oldest in the queue first, int [env, slot], −1 for an empty slot.

    A job is on offer once it is released, all jobs it waits for are done, and nobody works on it. A job that a
    fault sent back queues again at the end, so it does not block the others.
    """
    jobs = world.jobs
    time_s = (state.tick * world.dt_s)[:, None]
    done = np.ones((world.envs, state.status.shape[1] + 1), dtype=bool)  # column −1: no job
    done[:, :-1] = state.status == DONE
    env = np.arange(world.envs)[:, None]
    ready = done[env[..., None], jobs.after].all(axis=-1)
    offered = jobs.exists & (state.status == WAITING) & (jobs.release_s <= time_s) & ready
    key = np.where(offered, state.queued_s, np.inf)
    order = np.argsort(key, axis=1, kind="stable")[:, : world.slots]
    found = np.where(offered[env, order], order, -1)
    if found.shape[1] < world.slots:
        found = np.pad(found, ((0, 0), (0, world.slots - found.shape[1])), constant_values=-1)
    return found


def occupied(world: World, state: State) -> Array:
    """Which stations have an arm at work, bool [env, station + 1]; the last column is a dummy, always free."""
    taken = np.zeros((world.envs, len(world.stations) + 1), dtype=bool)
    env, arm = np.nonzero(state.mode == WORKING)
    at = world.jobs.stations[env, state.job[env, arm]]  # [row, n], −1 points at the dummy
    taken[env[:, None], at] = True
    taken[:, -1] = False
    return taken


def legal(world: World, state: State, on_offer: Array) -> Array:
    """Legal actions, bool [env, arm, slot + 1]; action 0, wait or go on, always is."""
    envs, arms = state.mode.shape
    env = np.arange(envs)[:, None]
    filled = on_offer >= 0
    busy = occupied(world, state)[env[..., None], world.jobs.stations[env, on_offer]].any(axis=-1)  # [env, slot]
    can = per_slot(world.offers.plan, on_offer) >= 0  # [env, arm, slot]
    free = (state.mode == IDLE)[..., None]
    mask = np.ones((envs, arms, world.slots + 1), dtype=bool)
    mask[..., 1:] = free & (filled & ~busy)[:, None, :] & can
    return mask


def resolve(world: World, state: State, board: Board, actions: Array, scores: Array) -> Claims:
    """Award every claimed job to one arm: the lower shared score wins, then the lower index.

    Args:
        board: Of the same state.
        actions: int [env, arm]; anything outside the mask counts as illegal and as a wait.
        scores: Shared difficulty, [env, arm, slot]; NaN loses against any number.
    """
    envs, arms = actions.shape
    env, arm = np.arange(envs)[:, None], np.arange(arms)[None, :]
    inside = (actions >= 0) & (actions <= world.slots)
    chosen = np.where(inside, actions, 0)
    allowed = inside & board.mask[env, arm, chosen]
    slot = np.where(allowed & (chosen > 0), chosen - 1, -1)
    wanted = np.where(slot >= 0, board.on_offer[env, slot], -1)
    claimed, score = slot >= 0, scores[env, arm, slot]
    score = np.where(score < np.inf, score, np.finfo(float).max)
    order = np.argsort(np.where(claimed, score, np.inf), axis=1, kind="stable")  # who claims nothing comes last
    taken = np.zeros((envs, world.jobs.exists.shape[1] + 1), dtype=bool)
    busy = occupied(world, state)
    won = np.full_like(wanted, -1)
    rows = np.arange(envs)
    for rank in range(int(claimed.sum(axis=1).max(initial=0))):
        who = order[:, rank]
        job = wanted[rows, who]
        at = world.jobs.stations[rows, job]
        gets = (job >= 0) & ~taken[rows, job] & ~busy[rows[:, None], at].any(axis=1)
        won[rows[gets], who[gets]] = job[gets]
        taken[rows[gets], job[gets]] = True
        busy[rows[gets][:, None], at[gets]] = True
        busy[:, -1] = False
    return Claims(won=won, lost=(wanted >= 0) & (won < 0), illegal=~allowed, wanted=wanted)
