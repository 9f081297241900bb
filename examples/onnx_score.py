"""Difficulty of motion by an exported twin: python examples/onnx_score.py twin.onnx windows.npy

windows.npy: [batch, time, joint, channel], as the metadata of the file describe it. Needs numpy and onnxruntime only.
"""

import sys

import numpy as np
import onnxruntime

if len(sys.argv) != 3:
    sys.exit(__doc__)
session = onnxruntime.InferenceSession(sys.argv[1])
about, given = session.get_modelmeta().custom_metadata_map, session.get_inputs()[0]
windows = np.load(sys.argv[2]).astype(np.float32 if "float" in given.type else np.float64)
if not np.isfinite(windows).all():
    sys.exit("Windows must be finite.")
errors = np.asarray(session.run(["errors"], {given.name: windows})[0])
weight = np.array(about["joint_weight"].split(","), dtype=float)
d = (1.0 - np.exp(-errors.sum(axis=-1))) @ weight
print(f"twin of {about['arm']}, version {about['twin_version']}: {about['difficulty']}")
print(*(f"{each:.6f}" for each in d), sep="\n")
