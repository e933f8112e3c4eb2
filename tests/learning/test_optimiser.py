"""Our Adam against torch's own class, and that it does without torch's compiler."""

import copy
import subprocess
import sys

import pytest
import torch

from helpers.learning.optimiser import Adam


def trained(kind, network, **options):
    trained = copy.deepcopy(network)
    optimiser = kind(trained.parameters(), lr=0.05, **options)
    signal = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for step in range(20):
        for group in optimiser.param_groups:
            group["lr"] = 0.05 / (1 + step)
        optimiser.zero_grad()
        trained(signal)[0].square().sum().backward()
        optimiser.step()
    return trained


@pytest.fixture
def network():
    torch.manual_seed(0)
    return torch.nn.LSTM(3, 4, dtype=torch.float64)


def test_the_steps_are_those_of_torch(network):
    ours, torchs = trained(Adam, network), trained(torch.optim.Adam, network, fused=True)
    for name, parameter in ours.named_parameters():
        assert torch.equal(parameter, torchs.get_parameter(name)), name
        assert not torch.equal(parameter, network.get_parameter(name)), name


def test_a_parameter_without_a_gradient_stays(network):
    before = copy.deepcopy(network)
    optimiser = Adam(network.parameters(), lr=0.1)
    optimiser.step()
    for name, parameter in network.named_parameters():
        assert torch.equal(parameter, before.get_parameter(name)), name


def test_the_compiler_of_torch_is_not_loaded():
    code = (
        "import sys, torch; from helpers.learning.optimiser import Adam\n"
        "p = torch.nn.Parameter(torch.ones(2)); o = Adam([p], lr=0.1)\n"
        "o.zero_grad(); p.sum().backward(); o.step(); sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
