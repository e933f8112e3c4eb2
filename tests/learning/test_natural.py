"""The natural gradient against a dense Fisher matrix, and what the trust region promises."""

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence
from torch.func import functional_call, jacrev
from torch.nn.utils import parameters_to_vector

from helpers.learning import natural
from helpers.learning.learner import surrogate
from helpers.learning.natural import fisher_product, precondition
from helpers.learning.policy import PolicyController
from helpers.plant.rollout import rollout, stream

F64 = torch.float64


def problem(synthetic, cells=(3, 2), n=6):
    """A tiny policy whose spread depends on the history, and episodes that it drew."""
    case = synthetic(2, 2, n_steps=5)
    policy = case.policy(hidden_cells=cells)
    with torch.no_grad():
        weight = policy.output.weight
        weight.copy_(torch.randn(weight.shape, generator=stream(1), dtype=F64) / 3)
    return case, policy, rollout(case.process, PolicyController(policy, case.task, exploring=True), case.task, n, stream(0))


def dense_fisher(policy, batch, task):
    """The Hessian of the mean divergence from the present policy: the Fisher matrix by torch's own distributions."""
    names, parameters = zip(*policy.named_parameters(), strict=True)
    flat = parameters_to_vector(parameters).detach()
    sizes = [parameter.numel() for parameter in parameters]
    with torch.no_grad():
        here = Independent(Normal(*policy(batch.y, batch.u, task)), 1)

    def divergence(vector):
        pieces = zip(names, vector.split(sizes), parameters, strict=True)
        given = {name: piece.view_as(parameter) for name, piece, parameter in pieces}
        there = Independent(Normal(*functional_call(policy, given, (batch.y, batch.u, task))), 1)
        return kl_divergence(here, there).mean()

    return jacrev(jacrev(divergence))(flat)


def set_gradient(policy, batch, task, sign=1.0):
    advantage = torch.randn(batch.u.shape[:2], generator=stream(2), dtype=F64)
    policy.zero_grad()
    (sign * surrogate(policy.log_probability(batch.y, batch.u, batch.command, task), advantage)).backward()
    return parameters_to_vector([parameter.grad for parameter in policy.parameters()])


def test_the_product_is_that_with_the_hessian_of_the_divergence(synthetic):
    case, policy, batch = problem(synthetic)
    fisher, product = dense_fisher(policy, batch, case.task), fisher_product(policy, batch.y, batch.u, case.task)
    assert fisher.diagonal().max() > 1
    for seed in range(3):  # more than once: no product spends what the next one needs
        vector = torch.randn(len(fisher), generator=stream(seed), dtype=F64)
        torch.testing.assert_close(product(vector), fisher @ vector, rtol=1e-9, atol=1e-10)


def test_the_direction_solves_the_dense_system(synthetic, monkeypatch):
    monkeypatch.setattr(natural, "ITERATIONS", 2000)
    case, policy, batch = problem(synthetic)
    gradient = set_gradient(policy, batch, case.task)
    damped = dense_fisher(policy, batch, case.task) + natural.DAMPING * torch.eye(len(gradient), dtype=F64)
    expected = torch.linalg.solve(damped, gradient)
    precondition(policy, batch, case.task, 0.02)
    found = parameters_to_vector([parameter.grad for parameter in policy.parameters()])
    torch.testing.assert_close(found / found.norm(), expected / expected.norm(), rtol=0, atol=1e-3)
    assert (found @ damped @ found / 2).item() == pytest.approx(0.02, rel=1e-3)


def test_a_step_changes_the_policy_by_the_trust_region(synthetic, monkeypatch):
    monkeypatch.setattr(natural, "DAMPING", 1e-6)
    case, policy, batch = problem(synthetic, (20, 20), 40)
    with torch.no_grad():
        before = Normal(*policy(batch.y, batch.u, case.task))
    set_gradient(policy, batch, case.task)
    precondition(policy, batch, case.task, 1e-8)  # small, so that the quadratic model holds
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.sub_(parameter.grad)
        after = Normal(*policy(batch.y, batch.u, case.task))
    assert kl_divergence(before, after).sum(-1).mean().item() == pytest.approx(1e-8, rel=0.01)


def test_the_sign_is_that_of_the_gradient(synthetic):
    case, policy, batch = problem(synthetic)
    gradient = set_gradient(policy, batch, case.task, -1.0)
    precondition(policy, batch, case.task, 0.1)
    assert gradient @ parameters_to_vector([parameter.grad for parameter in policy.parameters()]) > 0


def test_a_policy_at_rest_stays_where_it_is(synthetic):
    case, policy, batch = problem(synthetic)
    for parameter in policy.parameters():
        parameter.grad = torch.zeros_like(parameter)
    precondition(policy, batch, case.task, 0.1)
    assert all((parameter.grad == 0).all() for parameter in policy.parameters())
