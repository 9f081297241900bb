"""Commands that evaluate and train policies: suite, bounds, leaderboard and train; see `compare` too."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from agents.learned.config import PpoConfig
from agents.learned.training_log import TrainingLength
from fleet.errors import FleetError
from scenarios.cli.from_fields import From, Given
from scenarios.cli.options import JsonOption, RandomiseOption, number, parse_randomisation
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar, say
from scenarios.schema_errors import choose
from scenarios.specs import RunSpec


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
    given: Annotated[Given, From(PpoConfig, "warm_start", "envs", "decisions", "learning_rate", "entropy", "seed")],
    length: Annotated[Given, From(TrainingLength, "minutes", "iterations")],
    models: Annotated[Given, From(RunSpec, "difficulty", "risk")],
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
    discount_hours: Annotated[
        float, number("Horizon of the discount: a reward this much later counts 1/e.", 0.01, 1000)
    ] = 2.0,
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
    from scenarios.train.folder import holds_training

    spec, seed = RunSpec(**models), given.pop("seed", 0)
    sources: Any = {"difficulty": spec.difficulty, "risk": spec.risk}
    algorithm = choose("algorithm", algo or ("mappo" if suite is None else "pairs"), Algorithm)
    if algorithm == "pairs" and suite is None:
        raise FleetError("--algo pairs trains over a split: give --suite, not a scenario.")
    chosen = load(scenario) if scenario is not None else None
    if teacher := given.get("warm_start"):
        without_simulator(teacher, policy_of(teacher))
    places = [
        out or Path("runs") / f"{suite if chosen is None else chosen.name}-{algorithm}-{seed + k}" for k in range(seeds)
    ]
    length["in_total"] = seeds > 1
    grounds, judging, card = [], [], {"suite": suite, **sources}
    if algorithm != "pairs":
        require_extra("learn")
    if suite is not None:
        from scenarios.evaluate.scores import references_of
        from scenarios.evaluate.study import suite_of
        from scenarios.suite.splits import split
        from scenarios.train.instances import grounds_of

        usual = (36, 60) if algorithm == "pairs" else (12, 24)
        train = split(suite)[: instances or usual[0]]
        validation = split("validation")[: validation_instances or usual[1]]
        cases = [*suite_of(suite, 1)[: len(train)], *suite_of("validation", 1)[: len(validation)]]
        known = {shift: (each.random, each.hindsight) for shift, each in references_of(cases).items()}
        with progress_bar() as progress:
            grounds = grounds_of(train, **sources, known=known, progress=progress)
            judging = grounds_of(validation, **sources, known=known, progress=progress)
        card |= {"prepared": len(grounds), "judges": len(judging)}
    for k, where in enumerate(places):
        goes_on = resume and (seeds == 1 or holds_training(where))
        if algorithm == "pairs":
            from agents.learned.evolution import EvolutionConfig
            from scenarios.train.pairs import PairPlan, train_pairs

            rate = {name: value for name, value in given.items() if name == "learning_rate"}
            search = EvolutionConfig(seed=seed + k, **rate)
            plan = PairPlan(**length)
            done = train_pairs(grounds, judging, search, where, plan, card=card, resume=goes_on, tell=say)
        else:
            from agents.learned.ppo import use_threads
            from scenarios.train.networks import TrainingPlan, train, train_on_split

            use_threads(threads)
            discount_s, plan = 3600.0 * discount_hours, TrainingPlan(**length)
            config = PpoConfig(algorithm=algorithm, discount_s=discount_s, seed=seed + k, **given)
            with progress_bar() as progress:
                common: Any = {"resume": goes_on, "progress": progress, "tell": say}
                if chosen is not None:
                    done = train(chosen, config, where, plan, randomise=varied, **sources, **common)
                else:
                    done = train_on_split(grounds, judging, config, where, plan, card=card, **common)
        unit = "" if algorithm == "pairs" else " a shift" if chosen else " of the value of all jobs"
        say(
            f"{'Interrupted after' if done.interrupted else 'Trained'} {done.iterations} iterations, {done.seconds:.0f}"
            f" s; best {'score' if algorithm == 'pairs' else 'reward'} in validation {done.best:.4g}{unit}.",
            out_console,
        )
        target = scenario if suite is None else "--suite test"  # the split validation chose the best of the training
        how = f"{target} --difficulty {spec.difficulty} --policies random,{where}"
        say(f"Curves: {where / CURVE}. Try it: thermofleet compare {how}", out_console)
        if done.interrupted:
            return


Algorithm = Literal["mappo", "ippo", "pairs"]
TrainingSplit = Literal["train"]
"""The other splits are for validation and for results."""
