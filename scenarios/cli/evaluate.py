"""Commands that evaluate and train policies: compare, bounds, leaderboard and train."""

from collections.abc import Callable
from dataclasses import asdict, replace
from math import inf
from os import cpu_count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from agents.learned.config import PpoConfig, TrainingLength
from agents.registry import RULES, WRAPPERS_HELP
from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError
from fleet.fields import MAX_SEED, argument, option
from scenarios.cli import options
from scenarios.cli.options import From, Given
from scenarios.result_folder import check_folder, disk_errors, new_file
from scenarios.spec.options import Budget, RunSpec, StudySpec
from scenarios.table import TABLE_FILES
from scenarios.terminal import KEPT, echo, out_console, print_json, progress_bar, say

if TYPE_CHECKING:
    from scenarios.evaluate.leaderboard import BoardResult
    from scenarios.prepare.randomisation import Randomisation
    from scenarios.train.training import Trained


Algorithm = Literal["mappo", "ippo"]
TrainingSplit = Literal["train"]
"""The other splits are for validation and for results."""
_OF_NETWORKS = ("algo", "randomise", "warm_start", "envs", "decisions", "entropy", "discount_hours", "threads")
"""Options of `train` for networks alone."""
BoardSplit = Literal["test", "validation"]
PAGE = "index.html"
_SUBMIT = "Check a result and write the file to send"
FOLDER = Path("docs/results/leaderboard")
"""Folder of the results in a checkout."""


def train_command(
    ctx: typer.Context,
    scenario: str | None = argument("A library name, a .toml file or an instance of the suite; or use --suite.", None),
    *,
    given: Annotated[Given, From(PpoConfig, "warm_start", "envs", "decisions", "learning_rate", "entropy", "seed")],
    length: Annotated[Given, From(TrainingLength, "minutes", "iterations")],
    models: Annotated[Given, From(RunSpec, "difficulty", "risk")],
    suite: str | None = option(
        "Split of the suite to train prices of `bid_price` over by evolution; must be train. Validation is on the "
        "split validation.",
        None,
    ),
    algo: Algorithm | None = option(
        "With a scenario: mappo (one critic for the whole fleet; default) or ippo (one critic per arm).",
        None,
        noun="algorithm",
    ),
    discount_hours: float = option(
        "Time constant of the discount, h: a reward this much later counts 1/e. Not with --suite.",
        2.0,
        low=0.01,
        high=1000,
    ),
    instances: int = option("With --suite: number of training instances.", 48, low=1, high=200),
    validation_instances: int = option("With --suite: number of validation instances.", 80, low=1, high=200),
    seeds: int = option("Number of trainings, one after another; the first has --seed.", 1, low=1, high=100),
    out: Path | None = option(
        "Folder of the policy; default: runs/SCENARIO-ALGO-SEED or runs/SPLIT-pairs-SEED. Not with --seeds.", None
    ),
    resume: bool = option(
        "Continue the training in --out. With --seeds: continue unfinished trainings, skip complete ones, and "
        "start the others.",
        False,
    ),
    threads: int = option("Threads of the network's computations. Not with --suite.", 1, low=1, high=1024),
    randomise: list[str] | None = options.RANDOMISE,
) -> None:
    """Train a policy by reinforcement learning or evolution, with checkpoints and learning curves.

    The time of a training begins after the preparation of its instances, which takes
    some minutes the first time; the last iteration may exceed it. Ctrl-C ends the
    training and keeps the result so far.

    The folder can be used as a policy: `thermofleet compare SCENARIO --policies random,FOLDER`.
    """
    from scenarios.policy_loader import policy_of, without_simulator
    from scenarios.spec.load import INSTANCE
    from scenarios.spec.parse import choose

    if (scenario is None) == (suite is None):
        raise FleetError("Give either a scenario or --suite SPLIT.")
    if suite is None and (needless := options.first_given(ctx, "instances", "validation_instances")):
        raise FleetError(f"{needless} needs --suite; a scenario is one instance.")
    if suite is not None and (needless := options.first_given(ctx, *_OF_NETWORKS)):
        raise FleetError(f"{needless} needs a scenario: --suite trains prices of bid_price over fixed instances.")
    varied = options.parse_randomisation(randomise)
    if seeds > 1 and out is not None:
        raise FleetError(f"--seeds {seeds} trains into folders of runs/: leave --out out (got {out}).")
    if out is not None:
        check_folder(out)
    if suite is not None or INSTANCE.fullmatch(scenario or ""):
        choose("training split", suite or (scenario or "").partition("/")[0], TrainingSplit)
    spec, seed = RunSpec(**models), given.pop("seed", 0)
    sources = {"difficulty": spec.difficulty, "risk": spec.risk}
    if teacher := given.get("warm_start"):
        without_simulator(teacher, policy_of(teacher))
    length["in_total"] = seeds > 1
    if suite is not None:
        name, train_one = _pair_training(suite, instances, validation_instances, given, length, sources)
    else:
        config = {**given, "algorithm": algo or "mappo", "discount_s": 3600.0 * discount_hours}
        name, train_one = _network_training(scenario or "", config, length, sources, varied, threads)

    from agents.learned.evolution import CURVE
    from scenarios.train.training import holds_training

    for k in range(seeds):
        where = out or Path("runs") / f"{name}-{seed + k}"
        done = train_one(where, seed + k, resume and (seeds == 1 or holds_training(where)))
        first = "bid_price itself" if suite else f"imitation of {teacher} alone" if teacher else "an untrained network"
        say(
            f"{'Interrupted after' if done.interrupted else 'Trained'} {done.iterations} iterations, {done.seconds:.0f}"
            f" s. Saved: iteration {done.kept}{'' if done.kept else f' ({first})'}, with the best "
            f"validation: {'score' if suite else 'reward'} {done.best:.4g}{'' if suite else ' a shift'}.",
            out_console,
        )
        target = scenario if suite is None else "--suite test"  # the split validation chose the best of the training
        how = f"{target} --difficulty {spec.difficulty} --policies random,{where}"
        say(f"Curves: {where / CURVE}. Try it: thermofleet compare {how}", out_console)
        if done.interrupted:
            return


