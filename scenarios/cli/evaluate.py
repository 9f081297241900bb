"""Commands that evaluate and train policies: suite, bounds, leaderboard and train; see `compare` too.

`thermofleet compare`.

`thermofleet bounds`: random, best rule, hindsight and upper bound of shifts.

`thermofleet leaderboard`.
"""

import json
from dataclasses import asdict
from itertools import chain
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from agents.learned.config import PpoConfig
from agents.learned.evolution import TrainingLength
from agents.registry import RULES, WRAPPERS_HELP
from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.from_fields import From, Given
from scenarios.cli.options import JsonOption, RandomiseOption, number, parse_randomisation
from scenarios.cli.terminal import KEPT, echo, out_console, plain_table, print_json, progress_bar, say
from scenarios.result_folder import disk_errors
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import choose

if TYPE_CHECKING:
    from scenarios.evaluate.leaderboard import Submission


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
    from scenarios.suite.instances import CELLS
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
    from scenarios.policy_loader import policy_of, without_simulator
    from scenarios.spec.load import INSTANCE, load

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
    from agents.learned.evolution import CURVE
    from scenarios.train.instances import holds_training

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
        from scenarios.train.instances import training_instances

        usual = (36, 60) if algorithm == "pairs" else (12, 24)
        train = split(suite)[: instances or usual[0]]
        validation = split("validation")[: validation_instances or usual[1]]
        cases = [*suite_of(suite, 1)[: len(train)], *suite_of("validation", 1)[: len(validation)]]
        known = {shift: (each.random, each.hindsight) for shift, each in references_of(cases).items()}
        with progress_bar() as progress:
            grounds = training_instances(train, **sources, known=known, progress=progress)
            judging = training_instances(validation, **sources, known=known, progress=progress)
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


PAGE = "index.html"


