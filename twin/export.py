"""A twin as one ONNX file, for whoever scores motion without Python or torch.

Input `windows` in SI units, double [batch, time, joint, channel]: an angle of several turns over a small
standard deviation needs more digits than a float has. Outputs `reconstruction` (SI, double, angles near the training
data), `errors` (time mean of |x − x̂| in z-scores, [batch, joint, channel]) and `mu` ([batch, net, latent]).
"""

import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from fleet.drafts import drafted
from fleet.errors import FleetError
from fleet.motion import CHANNELS
from twin.score import Twin
from twin.window import CONTINUOUS, Q

MODEL = "twin.onnx"
OPSET = 17


class ExportError(FleetError):
    """A twin could not be exported; says what is missing."""


def export_onnx(twin: Twin, path: Path) -> Path:
    """Write the twin as ONNX; its metadata names arm, version, training data, channels and rate.

    Args:
        path: A file that ends in `.onnx`, or a folder, made if need be, for `twin.onnx`.

    Returns:
        The file.

    Raises:
        ExportError: the package onnx is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise ExportError("Export to ONNX needs the extra 'onnx': pip install 'thermofleet[onnx]'.") from None
    file = path if path.suffix == ".onnx" else path / MODEL
    file.parent.mkdir(parents=True, exist_ok=True)
    example = torch.zeros(2, twin.config.window, twin.joints, len(CHANNELS), dtype=torch.float64)
    with drafted(file) as draft:
        with warnings.catch_warnings(), torch.inference_mode(False), torch.no_grad():
            # The exporter that replaces this one needs onnxscript; and it warns of LSTMs whose batch varies, which ours
            # bear: they begin from zeros of the batch's own size. tests/twin/test_export.py runs other sizes.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                _Windows(twin),
                (example,),
                str(draft),
                input_names=["windows"],
                output_names=["reconstruction", "errors", "mu"],
                dynamic_axes={name: {0: "batch"} for name in ("windows", "reconstruction", "errors", "mu")},
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(str(draft))
        onnx.helper.set_model_props(model, _card(twin))
        onnx.save(model, str(draft))
    return file


def _card(twin: Twin) -> dict[str, str]:
    """What the file says of itself."""
    return {
        "twin_version": twin.version,
        "arm": twin.arm,
        "data_hash": twin.data_hash,
        "channels": ",".join(CHANNELS),
        "rate_hz": repr(twin.config.rate_hz),
        "window": str(twin.config.window),
    }


class _Windows(nn.Module):
    """Windows in SI units to reconstruction, errors and latent means, as `Twin` does it."""

    def __init__(self, twin: Twin) -> None:
        super().__init__()
        self.nets = nn.ModuleList(twin.nets)
        self.steps = twin.config.window
        turns = np.zeros((twin.joints, len(CHANNELS)))
        turns[[j for j in CONTINUOUS if j < twin.joints], Q] = 2 * np.pi
        home = np.zeros_like(turns)
        home[:, Q] = twin.scaler.turn_q
        for name, value in (("turn", turns), ("home", home), ("mean", twin.scaler.mean), ("std", twin.scaler.std)):
            self.register_buffer(name, torch.from_numpy(np.array(value, dtype=float)))

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        turn, home, mean, std = (self.get_buffer(name) for name in ("turn", "home", "mean", "std"))
        away = (windows.mean(dim=1, keepdim=True) - home) / (2 * torch.pi)
        z = ((windows - turn * torch.round(away) - mean) / std).float()
        apart = z.reshape(-1, self.steps, len(self.nets), z.shape[2] * z.shape[3] // len(self.nets))
        latents, made = [], []
        for n, net in enumerate(self.nets):
            mu = net.encode(apart[:, :, n])[0]  # pyright: ignore[reportCallIssue]
            latents.append(mu)
            made.append(net.decode(mu, self.steps))  # pyright: ignore[reportCallIssue]
        z_hat = torch.stack(made, dim=2).reshape(-1, self.steps, *home.shape)
        return z_hat.double() * std + mean, (z - z_hat).abs().mean(dim=1), torch.stack(latents, dim=1)