TrainOne = Callable[[Path, int, bool], "Trained"]
"""One training into a folder, with a seed; True continues it."""


def _pair_training(
    suite: str, instances: int, validation_instances: int, given: Given, length: Given, sources: dict[str, Any]
) -> tuple[str, TrainOne]:
    """Return the name and the training of prices of `bid_price` over instances of the suite."""
    from agents.learned.evolution import EvolutionConfig
    from scenarios.evaluate.scores import references_of
    from scenarios.evaluate.study import suite_of
    from scenarios.suite.splits import split
    from scenarios.train.pairs import PairPlan, train_pairs, training_instances

    chosen = [split(suite)[:instances], split("validation")[:validation_instances]]
    cases = [*suite_of(suite, 1)[:instances], *suite_of("validation", 1)[:validation_instances]]
    known = references_of(cases)
    with progress_bar() as progress:
        training, validation = (training_instances(each, **sources, known=known, progress=progress) for each in chosen)
    card = {"suite": suite, **sources, "prepared": len(training), "judges": len(validation)}
    rate = {field: value for field, value in given.items() if field == "learning_rate"}

    def train_one(where: Path, seed: int, resume: bool) -> "Trained":
        config, plan = EvolutionConfig(seed=seed, **rate), PairPlan(**length)
        return train_pairs(training, validation, config, where, plan, card=card, resume=resume, tell=say)

    return f"{suite}-pairs", train_one


def _network_training(
    name: str,
    config: dict[str, Any],
    length: Given,
    sources: dict[str, Any],
    varied: "Randomisation | None",
    threads: int,
) -> tuple[str, TrainOne]:
    """Return the name and the training of a network for a scenario."""
    from scenarios.extras import require_extra
    from scenarios.spec.load import load

    require_extra("learn")
    from agents.learned.ppo import use_threads
    from scenarios.train.networks import TrainingPlan, train

    use_threads(threads)
    scenario = load(name)

    def train_one(where: Path, seed: int, resume: bool) -> "Trained":
        plan = TrainingPlan(**length)
        how = {"randomise": varied, **sources, "resume": resume, "tell": say}
        with progress_bar() as progress:
            return train(scenario, PpoConfig(seed=seed, **config), where, plan, progress=progress, **how)

    return f"{scenario.name}-{config['algorithm']}", train_one