def compare_command(
    ctx: typer.Context,
    scenario: Annotated[
        list[str] | None,
        typer.Argument(
            help="Library names (see `thermofleet show`) or .toml files; or use --suite.", show_default=False
        ),
    ] = None,
    policies: Annotated[
        str,
        typer.Option(
            help="Policies, separated by commas: names, FILE.py:CLASS, bus:NAME in another process, or folders of "
            "`thermofleet train` ('FOLDER-*': one policy with several trainings); POLICY@SOURCE for a policy with one "
            "source of predictions; "
            f"{WRAPPERS_HELP}. Default: {', '.join(RULES)}.",
            show_default=False,
        ),
    ] = ",".join(RULES),
    suite: Annotated[
        str | None,
        typer.Option(
            help="Instances that are judged together: train, validation, test or sizes; or instances of a split "
            "(test/0017), library names and .toml files, separated by commas.",
            show_default=False,
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        options.number("Number of seeds of each instance; default: 10, with --suite 1.", 1, 10_000, show_default=False),
    ] = None,
    first_seed: Annotated[
        int,
        options.number("First seed of a scenario. Compare on seeds that you did not tune on.", 0, options.MAX_SEED),
    ] = 0,
    fleets: Annotated[
        int, options.number("Number of fleets: draws of the arms' deviations (spread.seed).", 1, 100)
    ] = 1,
    trainings: Annotated[int, options.number("Number of trainings of each fleet's twins.", 1, 20)] = 1,
    baseline: Annotated[
        str | None,
        typer.Option(
            help="Policy that the paired differences refer to; default: round_robin if it is compared, else the first.",
            show_default=False,
        ),
    ] = None,
    difficulty: Annotated[
        str,
        typer.Option(
            help="Sources of predictions, separated by commas: twin, oracle (simulator), blind (none), or models to "
            "compare: trained, untrained, unweighted, torque, weighted-torque, rc-nominal, rc, random, inverted, "
            "constant. With several, POLICY@SOURCE names a policy."
        ),
    ] = "twin",
    risk: options.RiskOption = "rc",
    randomise: options.RandomiseOption = None,
    decision_limit: Annotated[
        float, options.number("Longest time for one decision of a policy, s. A slower policy fails.", 0.001, 86_400)
    ] = 60.0,
    references: Annotated[
        Path | None,
        typer.Option(
            help="Rows of `thermofleet bounds`, for normalised scores; splits use those of the package, if any.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results, one row per shift, and of their page, index.html. The same command continues "
            "after an interruption.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None, options.number("Number of processes; default: one per core.", 1, 1024, show_default=False)
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(help="Run on a Ray cluster: its address, `auto` for the one of this machine.", show_default=False),
    ] = None,
    marl_eval: Annotated[
        bool, typer.Option("--marl-eval", help="With --out: also write marl_eval.json, which marl-eval reads.")
    ] = False,
    as_json: options.JsonOption = False,
    topology: options.TopologyOption = "complete",
    radius: options.RadiusOption = 0.5,
    topology_seed: options.TopologySeedOption = 0,
    delay_s: options.DelayOption = 0.0,
    jitter_s: options.JitterOption = 0.0,
    loss: options.LossOption = 0.0,
    partition: options.PartitionOption = None,
) -> None:
    """Compare policies on the same seeds, with confidence intervals.

    With several scenarios each has its own table; with --suite one table covers all.
    The first failure of a policy is reported with instance, seed and traceback;
    the other policies and shifts continue.
    """
    from scenarios.evaluate.comparison import check_baseline, comparisons, rows_without_failures, scores_over_all
    from scenarios.evaluate.rollout import FIGURES
    from scenarios.evaluate.runner import run_study
    from scenarios.evaluate.scores import references_of, to_marl_eval
    from scenarios.evaluate.study import Study, cases_of, columns, suite_label, suite_of
    from scenarios.show.comparison_page import Judged, comparison_page, result_text, verdict
    from scenarios.spec.options import RiskName

    if bool(scenario) == bool(suite):
        raise FleetError("Give either scenarios or --suite.")
    if workers is not None and ray is not None:
        raise FleetError("Give either --workers or --ray.")
    if marl_eval and out is None:
        raise FleetError("--marl-eval needs --out, the folder that it writes to.")
    if references is not None and not references.is_file():
        raise FleetError(f"There is no file of references '{references}'; make it with `thermofleet bounds`.")
    varied = options.parse_randomisation(randomise)
    if references is not None and varied:
        raise FleetError("Give either --references or --randomise: references are of shifts without randomisation.")
    out = out and out.resolve()  # a policy may change the folder of the process
    cases = suite_of(suite, seeds or 1, first_seed) if suite else cases_of(scenario or [], seeds or 10, first_seed)
    channels = [
        options.channel_of(
            case.scenario, partition, topology=topology, radius=radius, topology_seed=topology_seed, delay_s=delay_s,
            jitter_s=jitter_s, loss=loss,
        )
        for case in cases
    ]  # fmt: skip
    study = Study(
        policies=options.split_names(policies),
        cases=cases,
        fleets=fleets,
        trainings=trainings,
        difficulties=options.split_names(difficulty),
        risk=choose("risk", risk, RiskName),
        randomise=varied,
        channel=channels[0],  # the same of all; each scenario has the arms that it names
        decision_limit_s=decision_limit,
    )
    names = study.competitors
    base = baseline or names.get(("round_robin", study.sources[0]), next(iter(names.values())))
    check_baseline(study, base)
    known = references_of(cases, references)
    with progress_bar(kept="Finished shifts are" if out else KEPT, file=out) as progress:
        rows = run_study(study, out=out, workers=workers or -1, ray=ray, progress=progress, tell=say)
    results = comparisons(study, rows, base, suite, known)
    values = scores_over_all(study, rows, known)
    title = f"Comparison of {len(names)} policies on {suite_label(suite or ','.join(case.name for case in cases))}"
    judged = Judged(title=title, results=results, values=values, card=study.card, command=options.command_line(ctx))
    if out:
        with disk_errors(out):
            (out / PAGE).write_text(comparison_page(judged), encoding="utf-8")
            if marl_eval:
                whole = chain.from_iterable(rows_without_failures(study, rows).values())
                table = to_marl_eval(map(columns, whole), FIGURES)
                (out / "marl_eval.json").write_text(json.dumps(table) + "\n", encoding="utf-8")
    if as_json:
        print_json(results[0] if len(results) == 1 else results)
        return
    for result in results:
        out_console.print(result_text(result))
    out_console.print("", *verdict(judged), sep="\n")
    if out:
        say(f"Written to {out}; open {out / PAGE}.")


def bounds_command(
    scenarios: Annotated[
        str | None,
        typer.Argument(
            help="Separated by commas: library names (see `thermofleet show`), .toml files, or instances of the suite, "
            "as test/0017.",
            show_default=False,
        ),
    ] = None,
    suite: Annotated[
        str | None, typer.Option(help="All instances of a split: train, validation, test or sizes.", show_default=False)
    ] = None,
    seeds: Annotated[int, options.number("Number of seeds of each scenario.", 1, 10_000)] = 5,
    first_seed: Annotated[int, options.number("First seed.", 0, options.MAX_SEED)] = 0,
    budget: Annotated[float, options.number("CPU seconds of the search for each shift.", 0, 86_400, above=True)] = 30.0,
    evaluations: Annotated[
        int | None,
        options.number(
            "End the search after this number of simulated shifts; the file then does not depend on other load.",
            1,
            10**9,
            show_default=False,
        ),
    ] = None,
    nodes: Annotated[
        int,
        options.number("Maximum nodes of the upper bound's branch and bound; 0: only the linear program.", 0, 10**6),
    ] = 2000,
    starts: Annotated[
        str | None,
        typer.Option(
            help="Policies that the search starts from, separated by commas; default: all but random. Without "
            "rolling_horizon it takes a tenth of the time.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[int, options.number("Number of processes.", 1, 1024)] = 1,
    difficulty: options.DifficultyOption = "oracle",
    out: Annotated[Path, typer.Option(help="File of the rows; finished ones are not computed again.")] = Path(
        "runs/bounds.jsonl"
    ),
    show_only: Annotated[bool, typer.Option("--show", help="Compute nothing: print all rows of the file.")] = False,
    format_: Annotated[str, typer.Option("--format", help="table, markdown or json.")] = "table",
) -> None:
    """Bound the best possible reward of shifts from both sides.

    Below: the mean of the policy random, the best built-in policy, and the best
    schedule that a search finds with all jobs known (hindsight). Above: an upper
    bound that no policy can exceed. Every row is kept as soon as it is known; the
    same command continues after an interruption. A larger budget searches again.
    With --evaluations in place of --budget, a repetition gives the same file.
    """
    choose("format", format_, Literal["table", "markdown", "json"])
    from scenarios.evaluate.hindsight import Budget
    from scenarios.evaluate.references import (
        STARTS,
        cells,
        heads_of,
        load_references,
        reference_table,
        references,
        tasks_of,
    )
    from scenarios.policy_loader import scope_of
    from scenarios.spec.options import DifficultyName

    if show_only:
        if not out.is_file():
            raise FleetError(f"--show prints a file of this command, and there is no file '{out}'.")
        found = load_references(out)
    else:
        if bool(scenarios) == bool(suite):
            raise FleetError("Give either scenarios or --suite.")
        tasks = tasks_of(suite or scenarios or "", seeds, first_seed)
        limit = Budget(seconds=budget, nodes=nodes)
        if evaluations is not None:
            limit = Budget(seconds=inf, evaluations=evaluations, nodes=nodes)
        source = choose("difficulty", difficulty, DifficultyName)
        policies = options.split_names(starts) if starts else STARTS
        for name in policies:
            scope_of(name)
        chosen: Any = {"difficulty": source, "workers": workers, "policies": policies}
        with progress_bar(kept="Finished rows are", file=out) as progress:
            found = references(tasks, out, limit, **chosen, progress=progress)
    if format_ == "json":
        print_json([asdict(each) | {"gap": each.gap, "rule_score": each.normalised(each.best_rule)} for each in found])
        return
    if format_ == "markdown":
        echo(reference_table(found))
        return
    shown = plain_table(*heads_of(found))
    for each in found:
        shown.add_row(*cells(each)[: len(shown.columns)])
    out_console.print(shown)
    if not show_only:
        say(f"Written to {out}.")


_SUBMIT = "Check a result and write the file to send"
FOLDER = Path("docs/results/leaderboard")
"""Of the results in a checkout."""


def leaderboard_command(
    folder: Annotated[Path, typer.Argument(help="Folder of results, one file for each policy.")] = FOLDER,
    split: Annotated[str, typer.Option(help="Split of the suite: test, sizes or validation.")] = "test",
    verify: Annotated[
        int, options.number("Number of shifts to repeat of each result of a built-in policy.", 0, 200)
    ] = 0,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the table as docs/leaderboard.md has it.")
    ] = False,
    as_json: options.JsonOption = False,
    submit: Annotated[
        Path | None,
        typer.Option(help="Folder of `thermofleet compare --suite test --out`.", rich_help_panel=_SUBMIT),
    ] = None,
    author: Annotated[
        str, typer.Option(help="--submit: name of the person who sends the result.", rich_help_panel=_SUBMIT)
    ] = "",
    about: Annotated[
        str,
        typer.Option(help="--submit: what the policy is, and where to get it; one sentence.", rich_help_panel=_SUBMIT),
    ] = "",
    policies: Annotated[
        str | None,
        typer.Option(
            help="--submit: policies of the folder, separated by commas; default: all.",
            show_default=False,
            rich_help_panel=_SUBMIT,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="--submit: folder for the files.", rich_help_panel=_SUBMIT)] = Path(),
) -> None:
    """Print the leaderboard: normalised scores of all results on a split.

    Every file is checked as by --submit. A failed shift counts as the mean of random.
    With --verify, repeated shifts must give equal figures. With --submit the results
    of a comparison on a whole split are checked, and one file per policy is written.
    """
    if submit is not None:
        if not author:
            raise FleetError("--submit needs --author, the name of the person who sends the result.")
        submit_results(submit, author, about, policies, out)
        return
    if author or about or policies is not None:
        raise FleetError("--author, --about and --policies are for --submit: leave them out.")
    from scenarios.evaluate.leaderboard import best_text, board_of, board_text, read_all, remark_text
    from scenarios.evaluate.statistics import LEGEND
    from scenarios.show.comparison_page import narrow_score_tables
    from scenarios.spec.schema import SplitName

    split = choose("split", split, SplitName)
    if not folder.is_dir():
        raise FleetError(f"'{folder}' is no folder; give the folder of the results.")
    found = read_all(folder, split)
    if verify:
        from scenarios.evaluate.leaderboard import check_repeated

        with progress_bar() as progress:
            for each in found:
                say(check_repeated(each, verify, progress))
    board = board_of(split, found)
    if as_json:
        print_json(board.scores if board else None)
    elif board is None or markdown:
        echo(board_text(board, split))
    else:
        sources = sorted({each.card.difficulty for each in board.entries.values()})
        labels = {
            name: each.card.policy
            + (f"@{each.card.difficulty}" if len(sources) > 1 else "")
            + (" (arm)" if each.card.scope == "arm" else "")
            for name, each in board.entries.items()
        }
        about = f"Predictions: {', '.join(sources)}. (arm): scope arm, others central. {LEGEND}."
        out_console.print(
            best_text(board), about, *narrow_score_tables(board.scores, labels), remark_text(board), sep="\n"
        )


def submit_results(results: Path, author: str, about: str, policies: str | None, out: Path) -> None:
    """Check results on a whole split, and write one file per policy for the leaderboard.

    Instances must have the hashes of the manifest, every shift must be there, and
    versions must be stated. A failed shift counts as the mean of random.
    """
    from scenarios.extras import require_extra

    require_extra("report")
    from scenarios.evaluate.leaderboard import check, split_references, submissions_of, write
    from scenarios.evaluate.store import read_card, read_rows
    from scenarios.policy_loader import label

    try:
        made: list[Submission] = submissions_of(read_card(results), read_rows(results), author, about)
    except (KeyError, TypeError, AttributeError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else f"has a value of another type ({error})"
        raise FleetError(f"'{results}' is damaged: its study.json {what}. Run the comparison again.") from error
    if policies is not None:
        wanted = [label(name) for name in options.split_names(policies)]
        unknown = [name for name in wanted if name not in {each.card.policy for each in made}]
        if unknown:
            raise FleetError(f"'{results}' has no results of {', '.join(unknown)}.")
        made = [each for each in made if each.card.policy in wanted]
    known = {split: split_references(split) for split in {each.card.split for each in made}}
    for each in made:
        check(each, known[each.card.split])
    for each in made:
        path = write(each, out)
        failed = f", {each.failures} failed shifts, which count as random" if each.failures else ""
        say(f"Checked: {len(each.rows)} shifts of {each.card.policy}{failed}. Written to {path}.")
