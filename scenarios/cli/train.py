"""`thermofleet train`."""

from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli.options import MAX_SEED, DifficultyOption, RiskOption, ScenarioArg, number
from scenarios.cli.terminal import out_console, progress_bar, say
from scenarios.extras import require_extra
from scenarios.load import load
from scenarios.policy_loader import policy_of
from scenarios.schema_errors import choose


def train_command(
    scenario: ScenarioArg,
    algo: Annotated[
        str, typer.Option(help="mappo (one critic for the whole fleet) or ippo (one critic per arm).")
    ] = "mappo",
    minutes: Annotated[float, number("Training time excluding the twins, min.", 0, 100_000, above=True)] = 30.0,
    iterations: Annotated[
        int | None, number("Stop earlier, after this many iterations in total.", 1, 1_000_000)
    ] = None,
    warm_start: Annotated[
        str, typer.Option(help="Rule that the network imitates first, for example wspt; default: none.")
    ] = "",
    envs: Annotated[int, number("Shifts simulated in parallel.", 1, 65_536)] = 64,
    seed: Annotated[int, number("Seed for shifts, initialisation and minibatches.", 0, MAX_SEED)] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder of the policy; default: runs/SCENARIO-ALGO-SEED.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the training in --out.")] = False,
    threads: Annotated[int, number("Threads of the network's computations.", 1, 1024)] = 1,
    difficulty: DifficultyOption = "twin",
    risk: RiskOption = "rc",
) -> None:
    """Train a policy by reinforcement learning, with checkpoints and learning curves; Ctrl-C keeps the result so far.

    The folder can be used as a policy: `thermofleet compare SCENARIO --policies random,FOLDER`.
    """
    chosen = load(scenario)
    if warm_start:
        policy_of(warm_start)
    where = out or Path("runs") / f"{chosen.name}-{algo}-{seed}"
    require_extra("learn")
    from agents.learned.ppo import Algorithm, PpoConfig, use_threads
    from scenarios.prepare.fleet import DifficultyName, RiskName
    from scenarios.run.train_policy import CURVE, TrainingPlan, train

    use_threads(threads)
    algorithm = choose("algorithm", algo, Algorithm)
    try:
        config = PpoConfig(algorithm=algorithm, envs=envs, seed=seed, warm_start=warm_start)
    except ValueError as error:
        raise FleetError(str(error)) from error
    plan = TrainingPlan(minutes=minutes, iterations=iterations)
    models = {"difficulty": choose("difficulty", difficulty, DifficultyName), "risk": choose("risk", risk, RiskName)}
    with progress_bar() as progress:
        done = train(chosen, config, where, plan, **models, resume=resume, progress=progress, tell=say)
    stopped = "Interrupted after" if done.interrupted else "Trained"
    say(
        f"{stopped} {done.iterations} iterations, {done.env_steps} env steps, {done.seconds:.0f} s; the best network "
        f"has a mean reward of {done.best:.1f} a shift on the validation seeds.",
        out_console,
    )
    say(f"Curves: {where / CURVE}. Try it: thermofleet compare {scenario} --policies random,{where}", out_console)