def compare_command(
    ctx: typer.Context,
    scenario: list[str] | None = argument(
        "Library names (see `thermofleet show`) or .toml files; or use --suite.", None
    ),
    *,
    policies: str = option(
        "Policies, separated by commas: names, FILE.py:CLASS, bus:NAME in another process, or folders of "
        "`thermofleet train` ('FOLDER-*': one policy with several trainings); POLICY@SOURCE for a policy with one "
        "source of predictions; "
        f"{WRAPPERS_HELP}. Default: {', '.join(RULES)}.",
        ",".join(RULES),
        shown="",
    ),
    suite: str | None = option(
        "Instances for one joint table: a split (train, validation or test); or instances (test/0017), "
        "library names and .toml files, separated by commas.",
        None,
    ),
    seeds: int | None = option(
        "Number of seeds of each instance; default: 10, with --suite 1.", None, low=1, high=10_000
    ),
    first_seed: int = option(
        "First seed of a scenario. Compare on seeds that you did not tune on.", 0, low=0, high=MAX_SEED
    ),
    spec: Annotated[Given, From(StudySpec)],
    baseline: str | None = option(
        "Policy that the paired differences refer to; default: round_robin if it is compared, else the first.", None
    ),
    difficulty: str = option(
        "Sources of predictions, separated by commas: twin, oracle (simulator), blind (none), or models to "
        "compare: trained, untrained, unweighted, torque, rc-nominal, rc, random; trained-alone, untrained-alone "
        "and torque-alone without thermometers. With several, POLICY@SOURCE names a policy.",
        "twin",
    ),
    randomise: list[str] | None = options.RANDOMISE,
    references: Path | None = option(
        "Rows of `thermofleet bounds`, for normalised scores; splits use those of the package, if any.", None
    ),
    out: Path | None = option(
        "Folder of the results, one row per shift, and of their page, index.html. The same command continues "
        "after an interruption. Or a file of the table of figures: .csv or .xlsx.",
        None,
    ),
    workers: int | None = options.WORKERS,
    ray: str | None = option("Run on a Ray cluster: its address, `auto` for the one of this machine.", None),
    as_json: bool = options.JSON,
    channel: Annotated[Given, From(Channel)],
) -> None:
    """Compare policies on the same seeds, with confidence intervals.

    With several scenarios each has its own table; with --suite one table covers all.
    The first failure of a policy is reported with instance, seed and traceback;
    the other policies and shifts continue.
    """
    from scenarios.evaluate.comparison import check_baseline, comparisons, figures_table, scores_over_all
    from scenarios.evaluate.runner import run_study
    from scenarios.evaluate.scores import references_of
    from scenarios.evaluate.study import Study, cases_of, suite_label, suite_of
    from scenarios.policy_loader import label
    from scenarios.show.comparison_page import Judged, comparison_page, result_text, verdict

    if bool(scenario) == bool(suite):
        raise FleetError("Give either scenarios or --suite.")
    if workers is not None and ray is not None:
        raise FleetError("Give either --workers or --ray.")
    if references is not None and not references.is_file():
        raise FleetError(f"There is no file of references '{references}'. Make it with `thermofleet bounds`.")
    varied = options.parse_randomisation(randomise)
    if references is not None and varied:
        raise FleetError("Give either --references or --randomise: references are of shifts without randomisation.")
    out = out and out.resolve()  # a policy may change the folder of the process
    file, out = (out, None) if out and out.suffix.lower() in TABLE_FILES else (None, out)
    if file:
        options.check_table_file(file)
    elif out:
        check_folder(out, TABLE_FILES)
    cases = suite_of(suite, seeds or 1, first_seed) if suite else cases_of(scenario or [], seeds or 10, first_seed)
    channels = [options.channel_of(case.scenario, **channel) for case in cases]
    study = Study(
        policies=options.split_names(policies),
        cases=cases,
        difficulties=options.split_names(difficulty),
        randomise=varied,
        channel=channels[0],  # the same of all; each scenario has the arms that it names
        **spec,
    )
    names = study.competitors
    base = baseline or names.get(("round_robin", study.sources[0]), next(iter(names.values())))
    check_baseline(study, base)
    known = references_of(cases, references, study.sources)
    with progress_bar(kept="Finished shifts are" if out else KEPT, file=out) as progress:
        rows = run_study(study, out=out, workers=workers or -1, ray=ray, progress=progress, tell=say)
    results = comparisons(study, rows, base, suite, known)
    values = scores_over_all(study, rows, known)
    compared = f"{len(names)} policies" if len(names) > 1 else label(base)
    title = f"Comparison of {compared} on {suite_label(suite or ','.join(case.name for case in cases))}"
    judged = Judged(title=title, results=results, values=values, card=study.card, command=options.command_line(ctx))
    if out:
        with disk_errors(out):
            (out / PAGE).write_text(comparison_page(judged), encoding="utf-8")
    if file:
        with new_file(file) as draft:
            draft.write_bytes(figures_table(results, judged.scores).content(file.suffix.lower()))
    if as_json:
        print_json(results[0] if len(results) == 1 else results)
        return
    for result in results:
        out_console.print(result_text(result))
    out_console.print("", *verdict(judged), sep="\n")
    if out:
        say(f"Written to {out}; open {out / PAGE}.")
    if file:
        say(f"Written to {file}.")


