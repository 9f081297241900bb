import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from fleet.errors import CheckpointError
from twin.vae.train import train
from twin.vae.twin import CARD, WEIGHTS, load, save


@pytest.fixture
def folder(twin, tmp_path):
    save(twin, tmp_path / "arm_0")
    return tmp_path / "arm_0"


def edit(folder, change):
    card = json.loads((folder / CARD).read_text())
    change(card)
    (folder / CARD).write_text(json.dumps(card))


def test_a_round_trip_keeps_every_bit_of_the_score(twin, folder, plan):
    back = load(folder)
    assert back.version == twin.version
    assert (back.arm, back.data_hash, back.seed) == (twin.arm, twin.data_hash, twin.seed)
    assert back.config == twin.config
    assert back.fits == twin.fits
    np.testing.assert_array_equal(back.score(plan, 5).per_joint, twin.score(plan, 5).per_joint)


@pytest.mark.parametrize("change", [{"layers": 2, "latent": 3}, {"scope": "arm"}, {"kind": "ae"}])
def test_every_kind_of_twin_comes_back(records, small, tmp_path, plan, change):
    config = replace(small, **change, epochs=1, allow_collapse=True)
    other = train(records[:3], config, np.random.SeedSequence(0), arm="b")
    save(other, tmp_path)
    back = load(tmp_path)
    assert back.version == other.version
    np.testing.assert_array_equal(back.score(plan, 2).per_joint, other.score(plan, 2).per_joint)


def test_saving_leaves_two_files_and_loading_no_trace_in_the_random_state(twin, folder):
    save(twin, folder)
    assert sorted(path.name for path in folder.iterdir()) == [CARD, WEIGHTS]
    before = torch.random.get_rng_state()
    load(folder)
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(CheckpointError, match=f"{name} is missing"):
        load(folder)


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
def test_a_file_cut_short_is_named(folder, name):
    path = folder / name
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(CheckpointError, match=name):
        load(folder)


def test_another_format_is_refused(folder):
    edit(folder, lambda card: card.update(format=99, surprise=1))
    with pytest.raises(CheckpointError, match="format 99 is not supported, only 3"):
        load(folder)


def test_another_number_of_joints_is_refused(folder):
    with pytest.raises(CheckpointError, match="the twin has 7 joints, the arm has 6"):
        load(folder, joints=6)


def test_a_missing_tensor_is_named(folder):
    tensors = load_file(folder / WEIGHTS)
    del tensors["joint_3.mu.weight"]
    save_file(tensors, folder / WEIGHTS)
    with pytest.raises(CheckpointError, match=r"missing tensor 'joint_3\.mu\.weight'"):
        load(folder)


def test_a_tensor_of_another_shape_is_named(folder):
    tensors = load_file(folder / WEIGHTS)
    tensors["joint_3.mu.weight"] = tensors["joint_3.mu.weight"][:1].copy()
    save_file(tensors, folder / WEIGHTS)
    with pytest.raises(CheckpointError, match=r"'joint_3\.mu\.weight' is float32 \[1, 16\], not float32 \[2, 16\]"):
        load(folder)


def test_a_changed_weight_is_noticed(folder):
    tensors = load_file(folder / WEIGHTS)
    tensors["joint_3.mu.weight"][0, 0] += 1e-6
    save_file(tensors, folder / WEIGHTS)
    with pytest.raises(CheckpointError, match="changed since it was saved"):
        load(folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda card: card["mean"][2].__setitem__(1, 0.5), "changed since it was saved"),
        (lambda card: card.update(arm="arm_9"), "changed since it was saved"),
        (lambda card: card["config"].update(score_stride=6), "changed since it was saved"),
        (lambda card: card["config"].update(hidden=8), "not float32"),
        (lambda card: card["config"].update(hidden=-8), "hidden must be >= 1"),
        (lambda card: card["std"].pop(), "must each have 7 joints"),
        (lambda card: card["fits"].pop(), r"needs 7 network\(s\) and fits \(got 7 and 6\)"),
        (lambda card: card["config"].update(scope="arm"), "missing tensor"),
        (lambda card: card["config"].update(kind="ae"), "unknown tensors"),
        (lambda card: card["std"][0].pop(), "Expected `array` of length 3"),
        (lambda card: card.pop("seed"), "seed"),
        (lambda card: card.update(more=1), "more"),
    ],
)
def test_a_changed_card_is_noticed(folder, change, words):
    edit(folder, change)
    with pytest.raises(CheckpointError, match=words):
        load(folder)
