"""Commands that evaluate and train policies: suite, bounds, leaderboard and train; see `compare` too."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from fleet.errors import FleetError
from scenarios.cli.options import (
    MAX_SEED,
    DifficultyOption,
    JsonOption,
    RandomiseOption,
    RiskOption,
    number,
    parse_randomisation,
)
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar, say
from scenarios.schema_errors import choose


def suite_command(
    split: Annotated[
        str | None,
        typer.Option(help="List the instances of this split: train, validation, test or sizes.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the cells of the benchmark suite, or the instances of one of its splits.

    A cell is a group of arms with stations and tasks. An instance is a scenario
    in a cell with a seed: `thermofleet show test/0000` describes it.
    """
    from scenarios.suite.cells import CELLS
    from scenarios.suite.splits import manifest

    if split is not None:
        rows = manifest(split)
        if as_json:
            print_json([asdict(row) for row in rows])
            return
        table = plain_table("instance", "cell", "axes", "jobs", numbers=False)
        for row in rows:
            axes = ", ".join(f"{name} {value}" for name, value in asdict(row.axes).items())
            table.add_row(row.name, row.cell, axes, str(row.count))
        out_console.print(table)
        return
    if as_json:
        print_json({cell.name: {**asdict(cell), "stations_per_arm": cell.stations_per_arm} for cell in CELLS})
        return
    table = plain_table("split", "cell", "arms are", "stations per arm", "hours", "instances", numbers=False)
    for cell in CELLS:
        numbers = (f"{cell.stations_per_arm:.2g}", f"{cell.hours:g}", str(cell.instances))
        table.add_row(cell.split, cell.name, cell.unlike, *numbers)
    out_console.print(table)