def bounds_command(
    scenarios: str | None = argument(
        "Separated by commas: library names (see `thermofleet show`), .toml files, or instances of the suite, "
        "as test/0017.",
        None,
    ),
    *,
    suite: str | None = option("All instances of a split: train, validation or test.", None),
    seeds: int | None = option(
        "Number of seeds of each scenario; default: 5. An instance has one, its own.", None, low=1, high=10_000
    ),
    first_seed: int = option("First seed of each scenario.", 0, low=0, high=MAX_SEED),
    budget: Annotated[Given, From(Budget)],
    starts: str | None = option(
        "Policies that the search starts from, separated by commas; default: all but random. Without "
        "rolling_horizon it takes a tenth of the time.",
        None,
    ),
    workers: int | None = options.WORKERS,
    models: Annotated[Given, From(RunSpec, "difficulty", difficulty="oracle")],
    out: Path = option("File of the rows; finished ones are not computed again.", Path("runs/bounds.jsonl")),
    show_only: bool = option("Compute nothing: print all rows of the file.", False, flag="--show"),
    as_json: bool = options.JSON,
) -> None:
    """Bound the best possible reward of shifts from both sides.

    Below: the mean of the policy random, the best built-in policy, and the best
    schedule that a search finds with all jobs known (hindsight). Above: an upper
    bound that no policy can exceed. Every row is kept as soon as it is known; the
    same command continues after an interruption. A larger budget searches again.
    With --evaluations in place of --budget, a repetition gives the same file.
    """
    from scenarios.evaluate import references as bounds
    from scenarios.policy_loader import scope_of

    if show_only:
        if scenarios or suite:
            raise FleetError("--show prints all rows of the file: leave the scenarios and --suite out.")
        if not out.is_file():
            raise FleetError(f"There is no file '{out}' to --show. Compute it first, or give another --out.")
        found = bounds.load_references(out)
    else:
        if bool(scenarios) == bool(suite):
            raise FleetError(f"Give either scenarios or --suite (got {'both' if suite else 'neither'}).")
        tasks = bounds.tasks_of(suite or scenarios or "", seeds, first_seed)
        if "evaluations" in budget:
            if "seconds" in budget:
                raise FleetError(
                    f"--budget and --evaluations exclude each other (got {budget['seconds']:g} and "
                    f"{budget['evaluations']}). Leave one out."
                )
            budget["seconds"] = inf
        policies = options.split_names(starts) if starts else bounds.STARTS
        for name in policies:
            scope_of(name)
        chosen: Any = {**models, "workers": workers or cpu_count() or 1, "policies": policies}
        with progress_bar(kept="Finished rows are", file=out) as progress:
            found = bounds.references(tasks, out, Budget(**budget), **chosen, progress=progress)
    if as_json:
        print_json([asdict(each) | {"gap": each.gap, "rule_score": each.normalised(each.best_rule)} for each in found])
        return
    out_console.print(bounds.reference_table(found))
    if not show_only:
        say(f"Written to {out}.")


