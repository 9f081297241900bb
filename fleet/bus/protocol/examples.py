"""One example of every message on the bus: a job `crate_1` from submission to receipt, and what is sent besides."""

import json
from collections.abc import Mapping
from importlib.resources import files

import msgspec

from fleet.bus.protocol.registry import MESSAGES


def _read() -> Mapping[type[msgspec.Struct], msgspec.Struct]:
    kinds = {kind.__name__: kind for kind in MESSAGES}
    examples = json.loads(files("fleet").joinpath("data", "bus_examples.json").read_bytes())
    return {kinds[name]: msgspec.convert(example, kinds[name]) for name, example in examples.items()}


EXAMPLES = _read()
