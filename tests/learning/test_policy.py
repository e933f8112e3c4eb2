"""The LSTM policy against a plain numpy network, probability densities of scipy and torch, and its fast stepping."""

import numpy as np
import pytest
import torch
from scipy.stats import norm

from helpers.learning.policy import PolicyController, entropy
from helpers.plant.rollout import rollout, stream
from helpers.settings.paper import ExplorationParams
from tests.plant.test_controllers import run

F64 = torch.float64


def stirred(policy, factor=2.0, seed=5):
    """The policy with larger weights, the exploration's included, so that gates, kinks and the ends of ReLU6 are all met."""
    with torch.no_grad():
        weight = policy.output.weight
        rows = weight[policy.n_manipulated :]
        rows.copy_(torch.randn(rows.shape, generator=stream(seed), dtype=rows.dtype) / 5)
        for name, parameter in policy.named_parameters():
            if name != "output.bias":  # it keeps the outputs near the middle of ReLU6
                parameter.mul_(10 * factor if name == "output.weight" else factor)
    return policy


def numpy_forward(policy, y, u, task):
    """Mean and standard deviation by the textbook LSTM, one step, layer and gate at a time."""
    numbers = {name: value.detach().double().numpy() for name, value in policy.named_parameters()}
    low, high, set_point = (getattr(task, name).double().numpy() for name in ("input_low", "input_high", "set_point"))
    y, u = y.double().numpy(), u.double().numpy()
    params, n_steps, n_batch, n_inputs = policy.params, *u.shape
    hidden = [np.zeros((n_batch, width)) for width in params.hidden_cells]
    cell = [np.zeros((n_batch, width)) for width in params.hidden_cells]
    means, deviations = np.empty_like(u), np.empty_like(u)
    for t in range(n_steps):
        before = u[t - 1] if t else np.zeros((n_batch, n_inputs))
        signal = np.hstack([(set_point - y[t]) / np.array(params.error_unit), (2 * before - low - high) / (high - low)])
        for layer, width in enumerate(params.hidden_cells):
            w_in, w_rec, b_in, b_rec = (
                numbers[f"layers.{layer}.{kind}_l0"] for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
            )
            total = signal @ w_in.T + b_in + hidden[layer] @ w_rec.T + b_rec
            gate_i, gate_f, candidate, gate_o = (total[:, part * width : (part + 1) * width] for part in range(4))
            gate_i, gate_f, gate_o = (1 / (1 + np.exp(-gate)) for gate in (gate_i, gate_f, gate_o))
            cell[layer] = gate_f * cell[layer] + gate_i * np.tanh(candidate)
            hidden[layer] = gate_o * np.tanh(cell[layer])  # the recurrence sees it without the leaky ReLU
            signal = np.where(hidden[layer] > 0, hidden[layer], params.leaky_slope * hidden[layer])
        z = signal @ numbers["output.weight"].T + numbers["output.bias"]
        share = np.minimum(np.maximum(0, z), 6) / 6  # Eq. 3.2.5
        means[t] = low + (high - low) * share[:, :n_inputs]
        deviations[t] = (high - low) * (params.std_low + (params.std_high - params.std_low) * share[:, n_inputs:])
    return means, deviations


def episodes(case, policy, exploring=True, n=7, seed=0):
    return rollout(case.process, PolicyController(policy, case.task, exploring), case.task, n, stream(seed, "episodes"))


@pytest.mark.equation("3.2.5")
@pytest.mark.parametrize("hidden_cells", [(20, 20), (3,), (4, 7, 2)], ids=str)
@pytest.mark.parametrize("leaky_slope", [0.01, 0.3])
def test_forward_is_the_textbook_lstm_with_leaky_relu_and_relu6_mapped_to_the_bounds(case, hidden_cells, leaky_slope):
    spread = {"std_low": 0.1, "initial_std": 0.2, "std_high": 0.7}
    policy = stirred(case.policy(hidden_cells=hidden_cells, leaky_slope=leaky_slope, **spread))
    batch = episodes(case, policy)
    mean, std = policy(batch.y, batch.u, case.task)
    expected = numpy_forward(policy, batch.y, batch.u, case.task)
    np.testing.assert_allclose(mean.detach(), expected[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(std.detach(), expected[1], rtol=0, atol=1e-10)
    assert mean.std(0).min() > 1e-2  # the comparison is not one of constants


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (F64, 1e-12)])
@pytest.mark.parametrize("exploring", [True, False])
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_fast_stepping_agrees_with_forward_along_whole_trajectories(study, dtype, tolerance, exploring, factor):
    case = study(1, dtype)
    policy = stirred(case.policy(), factor)
    batch = episodes(case, policy, n=50)
    controller = PolicyController(policy, case.task, exploring)
    command, exploration = run(controller, batch.y[:-1]), controller.start(50, 50, stream(0)).exploration
    u = command.clamp(case.task.input_low, case.task.input_high)
    mean, std = (part.detach() for part in policy(batch.y, u, case.task))
    expected = mean + std * torch.stack(exploration).mT if exploring else mean
    span = case.task.input_high - case.task.input_low
    assert ((command - expected) / span).abs().max() < tolerance