def leaderboard_command(
    folder: Path = argument("Folder of results, one file for each policy.", FOLDER),
    split: str = option("Split of the suite: test or validation.", "test"),
    as_json: bool = options.JSON,
    submit: Path | None = option("Folder of `thermofleet compare --suite test --out`.", None, panel=_SUBMIT),
    author: str = option("--submit: name of the author.", "", panel=_SUBMIT),
    about: str = option("--submit: description and source of the policy, one sentence.", "", panel=_SUBMIT),
    policies: str | None = option(
        "--submit: policies of the folder, separated by commas; default: all.", None, panel=_SUBMIT
    ),
    out: Path = option("--submit: folder for the files.", Path(), panel=_SUBMIT),
) -> None:
    """Print the leaderboard: normalised scores of all results on a split.

    Every file is checked as by --submit. A failed shift counts as the mean of random.
    With --submit the results of a comparison on a whole split are checked, and one
    file per policy is written.
    """
    if submit is not None:
        if not author:
            raise FleetError("--submit needs --author NAME.")
        submit_results(submit, author, about, policies, out)
        return
    if author or about or policies is not None:
        raise FleetError("--author, --about and --policies are for --submit: leave them out.")
    from scenarios.evaluate.leaderboard import board_of, read_all
    from scenarios.evaluate.statistics import LEGEND
    from scenarios.show.comparison_page import score_table
    from scenarios.spec.parse import choose

    split = choose("split", split, BoardSplit)
    if not folder.is_dir():
        raise FleetError(f"'{folder}' is no folder. Give the folder of the results.")
    board = board_of(split, read_all(folder, split))
    if as_json:
        print_json(board and board.as_json())
    elif board is None:
        echo(f"No results on the split {split}.")
    else:
        sources = sorted({each.card.difficulty for each in board.entries.values()})
        labels = {
            name: each.card.policy
            + (f"@{each.card.difficulty}" if len(sources) > 1 else "")
            + (" (arm)" if each.card.scope == "arm" else "")
            for name, each in board.entries.items()
        }
        about = f"Predictions: {', '.join(sources)}. (arm): scope arm, others central. {LEGEND}."
        scores = score_table(board.scores, labels)
        better, entries = scores.select(0, 7), [board.entries[name] for name in board.order]
        rows = tuple(
            (*row, each.faults_text, str(each.failures or "")) for row, each in zip(better.rows, entries, strict=True)
        )
        more = replace(better, head=(*better.head, "faults", "failed"), rows=rows)
        tables = scores.select(0, 1, 2, 3), scores.select(0, 4, 5, 6), more  # each narrow enough for 80 columns
        out_console.print(board.summary, about, *tables, board.remark, sep="\n")


def submit_results(results: Path, author: str, about: str, policies: str | None, out: Path) -> None:
    """Check results on a whole split, and write one file per policy for the leaderboard.

    Instances must have the hashes of the manifest, every shift must be there, and
    versions must be stated. A failed shift counts as the mean of random.
    """
    from scenarios.extras import require_extra

    require_extra("report")
    from scenarios.evaluate.leaderboard import check, failed_text, split_references, submissions_of, write
    from scenarios.evaluate.store import read_card, read_rows
    from scenarios.policy_loader import label

    try:
        made: list[BoardResult] = submissions_of(read_card(results), read_rows(results), author, about)
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
        say(f"Checked: {len(each.rows)} shifts of {each.card.policy}{failed_text(each.failures)}. Written to {path}.")
