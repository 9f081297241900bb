"""Logs of an arm that swings at 2 Hz, and the configuration of a small twin of them."""

import numpy as np

from fleet.readings import gravity_terms
from twin.logs.recording import Recording
from twin.vae.config import TwinConfig

RATE_HZ = 2.0
TINY = TwinConfig(
    hidden=4, epochs=3, max_windows=100, restarts=1, rate_hz=RATE_HZ, record_hz=RATE_HZ, allow_collapse=True
)


def logged(name: str, *, load: float = 1.0, celsius: float = 31.0, seed: int = 0, seconds: float = 80.0) -> Recording:
    """Seven joints of a standing arm that swing at 2 Hz, joint 2 at one temperature."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds, 1 / RATE_HZ)
    omega, shift = rng.uniform(0.1, 0.6, 7), rng.uniform(0, 6, 7)
    q = 0.5 * np.sin(np.outer(time_s, omega) + shift)
    tau = load * gravity_terms(q)[:, :, 2] + rng.normal(0, 0.2, q.shape)
    temp_c = np.full(q.shape, 30.0)
    temp_c[:, 1] = celsius
    return Recording(name=name, time_s=time_s, q=q, qd=np.gradient(q, time_s, axis=0), tau=tau, temp_c=temp_c)


def columns_of(log: Recording) -> dict[str, np.ndarray]:
    """Columns of a plain log (docs/logs.md)."""
    columns = {"time_s": log.time_s}
    for name in ("q", "qd", "tau", "temp_c"):
        columns |= {f"{name}_{j}": column for j, column in enumerate(getattr(log, name).T, start=1)}
    return columns


def csv_of(log: Recording, form: str = "") -> str:
    """A plain log; `form` of its numbers, by default with all digits."""
    columns = columns_of(log)
    rows = (",".join(format(value, form) for value in row) for row in np.stack([*columns.values()], axis=1).tolist())
    return "\n".join([",".join(columns), *rows]) + "\n"


COOL = [logged(f"cool_{i}", seed=i) for i in range(14)]
WARM = logged("warm", celsius=45.0, seed=90)
