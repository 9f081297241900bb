"""Data and training that one arm's twin saves when a twin of another arm starts from it: `transfer`.

The second arm has another mount, tool or wear. Its twin is trained from nothing on n of its jobs, or starts from the
twin of the first arm: with its networks unchanged and only new z-scores, or with a short further training. All are
judged on other cool jobs of the second arm. Torque is computed from the motor current, so wear is visible.
"""

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from sklearn.metrics import roc_auc_score

from benchmarks.paper.harness import (
    matching,
    number,
    seeded,
    table_of,
)
from benchmarks.paper.subjects import (
    CARRIER,
    GRIPPER_KG,
    SHORT,
    SUBJECT,
    Study,
    make_study,
    sensed,
    with_steps,
)
from fleet.errors import FleetError
from fleet.robot import Mount, Robot
from fleet.seeding import child
from scenarios.evaluate.statistics import interval
from scenarios.json_rows import Row
from scenarios.prepare.twins import records
from scenarios.table import Table
from twin.vae.config import TwinConfig, hash_records, seed_text
from twin.vae.model import one_thread
from twin.vae.train import Run, train
from twin.vae.twin import Twin
from twin.vae.window import Scaler, draw_windows, windows_of

Array = np.ndarray

TARGETS: Mapping[str, Robot] = {
    "tool": Robot(name="arm", tool_kg=2.0),
    "wear": Robot(name="arm", tool_kg=GRIPPER_KG, wear=1.0),
    "mount": Robot(name="arm", tool_kg=GRIPPER_KG, mount=Mount(position_m=(0.0, 0.0, 1.5), tilt_deg=(0.0, 90.0, 0.0))),
}
"""Second arms by what differs from the first one, which stands on the floor, is new and has a gripper of 0.925 kg."""
NOTHING, RESCALED, FURTHER = "from nothing", "new z-scores", "further training"
STARTS = (NOTHING, RESCALED, FURTHER)
BETTER = replace(SHORT, learning_rate=6e-3, restarts=2)
"""The short twin with the better of two starts: a latent of two numbers has local minima."""
SHAPE = ("scope", "kind", "latent", "hidden", "layers", "window", "rate_hz")
"""Fields of the configuration that a further training must share with the first twin."""


@dataclass(frozen=True, kw_only=True)
class TransferSize:
    """Numbers of jobs and training steps."""

    jobs: tuple[int, ...] = (5, 10, 40)
    """Jobs of the second arm, ascending; the last one is the reference."""
    source_jobs: int = 120
    """Cool jobs of the first arm."""
    source_steps: int = 1000
    held_out: int = 30
    test: int = 40
    """Jobs of the natural mix, for AUROC."""
    steps: int = 300
    """Of a training from nothing; the better of two starts counts there and for the first arm."""
    further_steps: int = 75
    further_rate: float = 1e-3
    """Peak learning rate of the further training."""
    config: TwinConfig = BETTER

    def __post_init__(self) -> None:
        if list(self.jobs) != sorted(set(self.jobs)):
            raise FleetError(f"--jobs must be ascending (got {', '.join(map(str, self.jobs))}).")


