"""Our Adam against torch's own class, and that it does without torch's compiler."""

import copy
import subprocess
import sys

import pytest
import torch

from helpers.learning.optimiser import Adam


@pytest.fixture
def network():
    torch.manual_seed(0)
    return torch.nn.LSTM(3, 4, dtype=torch.float64)


def test_the_steps_are_those_of_torch(network):
    ours, theirs = copy.deepcopy(network), copy.deepcopy(network)
    adam, torchs = Adam(ours.parameters()), torch.optim.Adam(theirs.parameters(), fused=True)
    signal = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for step in range(20):
        torchs.param_groups[0]["lr"] = 0.05 / (1 + step)
        for trained in (ours, theirs):
            trained.zero_grad()
            trained(signal)[0].square().sum().backward()
        adam.step(0.05 / (1 + step))
        torchs.step()
    for name, parameter in ours.named_parameters():
        assert torch.equal(parameter, theirs.get_parameter(name)), name
        assert not torch.equal(parameter, network.get_parameter(name)), name


def test_a_parameter_without_a_gradient_stays(network):
    before = copy.deepcopy(network)
    Adam(network.parameters()).step(0.1)
    for name, parameter in network.named_parameters():
        assert torch.equal(parameter, before.get_parameter(name)), name


def test_the_compiler_of_torch_is_not_loaded():
    code = (
        "import sys, torch; from helpers.learning.optimiser import Adam\n"
        "p = torch.nn.Parameter(torch.ones(2)); o = Adam([p])\n"
        "p.sum().backward(); o.step(0.1); sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
