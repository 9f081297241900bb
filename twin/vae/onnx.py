"""A twin as one ONNX file, which scores motion without Python or torch.

Input `windows` in SI units, [batch, time, joint, channel], float32 or float64: after hundreds of turns an angle over a
small standard deviation needs more digits than float32 has. Outputs `reconstruction` (SI, of the same type, angles near
the training data), `errors` (time mean of |x − x̂| in z-scores, float32 [batch, joint, channel]) and `mu` (float32
[batch, net, latent]). The metadata say how d follows from `errors`: `examples/onnx_score.py`.
"""

import warnings
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from fleet.errors import FleetError, install
from fleet.files import atomic_path
from fleet.motion import CHANNELS
from twin.logs.recording import CONTINUOUS
from twin.vae.inference import Weights
from twin.vae.model import LstmVae, build
from twin.vae.twin import Twin
from twin.vae.window import Q

MODEL = "twin.onnx"
OPSET = 17
OUTPUTS = ["reconstruction", "errors", "mu"]
UNITS = ("rad", "rad/s", "N·m")
"""Of the channels."""
Precision = Literal["float32", "float64"]


class ExportError(FleetError):
    """A twin could not be exported; the message names what is missing."""


def export_onnx(twin: Twin, path: Path, precision: Precision = "float32") -> Path:
    """Write the twin as ONNX; its metadata have all that a program needs to score motion.

    Args:
        precision: Type of the input.
        path: A file that ends in `.onnx`, or a folder, made if need be, for `twin.onnx`.

    Returns:
        The file.

    Raises:
        ExportError: the package onnx is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise ExportError(f"Export to ONNX needs the extra 'onnx': {install('onnx')}.") from None
    file = path if path.suffix == ".onnx" else path / MODEL
    file.parent.mkdir(parents=True, exist_ok=True)
    kind = torch.float32 if precision == "float32" else torch.float64
    example = torch.zeros(2, twin.config.window, twin.joints, len(CHANNELS), dtype=kind)
    with atomic_path(file) as draft:
        with warnings.catch_warnings(), torch.inference_mode(False), torch.no_grad():
            # The dynamo exporter needs onnxscript. The warning about LSTMs with a varying batch does not apply: ours
            # start from zeros of the batch's own size. tests/twin/test_onnx.py runs other sizes.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                _OnnxTwin(twin),
                (example,),
                str(draft),
                input_names=["windows"],
                output_names=OUTPUTS,
                dynamic_axes={name: {0: "batch"} for name in ("windows", *OUTPUTS)},
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(str(draft))
        metadata = {
            "twin_version": twin.version,
            "arm": twin.arm,
            "data_hash": twin.data_hash,
            "layout": "batch,time,joint,channel",
            "channels": ",".join(CHANNELS),
            "units": ",".join(UNITS),
            "joints": str(twin.joints),
            "rate_hz": repr(twin.config.rate_hz),
            "window": str(twin.config.window),
            "joint_weight": ",".join(map(repr, twin.joint_weight.tolist())),
            "difficulty": "d = sum over joints k of joint_weight[k] * (1 - exp(-sum over channels c of errors[k, c]))",
            "resampling": "a sample at rate_hz is the mean of the readings over its time; angles do not jump by a turn",
        }
        onnx.helper.set_model_props(model, metadata)
        onnx.save(model, str(draft))
    return file


def _network(twin: Twin, weights: Weights) -> LstmVae:
    """A network of a twin for torch."""
    net = build(twin.config, seed=0, channels=twin.config.channels(twin.joints))
    net.load_state_dict({name: torch.from_numpy(values) for name, values in weights.items()})
    return net.eval().requires_grad_(False)


class _OnnxTwin(nn.Module):
    """Windows in SI units to reconstruction, errors and latent means, as `Twin` computes them."""

    def __init__(self, twin: Twin) -> None:
        super().__init__()
        self.nets, self.steps = tuple(_network(twin, net) for net in twin.nets), twin.config.window
        turns = np.zeros((twin.joints, len(CHANNELS)))
        turns[[j for j in CONTINUOUS if j < twin.joints], Q] = 2 * np.pi
        home = np.zeros_like(turns)
        home[:, Q] = twin.scaler.turn_q
        constants = {"turn": turns, "home": home, "mean": twin.scaler.mean, "std": twin.scaler.std}
        for name, value in constants.items():
            self.register_buffer(name, torch.from_numpy(np.array(value, dtype=float)))

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # One window more: onnxruntime has no LSTM of an empty batch.
        kind, windows = windows.dtype, torch.cat([windows.double(), windows.new_zeros(1, *windows.shape[1:]).double()])
        turn, home, mean, std = (self.get_buffer(name) for name in ("turn", "home", "mean", "std"))
        away = (windows.mean(dim=1, keepdim=True) - home) / (2 * torch.pi)
        z = ((windows - turn * torch.round(away) - mean) / std).float()
        means, parts = list[Tensor](), list[Tensor]()
        for net, part in zip(self.nets, z.flatten(2).chunk(len(self.nets), dim=2), strict=True):
            mu = net.encode(part)[0]
            means.append(mu)
            parts.append(net.decode(mu, self.steps))
        z_hat, mu = torch.cat(parts, dim=2).unflatten(2, (-1, len(CHANNELS))), torch.stack(means, dim=1)
        results = (z_hat.double() * std + mean).to(kind), (z - z_hat).abs().mean(dim=1), mu
        return results[0][:-1], results[1][:-1], results[2][:-1]
