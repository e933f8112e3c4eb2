"""A policy as a file does what torch does over whole episodes, within the bounds, and so does its C source."""

import ctypes
import json
import shutil
import subprocess

import numpy as np
import onnx
import pytest
import torch

from helpers.learning.tracking_policy import Gains, TrackingPolicy
from helpers.own_plant.deploy import DeployedPolicy, disagreement, export, export_c, memory_names
from helpers.plant.tracking import Bounds
from helpers.settings.leaf import InputError
from helpers.settings.paper import load


@pytest.fixture(params=[(1, 1), (3, 2)], ids=str)
def deployed(request, tmp_path, root):
    """A policy with random weights, its files, and the steady state."""
    n_y, n_u = request.param
    torch.manual_seed(0)
    params = load(root, 1).learning.policy.model_copy(update={"hidden_cells": (7, 5)})
    gains = Gains(*(torch.rand(n_u, n_y) for _ in range(3)))
    bounds = Bounds(-3 * torch.ones(n_u), 4 * torch.ones(n_u), torch.full((n_u,), torch.inf))
    policy = TrackingPolicy(params, gains, 2 * torch.ones(n_y), torch.zeros(n_y), torch.ones(n_y), bounds)
    torch.nn.init.normal_(policy.output.weight)
    steady = torch.arange(50, 50 + n_y).double(), torch.arange(20, 20 + n_u).double()
    paths = [export(policy, *steady, tmp_path / f"{static}.onnx", {"title": "made up"}, static) for static in (False, True)]
    return policy, *paths, steady


def test_file_and_torch_agree_over_whole_episodes(deployed):
    """Bounds included, which such noise meets; the static file has fixed shapes, and the batch comes first."""
    policy, *paths, steady = deployed
    y, aim = torch.randn(2, 40, 20, len(policy.unit), generator=torch.Generator().manual_seed(1))
    for path, first, n_episodes in zip(paths, ("K", 1), (20, 1), strict=True):
        file = DeployedPolicy(path)
        assert disagreement(policy, file, 3 * y[:, :n_episodes], aim[:, :n_episodes], *steady) < 1e-6
        assert {shape[0] for shape in file.shapes} == {first}
        assert all(isinstance(size, int) for shape in file.shapes for size in shape[1:])
        assert [entry.name for entry in onnx.load(path).graph.output] == ["u", *(f"{name}_next" for name in memory_names(policy))]
    with torch.no_grad():
        policy.layers[1].weight_hh_l0.mul_(1.05)
    assert disagreement(policy, DeployedPolicy(paths[0]), 3 * y, aim, *steady) > 1e-5


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_c_source_compiles_and_agrees_with_the_file(deployed, tmp_path):
    _, _, static, (steady_y, steady_u) = deployed
    source = export_c(static, tmp_path / "policy.c")
    library = tmp_path / "policy.so"
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", source, "-o", library, "-lm"], check=True)
    function, file = ctypes.CDLL(str(library)).policy, DeployedPolicy(static)
    memory = [np.zeros_like(entry) for entry in file.memory]
    y, aim, u = steady_y[None].numpy(), steady_y[None].numpy(), steady_u[None].numpy()
    rng, address = np.random.default_rng(0), ctypes.c_void_p
    for _ in range(30):
        y = y + rng.normal(size=y.shape)
        after, applied = [np.empty_like(entry) for entry in memory], np.empty_like(u)
        function(*(address(array.ctypes.data) for array in (y, aim, u, *memory, applied, *after)))
        assert applied == pytest.approx(file.step(y, aim, u), abs=1e-5)
        memory, u = after, applied


def test_what_is_no_policy_is_refused_in_one_sentence(deployed, tmp_path):
    (tmp_path / "text.onnx").write_text("no policy", encoding="utf-8")
    with pytest.raises(InputError, match=r"text\.onnx: not a policy that can be run"):
        DeployedPolicy(tmp_path / "text.onnx")
    _, batched, _, _ = deployed
    assert DeployedPolicy(batched).notes == {"title": "made up"}
    file = onnx.load(batched)
    onnx.helper.set_model_props(file, {"title": "no json", "other": json.dumps(1)})
    onnx.save(file, tmp_path / "notes.onnx")
    with pytest.raises(InputError, match=r"notes\.onnx: the note 'title' of the policy cannot be read"):
        DeployedPolicy(tmp_path / "notes.onnx")
