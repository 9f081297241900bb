"""`thermofleet train`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from fleet.errors import FleetError
from scenarios.cli.options import MAX_SEED, DifficultyOption, RiskOption, number
from scenarios.cli.terminal import out_console, progress_bar, say
from scenarios.extras import require_extra
from scenarios.load import load
from scenarios.policy_loader import policy_of
from scenarios.schema_errors import choose


def train_command(
    scenario: Annotated[
        str | None, typer.Argument(help="A library name, a .toml file or an instance of the suite; or use --suite.")
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(
            help="Train scores of arm-job pairs over the instances of this split by evolution, and validate them on "
            "the split validation. Iteration 0 is the rule wsept.",
            show_default=False,
        ),
    ] = None,
    algo: Annotated[
        str, typer.Option(help="mappo (one critic for the whole fleet) or ippo (one critic per arm); not with --suite.")
    ] = "mappo",
    minutes: Annotated[float, number("Training time excluding the twins, min.", 0, 100_000, above=True)] = 30.0,
    iterations: Annotated[
        int | None, number("Stop earlier, after this many iterations in total.", 1, 1_000_000)
    ] = None,
    warm_start: Annotated[
        str, typer.Option(help="Rule that the network imitates first, for example wspt; default: none.")
    ] = "",
    envs: Annotated[int, number("Shifts simulated in parallel.", 1, 65_536)] = 32,
    decisions: Annotated[
        str, typer.Option(help="Length of a training step: events (until an arm has a choice) or interval.")
    ] = "events",
    discount_hours: Annotated[
        float, number("Horizon of the discount: a reward this much later counts 1/e.", 0.01, 1000)
    ] = 2.0,
    lr: Annotated[
        float | None,
        number("Learning rate; default: 0.0003, with --suite 0.04.", 0, 10, above=True, show_default=False),
    ] = None,
    entropy: Annotated[float, number("Weight of the entropy bonus; not with --suite.", 0, 10)] = 0.002,
    instances: Annotated[int, number("Prepared training instances of --suite.", 1, 200)] = 48,
    judges: Annotated[int, number("Validation instances of --suite, four shifts each.", 1, 200)] = 24,
    seed: Annotated[int, number("Seed for shifts, initialisation and minibatches.", 0, MAX_SEED)] = 0,
    seeds: Annotated[int, number("Number of trainings, from --seed on, one after another.", 1, 100)] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the policy; default: runs/SCENARIO-ALGO-SEED. Not with --seeds.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the training in --out.")] = False,
    threads: Annotated[int, number("Threads of the network's computations.", 1, 1024)] = 1,
    difficulty: DifficultyOption = "twin",
    risk: RiskOption = "rc",
) -> None:
    """Train a policy by reinforcement learning, with checkpoints and learning curves; Ctrl-C keeps the result so far.

    The folder can be used as a policy: `thermofleet compare SCENARIO --policies random,FOLDER`.
    """
    if (scenario is None) == (suite is None):
        raise FleetError("Give either a scenario or --suite SPLIT.")
    if seeds > 1 and out is not None:
        raise FleetError("--seeds makes several trainings: they go to runs/, leave --out away.")
    from fleet.env.validation import Decisions
    from scenarios.prepare.fleet import DifficultyName, RiskName

    models: Any = {
        "difficulty": choose("difficulty", difficulty, DifficultyName),
        "risk": choose("risk", risk, RiskName),
    }
    plan = {"minutes": minutes, "iterations": iterations}
    chosen = load(scenario) if scenario is not None else None
    name = f"{suite}-pairs" if chosen is None else f"{chosen.name}-{algo}"
    places = [out or Path("runs") / f"{name}-{seed + k}" for k in range(seeds)]
    if suite is not None:
        _train_suite(suite, places, seed, lr, plan, models, instances, judges, resume=resume)
        return
    assert chosen is not None
    if warm_start:
        policy_of(warm_start)
    require_extra("learn")
    from agents.learned.ppo import Algorithm, PpoConfig, use_threads
    from scenarios.run.train_policy import CURVE, TrainingPlan, train

    use_threads(threads)
    for k, where in enumerate(places):
        try:
            config = PpoConfig(
                algorithm=choose("algorithm", algo, Algorithm),
                envs=envs,
                decisions=choose("kind of step", decisions, Decisions),
                discount_s=3600.0 * discount_hours,
                learning_rate=3e-4 if lr is None else lr,
                entropy=entropy,
                seed=seed + k,
                warm_start=warm_start,
            )
        except ValueError as error:
            raise FleetError(str(error)) from error
        with progress_bar() as progress:
            done = train(
                chosen, config, where, TrainingPlan(**plan), **models, resume=resume, progress=progress, tell=say
            )
        stopped = "Interrupted after" if done.interrupted else "Trained"
        say(
            f"{stopped} {done.iterations} iterations, {done.env_steps} env steps, {done.seconds:.0f} s; the best "
            f"network has a mean reward of {done.best:.1f} a shift on the validation seeds.",
            out_console,
        )
        say(f"Curves: {where / CURVE}. Try it: thermofleet compare {scenario} --policies random,{where}", out_console)


def _train_suite(
    suite: str,
    places: Sequence[Path],
    seed: int,
    lr: float | None,
    plan: Mapping[str, Any],
    models: Mapping[str, Any],
    instances: int,
    judges: int,
    *,
    resume: bool,
) -> None:
    """Trainings of scores of pairs, one for each folder."""
    from agents.learned.evolution import EvolutionConfig
    from scenarios.run.suite_batches import grounds_of
    from scenarios.run.train_pairs import CURVE, PairPlan, train_pairs

    length = PairPlan(**plan)
    with progress_bar() as progress:
        grounds = grounds_of(suite, instances, **models, progress=progress)
        judging = grounds_of("validation", judges, **models, progress=progress)
    card = {"suite": suite, **models, "prepared": len(grounds), "judges": len(judging)}
    for k, where in enumerate(places):
        config = EvolutionConfig(seed=seed + k, learning_rate=0.04 if lr is None else lr)
        done = train_pairs(grounds, judging, config, where, length, card=card, resume=resume, tell=say)
        stopped = "Interrupted after" if done.interrupted else "Trained"
        say(
            f"{stopped} {done.iterations} iterations, {done.shifts} shifts, {done.seconds:.0f} s; the best parameters "
            f"have {done.best:.3f} of the value on the validation shifts, wsept {done.teacher:.3f}.",
            out_console,
        )
        say(
            f"Curves: {where / CURVE}. Try it: thermofleet compare --suite validation --policies wsept,{where}",
            out_console,
        )
        if done.interrupted:
            return