def train_command(
    scenario: Annotated[
        str | None, typer.Argument(help="A library name, a .toml file or an instance of the suite; or use --suite.")
    ] = None,
    suite: Annotated[
        str | None,
        typer.Option(
            help="Split of the suite to train over, which must be train; validation is on the split validation.",
            show_default=False,
        ),
    ] = None,
    algo: Annotated[
        str | None,
        typer.Option(
            help="mappo (one critic for the whole fleet), ippo (one critic per arm), or pairs (scores of arm-job pairs "
            "by evolution, only with --suite); default: mappo, with --suite pairs.",
            show_default=False,
        ),
    ] = None,
    minutes: Annotated[
        float,
        number(
            "Training time excluding the twins, min. With --resume: additional time; with --resume and --seeds: total "
            "of each training.",
            0,
            100_000,
            above=True,
        ),
    ] = 30.0,
    iterations: Annotated[int | None, number("Maximum number of iterations in total.", 1, 1_000_000)] = None,
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
        number("Learning rate; default: 0.0003, with --algo pairs 0.08.", 0, 10, above=True, show_default=False),
    ] = None,
    entropy: Annotated[float, number("Weight of the entropy bonus; not with --algo pairs.", 0, 10)] = 0.002,
    instances: Annotated[
        int | None,
        number(
            "With --suite: number of training instances; default: 12, with --algo pairs 36.", 1, 200, show_default=False
        ),
    ] = None,
    validation_instances: Annotated[
        int | None,
        number(
            "With --suite: number of validation instances; default: 24, four shifts each, with --algo pairs 60, the "
            "shift of the benchmark each.",
            1,
            200,
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, number("Seed for shifts, initialisation and minibatches.", 0, MAX_SEED)] = 0,
    seeds: Annotated[int, number("Number of trainings, one after another, with seeds from --seed on.", 1, 100)] = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the policy; default: runs/SCENARIO-ALGO-SEED or runs/SPLIT-ALGO-SEED. Not with --seeds."
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the training in --out. With --seeds: continue trainings that have begun, skip complete "
            "ones, begin the others.",
        ),
    ] = False,
    threads: Annotated[int, number("Threads of the network's computations.", 1, 1024)] = 1,
    difficulty: DifficultyOption = "twin",
    risk: RiskOption = "rc",
    randomise: RandomiseOption = None,
) -> None:
    """Train a policy by reinforcement learning or evolution, with checkpoints and learning curves.

    The time of a training begins after the preparation of its instances, which takes
    some minutes the first time; the last iteration may exceed it. Ctrl-C ends the
    training and keeps the result so far.

    The folder can be used as a policy: `thermofleet compare SCENARIO --policies random,FOLDER`.
    """
    from scenarios.extras import require_extra
    from scenarios.load import INSTANCE, load
    from scenarios.policy_loader import policy_of, without_simulator

    if (scenario is None) == (suite is None):
        raise FleetError("Give either a scenario or --suite SPLIT.")
    if randomise and suite is not None:
        raise FleetError(
            "--randomise needs a scenario: the instances of --suite are fixed. Give a scenario instead of --suite."
        )
    varied = parse_randomisation(randomise)
    if seeds > 1 and out is not None:
        raise FleetError("--seeds makes several trainings: they go to runs/, leave --out away.")
    if suite is not None or INSTANCE.fullmatch(scenario or ""):
        choose("training split", suite or (scenario or "").partition("/")[0], TrainingSplit)
    from agents.learned.training_log import CURVE
    from fleet.env.validation import Decisions
    from scenarios.prepare.fleet import DifficultyName, RiskName
    from scenarios.run.training_folder import holds_training

    models: Any = {
        "difficulty": choose("difficulty", difficulty, DifficultyName),
        "risk": choose("risk", risk, RiskName),
    }
    algorithm = choose("algorithm", algo or ("mappo" if suite is None else "pairs"), Algorithm)
    if algorithm == "pairs" and suite is None:
        raise FleetError("--algo pairs trains over a split: give --suite, not a scenario.")
    chosen = load(scenario) if scenario is not None else None
    if warm_start:
        without_simulator(warm_start, policy_of(warm_start))
    places = [
        out or Path("runs") / f"{suite if chosen is None else chosen.name}-{algorithm}-{seed + k}" for k in range(seeds)
    ]
    length: Any = {"minutes": minutes, "iterations": iterations, "in_total": seeds > 1}
    grounds, judging, card = [], [], {"suite": suite, **models}
    if algorithm != "pairs":
        require_extra("learn")
        from scenarios.run.train_policy import TrainingPlan

        length = TrainingPlan(**length)
    else:
        from scenarios.run.train_pairs import PairPlan

        length = PairPlan(**length)
    if suite is not None:
        from scenarios.run.suite_batches import grounds_of
        from scenarios.suite.splits import split
        from scenarios.trials.cases import suite_of
        from scenarios.trials.scores import references_of

        usual = (36, 60) if algorithm == "pairs" else (12, 24)
        train = split(suite)[: instances or usual[0]]
        validation = split("validation")[: validation_instances or usual[1]]
        cases = [*suite_of(suite, 1)[: len(train)], *suite_of("validation", 1)[: len(validation)]]
        known = {shift: (each.random, each.hindsight) for shift, each in references_of(cases).items()}
        with progress_bar() as progress:
            grounds = grounds_of(train, **models, known=known, progress=progress)
            judging = grounds_of(validation, **models, known=known, progress=progress)
        card |= {"prepared": len(grounds), "judges": len(judging)}
    for k, where in enumerate(places):
        goes_on = resume and (seeds == 1 or holds_training(where))
        if algorithm == "pairs":
            from agents.learned.evolution import EvolutionConfig
            from scenarios.run.train_pairs import train_pairs

            search = EvolutionConfig(seed=seed + k, learning_rate=0.08 if lr is None else lr)
            done = train_pairs(grounds, judging, search, where, length, card=card, resume=goes_on, tell=say)
        else:
            from agents.learned.ppo import PpoConfig, use_threads
            from scenarios.run.train_policy import train, train_on_split

            use_threads(threads)
            try:
                config = PpoConfig(
                    algorithm=algorithm,
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
                common: Any = {"resume": goes_on, "progress": progress, "tell": say}
                if chosen is not None:
                    done = train(chosen, config, where, length, randomise=varied, **models, **common)
                else:
                    done = train_on_split(grounds, judging, config, where, length, card=card, **common)
        unit = "" if algorithm == "pairs" else " a shift" if chosen else " of the value of all jobs"
        say(
            f"{'Interrupted after' if done.interrupted else 'Trained'} {done.iterations} iterations, {done.seconds:.0f}"
            f" s; best {'score' if algorithm == 'pairs' else 'reward'} in validation {done.best:.4g}{unit}.",
            out_console,
        )
        target = scenario if suite is None else "--suite test"  # the split validation chose the best of the training
        how = f"{target} --difficulty {difficulty} --policies random,{where}"
        say(f"Curves: {where / CURVE}. Try it: thermofleet compare {how}", out_console)
        if done.interrupted:
            return


Algorithm = Literal["mappo", "ippo", "pairs"]
TrainingSplit = Literal["train"]
"""The other splits are for validation and for results."""
