"""A policy as a file: it does what torch does over whole episodes, in engineering units, within the bounds, quickly."""

import pytest
import torch

from helpers.learning.policy import LSTMPolicy, PolicyController
from helpers.own_plant.deploy import DeployedPolicy, disagreement, export
from helpers.own_plant.description import load_description
from helpers.plant.rollout import stream
from helpers.settings.leaf import InputError
from helpers.settings.paper import load
from tests.own_plant.plants import MadeUpPlant


@pytest.fixture(params=[(1, 1), (2, 2), (3, 2)], ids=str)
def deployed(request, tmp_path, root):
    """A policy with random weights, its file, its task and the steady state."""
    n_y, n_u = request.param
    description = load_description(MadeUpPlant(n_y, n_u, n_cycles=1).write(tmp_path))
    task = description.task(torch.zeros(n_y), torch.zeros(n_y), torch.float64)
    params = load(root, 1).learning.policy.model_copy(update={"error_unit": (0.3,) * n_y, "hidden_cells": (7, 5)})
    policy = LSTMPolicy.initial(params, task, stream(0, "deployed"))
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            parameter.mul_(3 if "weight" in name else 1)  # the biases keep the mean between the bounds
    steady = description.steady("controlled"), description.steady("manipulated")
    path = export(policy, task, *steady, tmp_path / "policy.onnx", {"title": description.title})
    return policy, DeployedPolicy(path), task, steady


def recorded(task, n_steps=50, n_episodes=20):
    """Observations and inputs that go everywhere, beyond the bounds of what a plant does."""
    draws = torch.randn(n_steps + 1, n_episodes, len(task.set_point), generator=stream(0, "y"), dtype=torch.float64)
    share = torch.rand(n_steps, n_episodes, len(task.input_low), generator=stream(0, "u"), dtype=torch.float64)
    return task.set_point + 2 * draws, task.input_low + (task.input_high - task.input_low) * share


def test_file_and_torch_agree_over_whole_episodes(deployed):
    policy, file, task, steady = deployed
    assert disagreement(policy, file, task, *recorded(task), *steady) < 1e-5


def test_another_policy_does_not_agree(deployed):
    policy, file, task, steady = deployed
    with torch.no_grad():
        policy.layers[1].weight_hh_l0.mul_(1.01)
    assert disagreement(policy, file, task, *recorded(task), *steady) > 1e-5


def test_in_closed_loop_the_file_is_the_policy_in_engineering_units(deployed):
    policy, file, task, (steady_y, steady_u) = deployed
    controller = PolicyController(policy, task, exploring=False)
    memory = controller.start(1, 30, torch.Generator())
    file.reset()
    y, applied = torch.zeros(1, len(steady_y), dtype=torch.float64), steady_u[None].numpy()
    for _ in range(30):
        command, memory = controller.act(y, memory)
        expected = command.clamp(task.input_low, task.input_high)
        applied = file.step((y + steady_y).numpy(), (task.set_point + steady_y)[None].numpy(), applied)
        assert applied == pytest.approx((expected + steady_u).numpy(), abs=1e-4)
        y = 0.9 * y + 0.1 * expected.mean()


def test_the_inputs_stay_within_the_bounds(deployed):
    _, file, task, (steady_y, steady_u) = deployed
    for size in (-1e3, 1e3):
        file.reset()
        u = file.step((steady_y + size)[None].numpy(), steady_y[None].numpy(), steady_u[None].numpy())
        assert (u >= (task.input_low + steady_u).numpy() - 1e-9).all()
        assert (u <= (task.input_high + steady_u).numpy() + 1e-9).all()


def test_the_file_tells_about_itself_and_another_file_is_refused(deployed, tmp_path):
    assert deployed[1].notes == {"title": "made up"}
    (tmp_path / "wrong.onnx").write_bytes(b"not a policy")
    with pytest.raises(InputError, match=r"wrong\.onnx: not a policy that can be run"):
        DeployedPolicy(tmp_path / "wrong.onnx")


def test_a_file_that_gives_no_number_does_not_agree(deployed):
    policy, file, task, steady = deployed
    y, u = recorded(task)
    y[3] = torch.nan
    assert not disagreement(policy, file, task, y, u, *steady) <= 1e-5
