import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from twin.vae.config import TwinConfig
from twin.vae.onnx import MODEL, ExportError, export_onnx
from twin.vae.train import train

onnxruntime = pytest.importorskip("onnxruntime")


def windows(rng, motion, count):
    seconds = TwinConfig().window / 12.5
    made = np.stack([motion(rng, seconds)[::4] for _ in range(count)]).transpose(0, 1, 3, 2).astype(float)
    made[::2, :, ::2, 0] += 4 * np.pi * np.sign(made[::2, :1, ::2, 0])  # other turns of the continuous joints
    return made


def session(path):
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def assert_parity(twin, path, x, precision="float32"):
    x = x.astype(precision)
    reconstruction, errors, mu = session(path).run(None, {"windows": x})
    assert reconstruction.dtype == x.dtype
    tolerance = 1e-5 if precision == "float64" else 2e-4  # float32 has 1e-6 rad at two turns, over 0.02 rad
    np.testing.assert_allclose((reconstruction - twin.reconstruct(x)) / twin.scaler.std, 0, atol=tolerance)
    np.testing.assert_allclose(errors, twin.window_features(x).errors, atol=1e-5)
    np.testing.assert_allclose(mu, twin.posterior(x)[0], atol=1e-5)


@pytest.fixture(scope="module")
def exported(twin, tmp_path_factory):
    return export_onnx(twin, tmp_path_factory.mktemp("out") / "arm_0")


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_onnxruntime_says_what_the_twin_says(twin, exported, rng, motion, precision, tmp_path):
    path = exported if precision == "float32" else export_onnx(twin, tmp_path / "double.onnx", precision)
    for count in (1, 2, 9):
        assert_parity(twin, path, windows(rng, motion, count), precision)


def test_no_windows_have_no_scores(exported):
    results = session(exported).run(None, {"windows": np.zeros((0, 12, 7, 3), np.float32)})
    assert [each.shape for each in results] == [(0, 12, 7, 3), (0, 7, 3), (0, 7, 2)]


def test_the_file_says_whose_it_is(twin, exported):
    said = session(exported).get_modelmeta().custom_metadata_map
    assert said["twin_version"] == twin.version
    assert said["arm"] == "arm_0"
    assert said["data_hash"] == twin.data_hash
    assert (said["channels"], said["rate_hz"], said["window"]) == ("q,qd,tau", "12.5", "12")
    assert (said["layout"], said["units"], said["joints"]) == ("batch,time,joint,channel", "rad,rad/s,N·m", "7")
    assert [path.name for path in exported.parent.iterdir()] == [MODEL]


def test_the_example_needs_nothing_but_the_file(twin, exported, rng, motion, tmp_path):
    x, example = windows(rng, motion, 5), Path(__file__).parents[2] / "examples" / "onnx_score.py"
    np.save(tmp_path / "windows.npy", x)
    assert len([line for line in example.read_text().splitlines() if line]) <= 20
    words = [sys.executable, "-P", example, exported, tmp_path / "windows.npy"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=True)
    head, *d = done.stdout.splitlines()
    assert twin.version in head
    np.testing.assert_allclose([float(each) for each in d], twin.measures_of(twin.window_features(x)).total, rtol=1e-4)
    np.save(tmp_path / "windows.npy", x * np.nan)
    for wrong, sentence in ((words[:3], "onnx_score.py twin.onnx windows.npy"), (words, "Windows must be finite.")):
        refused = subprocess.run(wrong, capture_output=True, text=True, cwd=tmp_path, check=False)
        assert (refused.returncode, refused.stdout) == (1, "")
        assert sentence in refused.stderr
        assert "Traceback" not in refused.stderr


@pytest.mark.parametrize("change", [{"scope": "arm", "latent": 3}, {"kind": "ae"}, {"layers": 2}])
def test_every_kind_of_twin_can_be_exported(records, small, rng, motion, tmp_path, change):
    config = replace(small, **change, hidden=8, epochs=1, max_windows=64, allow_collapse=True)
    twin = train(records[:6], config, np.random.SeedSequence(2), arm="b")
    path = export_onnx(twin, tmp_path / "b.onnx")
    assert path == tmp_path / "b.onnx"
    assert_parity(twin, path, windows(rng, motion, 3))


def test_without_onnx_the_error_names_the_extra(twin, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ExportError, match=r"pip install -e '\.\[onnx\]'"):
        export_onnx(twin, tmp_path)