def continue_training(
    start: Twin, records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence, *, arm: str
) -> Twin:
    """A twin of `arm` whose networks start from the weights of another twin; its z-scores are those of the records.

    It uses one thread and no global random state. There are no restarts, since the weights are given, and the twin is
    not calibrated.

    Args:
        start: The first twin; it is unchanged.
        records: Cool motion of the arm, profiles [time, 3, joint] at `config.record_hz`.
        config: Epochs, batch and learning rate of the further training.

    Raises:
        ValueError: records as in `twin.vae.train.train`, another number of joints, or a configuration with networks
            of another shape.
    """
    if differing := [name for name in SHAPE if getattr(config, name) != getattr(start.config, name)]:
        raise ValueError(f"The configuration differs from that of the first twin in {', '.join(differing)}.")
    windows = windows_of(records, config)
    if windows.shape[2] != start.joints:
        raise ValueError(f"The first twin has {start.joints} joints, the records have {windows.shape[2]}.")
    windows = draw_windows(windows, config.max_windows, child(seed, 0))
    scaler, count = Scaler.fit(windows), len(start.nets)
    noise = torch.from_numpy((np.array(config.noise) / scaler.std).astype(np.float32)).reshape(count, -1)
    parts = torch.from_numpy(scaler.to_z(windows)).flatten(2).chunk(count, dim=2)
    seeds = [int(child(seed, 1, n).generate_state(1)[0]) for n in range(count)]
    with one_thread():
        run = Run([part.permute(1, 2, 0).contiguous() for part in parts], noise, config, seeds)
        with torch.no_grad():
            for name, weight in run.nets.weights.items():
                weight.copy_(torch.from_numpy(np.stack([net[name] for net in start.nets])))
        run.train(config.epochs)
        fits = run.fits([0] * count, [()] * count)
    nets = [run.nets.weights_of(n) for n in range(count)]
    return Twin(config, scaler, nets, arm=arm, data_hash=hash_records(records), seed=seed_text(seed), fits=tuple(fits))


def equal_quality(jobs: Array, errors: Array, wanted: float) -> float:
    """Fewest jobs whose error is at most `wanted`, interpolated over the logarithm of the jobs.

    At least the first and, if no number suffices, twice the last of the numbers.

    Args:
        jobs: Ascending, [size].
        errors: [size].
    """
    if errors[0] <= wanted:
        return float(jobs[0])
    for i in range(1, len(jobs)):
        if errors[i] <= wanted:
            share = (errors[i - 1] - wanted) / (errors[i - 1] - errors[i])
            return float(np.exp(np.log(jobs[i - 1]) + share * np.log(jobs[i] / jobs[i - 1])))
    return 2.0 * float(jobs[-1])


def compare_starts(
    source: Twin,
    parts: Mapping[int, Sequence[Array]],
    held_out: Array,
    size: TransferSize,
    random: np.random.SeedSequence,
    auroc: Callable[[Twin], float],
) -> Row:
    """Twins of a second arm by `STARTS` and number of jobs.

    Args:
        source: Twin of the first arm.
        parts: Records of the second arm by number of jobs, ascending.
        held_out: Windows of other cool motion of the second arm, SI units.
        auroc: Of d of joint 2 by a twin.

    Returns:
        `unchanged_error`: of the first twin as it is, z-scores included. `trained`: of each start and number of jobs
        the CPU time of its training, the `error_of` held-out motion, and AUROC.
    """
    config = source.config
    common = Scaler.fit(windows_of(parts[max(parts)], config))
    rows: list[Row] = []
    for n, some in parts.items():

        def judged(start: str, make: Callable[[], Twin], n: int = n) -> Row:
            began_s = time.process_time()
            twin = make()
            cost = {"start": start, "jobs": n, "cpu_s": time.process_time() - began_s}
            return cost | {"error": error_of(twin, held_out, common), "auroc": auroc(twin)}

        whole_training = with_steps(config, some, size.steps)
        further = replace(with_steps(config, some, size.further_steps), learning_rate=size.further_rate)
        rescaled = partial(replace, source, scaler=Scaler.fit(windows_of(some, config)))
        rows += [
            judged(NOTHING, partial(train, some, whole_training, child(random, n), arm=source.arm)),
            judged(RESCALED, rescaled),
            judged(
                FURTHER,
                partial(continue_training, source, some, further, child(random, n), arm=source.arm),
            ),
        ]
    return {"unchanged_error": error_of(source, held_out, common), "trained": rows}


def error_of(twin: Twin, windows: Array, common: Scaler) -> float:
    """Mean |x − x̂| of windows in the z-scores of `common`."""
    return float(np.abs(common.to_z(windows) - common.to_z(twin.reconstruct(windows))).mean())