def test_exploration_is_standard_normal(case):
    memory = PolicyController(case.policy(), case.task, exploring=True).start(40_000, 1, stream(0, "spread"))
    draws = torch.stack(memory.exploration).numpy()
    np.testing.assert_array_less(np.abs(draws.mean(-1)), 5 / np.sqrt(40_000))
    np.testing.assert_allclose(draws.std(-1), 1, rtol=5 / np.sqrt(80_000))


def test_entropy_is_that_of_inputs_measured_by_their_range(study):
    task = study().task
    std = torch.rand(4, 3, 2, generator=stream(0), dtype=F64) + 0.1
    expected = norm.entropy(scale=std.numpy() / (task.input_high - task.input_low).numpy()).sum(-1)
    np.testing.assert_allclose(entropy(std, task), expected, rtol=1e-12)


@pytest.mark.equation("3.2.3")
def test_log_probability_and_its_gradient_are_those_of_independent_normal_inputs(case):
    """Of scipy, and torch's own gradient through its own LSTM; the rest of a trajectory's density does not depend on the policy."""
    policy = stirred(case.policy(leaky_slope=0.3))
    batch = episodes(case, policy)
    found = policy.log_probability(batch.y, batch.u, batch.command, case.task)
    mean, std = numpy_forward(policy, batch.y, batch.u, case.task)
    np.testing.assert_allclose(found.detach(), norm.logpdf(batch.command.numpy(), mean, std).sum(-1), rtol=0, atol=1e-9)
    weights = torch.randn(found.shape, generator=stream(0), dtype=F64)
    expected = torch.distributions.Normal(*policy(batch.y, batch.u, case.task)).log_prob(batch.command).sum(-1)
    gradients = [torch.autograd.grad((weights * values).sum(), list(policy.parameters())) for values in (found, expected)]
    for own, torchs in zip(*gradients, strict=True):
        torch.testing.assert_close(own, torchs, rtol=1e-8, atol=1e-8 * torchs.abs().max().item())


@pytest.mark.parametrize(("low", "high"), [((-20.0, -60.0), (20.0, 60.0)), ((-1.0, -5.0), (9.0, 95.0))])
def test_a_fresh_policy_asks_for_inputs_near_the_steady_state(study, low, high):
    case = study(process={"input_low": low, "input_high": high})
    span = np.subtract(high, low)
    policies = [case.policy(seed) for seed in range(5)]
    assert len({policy.layers[0].weight_ih_l0[0, 0].item() for policy in policies}) == 5
    for policy in policies:
        batch = episodes(case, policy, exploring=False, n=20)
        assert (np.abs(batch.command.numpy().mean((0, 1))) / span < 0.1).all()
        _, std = policy(batch.y, batch.u, case.task)
        np.testing.assert_allclose(std.detach().numpy() / span, policy.params.initial_std, rtol=1e-12)
        with torch.no_grad():
            policy.output.weight.zero_()
        np.testing.assert_allclose(policy(batch.y, batch.u, case.task)[0].detach(), 0, atol=1e-12 * span.max())


@pytest.mark.parametrize("limits", [None, {"std_low": 0.1, "std_high": 0.9, "initial_std": 0.3}])
def test_reset_exploration_restores_the_spread_and_keeps_the_mean(case, limits):
    """Within the limits of the policy, or within new ones that it takes over."""
    policy = stirred(case.policy())
    batch = episodes(case, policy)
    before = policy(batch.y, batch.u, case.task)
    policy.reset_exploration(limits and ExplorationParams.model_construct(**limits))
    mean, std = policy(batch.y, batch.u, case.task)
    span = case.task.input_high - case.task.input_low
    assert torch.equal(before[0], mean)
    assert not torch.allclose(before[1], std)
    torch.testing.assert_close(std, (policy.params.initial_std * span).expand_as(std), rtol=1e-12, atol=0)
    assert limits is None or vars(policy.params).items() >= limits.items()
