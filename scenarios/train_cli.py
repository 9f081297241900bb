"""`thermofleet train`: a policy learned on a scenario."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from fleet.errors import FleetError
from scenarios.load import load
from scenarios.policies import policy_of
from scenarios.terminal import out_console, progress_bar, say


def train_command(
    scenario: Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")],
    algo: Annotated[
        str, typer.Option(help="mappo (one critic of the whole fleet) or ippo (each arm's own).")
    ] = "mappo",
    minutes: Annotated[float, typer.Option(help="How long; the twins' training before it not counted.")] = 30.0,
    iterations: Annotated[int | None, typer.Option(help="End earlier, after so many iterations in all.")] = None,
    warm_start: Annotated[
        str, typer.Option(help="Rule that the network imitates first, for example wspt; none if not given.")
    ] = "",
    envs: Annotated[int, typer.Option(help="Shifts side by side.")] = 64,
    seed: Annotated[int, typer.Option(help="Of the shifts, the network's start and the order of learning.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder; default runs/SCENARIO-ALGO-SEED.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the training in --out.")] = False,
    threads: Annotated[int, typer.Option(help="Of the network's arithmetic.")] = 1,
    difficulty: Annotated[str, typer.Option(help="What scores the plans: twin, blind or oracle.")] = "twin",
) -> None:
    """Train a policy by reinforcement learning, with checkpoints and curves; Ctrl-C keeps what there is.

    The folder then is a policy: `thermofleet compare SCENARIO --policies random,FOLDER`.
    """
    chosen = load(scenario)
    if threads < 1 or seed < 0:
        raise FleetError(f"--threads must be 1 or more and --seed 0 or more (got {threads}, {seed}).")
    if warm_start:
        policy_of(warm_start)
    where = out or Path("runs") / f"{chosen.name}-{algo}-{seed}"
    if find_spec("torchrl") is None:
        raise FleetError("Training needs TorchRL: pip install 'thermofleet[learn]' -c constraints.txt.")
    from agents.learned.ppo import PpoConfig, use_threads
    from scenarios.train import CURVE, TrainingPlan, train

    use_threads(threads)
    named: Any = algo
    try:
        config = PpoConfig(algorithm=named, envs=envs, seed=seed, warm_start=warm_start)
    except ValueError as error:
        raise FleetError(str(error)) from error
    plan = TrainingPlan(minutes=minutes, iterations=iterations)
    kind: Any = difficulty
    with progress_bar() as progress:
        done = train(chosen, config, where, plan, difficulty=kind, resume=resume, progress=progress, tell=say)
    stopped = "Interrupted after" if done.interrupted else "Trained"
    say(
        f"{stopped} {done.iterations} iterations, {done.env_steps} env steps, {done.seconds:.0f} s; the best network "
        f"has a mean reward of {done.best:.1f} a shift on the validation seeds.",
        out_console,
    )
    say(f"Curves: {where / CURVE}. Try it: thermofleet compare {scenario} --policies random,{where}", out_console)
