"""Cost of a twin: a training step and scoring, beside plain `nn.LSTM`.

    python -m benchmarks.bench_twin [--arms 100]

CPU time on one core, medians; ours and the others alternate. Plain is a bare `nn.LSTM` autoencoder: encoder, linear
layers, decoder, loss and backward pass, or the forward pass alone. A scored job lasts 16 s. --arms trains that many
twins of the quick size in two processes and scores 1 000 jobs with each, beside an extrapolated training of `nn.LSTM`
network after network. The last table scores a log of 10 Hz while it grows, line by line.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from joblib import Parallel, delayed
from torch import Tensor

from benchmarks.harness import in_turns, options, seconds
from fleet.motion import CHANNELS, RATE_HZ
from scenarios.prepare.twins import LOG_INPUT
from scenarios.show.twin_scores import score_windows
from twin.log_windows import WindowFeed
from twin.logs.reader import GrowingLog
from twin.vae.config import TwinConfig
from twin.vae.model import LstmVae, build, weights_of
from twin.vae.train import Run, train
from twin.vae.twin import Fit, Twin, save
from twin.vae.window import Scaler, cut, resample, starts

JOINTS = 7
RUNS = 15
RESTARTED = 14
"""Networks of the joints of an arm, each with two restarts."""
BESIDE = (1, 7, RESTARTED, 28)
"""Numbers of networks trained side by side."""
JOBS = 1000
JOB_S = 16.0
"""Duration of a scored job."""


def medians(calls: dict[str, Callable[[], object]], runs: int) -> dict[str, float]:
    """Median CPU time of each call, s."""
    return {name: statistics.median(took) for name, took in in_turns(calls, runs).items()}


def plain_forward(net: LstmVae, x: Tensor) -> Tensor:
    """Forward pass of the same layers without our code."""
    _, (last, _) = net.encoder(x)
    latent = net.mu(torch.tanh(net.summary(last[-1])))
    expanded = torch.tanh(net.expand(latent))[:, None].expand(-1, x.shape[1], -1)
    return net.out(net.decoder(expanded)[0])


def plain_step(net: LstmVae, x: Tensor, optimizer: torch.optim.Optimizer) -> None:
    """Forward, squared error, backward, Adam."""
    optimizer.zero_grad()
    (plain_forward(net, x) - x).square().sum().backward()
    optimizer.step()


def smooth(rng: np.random.Generator, length_s: float) -> np.ndarray:
    """A profile [time, 3, joint] of sums of sines."""
    time_s = np.arange(int(length_s * RATE_HZ)) / RATE_HZ
    omega, shift = 2 * np.pi * rng.uniform(0.05, 0.25, (3, 1, JOINTS)), rng.uniform(0, 6.28, (3, 1, JOINTS))
    angle = omega * time_s[:, None] + shift
    q, qd, qdd = np.sin(angle).sum(0), (omega * np.cos(angle)).sum(0), -(omega**2 * np.sin(angle)).sum(0)
    return np.stack([q, qd, 10 * np.sin(q) + qdd], axis=1).astype(np.float32)


def untrained(config: TwinConfig) -> Twin:
    """A twin with random weights, which cost as much as trained ones."""
    scaler = Scaler(np.zeros(JOINTS), np.zeros((JOINTS, 3)), np.ones((JOINTS, 3)), np.zeros(JOINTS, dtype=bool))
    count, channels = config.networks(JOINTS), config.channels(JOINTS)
    nets = [weights_of(build(config, seed, channels=channels)) for seed in range(count)]
    fit = Fit(elbo=0.0, kl=1.0, active_units=1, mean_squared_error=1.0, restart=0)
    return Twin(config, scaler, nets, arm="bench", data_hash="", seed="0", fits=[fit] * count)


def training(config: TwinConfig, name: str) -> None:
    """Duration of a training step beside plain."""
    channels = config.channels(JOINTS)
    x = torch.randn(config.batch, config.window, channels)
    net = build(config, 0, channels=channels)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3, fused=True)
    calls: dict[str, Callable[[], object]] = {
        "plain": lambda: plain_step(net, x, optimizer),
    }
    for count in BESIDE:
        calls[str(count)] = _epochs_of(count, config, channels)
    took = medians(calls, RUNS)
    ours = {count: took[str(count)] / count for count in BESIDE}
    cells = "".join(f"{1e3 * each:>9.1f}" for each in (*ours.values(), took["plain"]))
    print(f"{name:<26}{cells}{ours[RESTARTED] / took['plain']:>8.2f}")


def _epochs_of(count: int, config: TwinConfig, channels: int) -> Callable[[], object]:
    """A training step of some networks side by side: an epoch of one batch."""
    windows = [torch.randn(config.window, channels, config.batch) for _ in range(count)]
    endless = replace(config, epochs=10_000)
    run, epochs = Run(windows, torch.zeros(count, channels), endless, range(count)), iter(range(1, 10_000))
    return lambda: run.train(next(epochs))


def scoring(config: TwinConfig, name: str, windows: int, runs: int) -> None:
    """Reconstruction beside plain forward passes."""
    twin = untrained(config)
    z = np.random.default_rng(0).standard_normal((windows, config.window, JOINTS, 3)).astype(np.float32)
    parts = [
        torch.from_numpy(np.ascontiguousarray(x))
        for x in np.moveaxis(z.reshape(*z.shape[:2], len(twin.nets), -1), 2, 0)
    ]

    channels = config.channels(JOINTS)
    nets = [build(config, seed, channels=channels).eval() for seed in range(len(twin.nets))]

    def plain() -> None:
        with torch.inference_mode():
            for net, x in zip(nets, parts, strict=True):
                plain_forward(net, x)

    calls: dict[str, Callable[[], object]] = {
        "features": lambda: twin.window_features(z),
        "ours": lambda: twin.networks.reconstruct(z),
        "plain": plain,
    }
    took = medians(calls, runs)
    cells = "".join(f"{1e3 * each:>11.2f}" for each in took.values())
    print(f"{name:<34}{cells}{took['ours'] / took['plain']:>8.2f}")


LOG_HZ, LOG_S = 10.0, 300.0
"""Rate and length of the log that grows."""


def following(config: TwinConfig, name: str, every_s: float | None) -> None:
    """Scoring of a log that grows: CPU time of each window, and in all as a share of the log's duration."""
    twin, profile = untrained(config), smooth(np.random.default_rng(0), LOG_S)[:: int(RATE_HZ / LOG_HZ)].astype(float)
    profile[:, 0] /= np.abs(profile[:, 0]).max()  # rad, inside the stops
    profile[:, 1] = np.gradient(profile[:, 0], 1.0 / LOG_HZ, axis=0)
    head = ",".join(["time_s", *(f"{channel}_{j}" for channel in CHANNELS for j in range(1, JOINTS + 1))])
    lines = [",".join(map(repr, [i / LOG_HZ, *row.ravel().tolist()])) for i, row in enumerate(profile)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grows.csv"
        path.write_text(head + "\n", encoding="utf-8")
        feed, took, windows = WindowFeed(twin, every_s), list[float](), list[float]()
        with path.open("a", encoding="utf-8") as out, GrowingLog(path) as growing:
            for line in lines:
                out.write(line + "\n")
                out.flush()
                start_s, scored = time.process_time(), 0
                # A live arm is read at every sample.
                while (recording := growing.read(feed.due_s if every_s is None else -np.inf)) is not None:
                    scored += len(score_windows(twin, feed.add(recording)))
                took.append(time.process_time() - start_s)
                windows += [took[-1] / scored] if scored else []
    print(f"{name:<46}{len(windows):>8}{1e3 * statistics.median(windows):>12.2f}{sum(took) / LOG_S:>12.2%}")


def windows_in(length_s: float, config: TwinConfig) -> int:
    """Number of windows in which a twin scores motion of this length."""
    return len(starts(round(length_s * config.rate_hz), config.window, config.score_stride))


def some_arms(first: int, count: int) -> tuple[float, float, int]:
    """Train twins and score 1 000 jobs with each; CPU time of both, s, and the bytes of a saved twin."""
    torch.set_num_threads(1)
    config = TwinConfig.quick()
    motions, windows = [], []
    for arm in range(first, first + count):
        rng = np.random.default_rng(arm)
        records = [smooth(rng, 12.0) for _ in range(90)]
        motions.append(records)
        parts = [cut(resample(r, RATE_HZ, config.rate_hz), config.window, config.score_stride) for r in records]
        windows.append(np.concatenate(parts))
    draw = np.random.SeedSequence(first)
    train(motions[0], replace(config, epochs=1, allow_collapse=True), draw, arm="")  # loads compiled code
    twins: list[Twin] = []
    training_s = seconds(lambda: twins.extend(train(records, config, draw, arm="arm") for records in motions))
    scoring_s = 0.0
    for twin, own in zip(twins, windows, strict=True):
        sample = own[np.random.default_rng(0).integers(0, len(own), JOBS * windows_in(JOB_S, config))]
        scoring_s += seconds(lambda twin=twin, sample=sample: twin.window_features(sample))
    with tempfile.TemporaryDirectory() as folder:
        save(twins[0], Path(folder))
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
    return training_s, scoring_s, size


def fleet(arms: int) -> None:
    """Twins of many arms in two processes, beside networks trained one after another."""
    config, shares = TwinConfig.quick(), [(0, arms // 2), (arms // 2, arms - arms // 2)]
    start_s = time.perf_counter()
    parts = list(Parallel(n_jobs=2)(delayed(some_arms)(*share) for share in shares))
    wall_s = time.perf_counter() - start_s
    training_s, scoring_s, sizes = zip(*parts, strict=True)
    x, net = torch.randn(config.batch, config.window, 3), build(config, 0)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3, fused=True)
    plain_s = medians({"plain": lambda: plain_step(net, x, optimizer)}, RUNS)["plain"]
    steps = arms * JOINTS * config.epochs * -(-config.max_windows // config.batch)
    print(f"\n{arms} twins of the quick size, two processes; everything took {wall_s:.0f} s")
    print(f"{'training, CPU s':<34}{sum(training_s):>9.0f}   one after another: {plain_s * steps:.0f}")
    print(f"{'scoring 1 000 jobs each, CPU s':<34}{sum(scoring_s):>9.1f}")
    print(f"{'a saved twin, kB':<34}{max(sizes) / 1e3:>9.0f}")


def main() -> None:
    """Print the tables."""
    arguments = options(__doc__, arms=(0, "number of arms whose twins are trained and scored"))
    torch.set_num_threads(1)
    if arguments.arms > 1:
        fleet(arguments.arms)
        return
    default = TwinConfig()
    beside = "".join(f"{f'{count} nets':>9}" for count in BESIDE)
    print(f"{'ms per step and network':<26}{beside}{'plain':>9}{'ratio':>8}")
    training(default, "one joint of seven")
    columns = ("features", "networks", "plain")
    print(f"\n{'scoring, 7 joints, ms':<34}" + "".join(f"{name:>11}" for name in columns) + f"{'ratio':>8}")
    scoring(default, "1 job of 16 s", windows_in(JOB_S, default), 200)
    scoring(default, "1 000 jobs of 16 s", JOBS * windows_in(JOB_S, default), 3)
    print(f"\n{f'a log of {LOG_HZ:g} Hz as it grows':<46}{'windows':>8}{'ms, median':>12}{'of a core':>12}")
    of_log = replace(TwinConfig.quick(), **LOG_INPUT)
    following(of_log, "twin of a log, windows of 25 s", None)
    following(of_log, "twin of a log, every 0.5 s", 0.5)
    following(default, "twin of a scenario, every 0.1 s", 0.1)


if __name__ == "__main__":
    main()