def arm_rows(seed: int, size: TransferSize, wanted: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Second arms under one seed, whose first twin they share.

    Raises:
        FleetError: nearly no motion of an arm stays cool.
    """
    root = np.random.SeedSequence(seed)
    first = make_study(child(root, 0), train=size.source_jobs, reference=0, test=0, novel=0, robot=SUBJECT)
    own = records(sensed(first.train.plans, first.motors))
    source = train(own, with_steps(size.config, own, size.source_steps), child(root, 1), arm="first")
    for i, (target, robot) in enumerate(TARGETS.items()):
        if target not in wanted:
            continue
        study = make_study(
            child(root, 2, i), train=size.jobs[-1], reference=size.held_out, test=size.test, novel=0, robot=robot
        )
        cool = sensed(study.train.plans, study.motors)
        held_out = windows_of(records(sensed(study.reference.plans, study.motors)), size.config)
        parts = {n: records(cool[:n]) for n in size.jobs}
        found = compare_starts(source, parts, held_out, size, child(root, 3, i), partial(auroc_of, study))
        yield target, {"target": target, "seed": seed, **found}


def auroc_of(study: Study, twin: Twin) -> float:
    """AUROC of d of joint 2 for test jobs that overheat joint 2; NaN if all do or none does."""
    test = study.test
    critical = test.peak_c[:, CARRIER] >= study.warning_c
    if critical.all() or not critical.any():
        return float("nan")
    d = twin.features(sensed(test.plans, study.motors), test.repetitions).difficulty[:, CARRIER]
    return float(roc_auc_score(critical, d))


def transfer_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Error by start and number of jobs for each second arm, and what a start from the first arm saves."""
    trained = [{"target": row["target"], **each} for row in rows for each in row["trained"]]
    jobs = list(dict.fromkeys(each["jobs"] for each in trained))

    def of(target: str, start: str, count: int, name: str) -> str:
        known = [number(each[name]) for each in matching(trained, target=target, start=start, jobs=count)]
        known = [value for value in known if np.isfinite(value)]  # AUROC needs hot and cool jobs
        return interval(known, least=0.0).text(3) if known else "unknown"

    targets = dict.fromkeys(row["target"] for row in rows)
    errors = [(f"{t}, {start}", *(of(t, start, count, "error") for count in jobs)) for t in targets for start in STARTS]
    saved: list[tuple[str, ...]] = []
    for target in targets:
        own = matching(rows, target=target)
        ratios = [interval([data_ratio(row, each) for row in own], least=0.0).text() for each in (RESCALED, FURTHER)]
        unchanged = interval([row["unchanged_error"] for row in own], least=0.0).text(3)
        changes = (
            " → ".join(of(target, start, jobs[-1], name).split(" ")[0] for start in (NOTHING, FURTHER))
            for name in ("cpu_s", "auroc")
        )
        saved.append((target, unchanged, *ratios, *changes))
    heads = ("second arm", "first twin unchanged", f"data, {RESCALED}", f"data, {FURTHER}", "CPU s", "AUROC of d_2")
    errors_of = "Mean |x − x̂| of held-out cool jobs, in standard deviations of the arm's motion"
    savings = (
        f"Error of the first twin; data: number of jobs that give the error of {jobs[-1]} jobs from nothing, divided "
        f"by {jobs[-1]}; CPU seconds and AUROC with {jobs[-1]} jobs, {NOTHING} → {FURTHER}"
    )
    return {
        "transfer_errors": table_of(("second arm, start", *(f"{count} jobs" for count in jobs)), errors, errors_of),
        "transfer_savings": table_of(heads, saved, savings),
    }


def data_ratio(row: Row, start: str) -> float:
    """Jobs for the quality of the largest training from nothing, over the jobs of that; see `equal_quality`."""
    nothing, own = (matching(row["trained"], start=each) for each in (NOTHING, start))
    jobs, errors = (np.array([each[name] for each in own]) for name in ("jobs", "error"))
    return equal_quality(jobs, errors, float(nothing[-1]["error"])) / float(nothing[-1]["jobs"])


TRANSFER = seeded(
    "One arm's twin as the start for an arm with another tool, wear or mount: the data that this saves.\n\n"
    "A seed takes a minute of one core.",
    TransferSize,
    3,
    arm_rows,
    transfer_tables,
    parts=tuple(TARGETS),
)
