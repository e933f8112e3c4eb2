"""The process against its stochastic differential equation, closed forms and the balances behind it."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from helpers.plant.process import linearised_balances
from helpers.plant.rollout import stream

A = np.array([[-3.997, -0.446], [-6.092, -1.581]])  # Eq. 4.1.3b
B = np.diag([0.500, 0.305])
D = np.array([0.500, 0.300])  # Eq. 4.1.3c, the diagonal
X0, U0 = np.array([0.7, -1.3]), np.array([5.0, -20.0])
F64 = torch.float64


def repeat(row, n):
    return torch.tensor(row, dtype=F64).repeat(n, 1)


def by_hand(x, u, noise, dt, m):
    """Euler-Maruyama, Eq. 4.1.3a: m steps from states (K, 2) with the input held and noise (K, m, 2)."""
    tau = dt / m
    for step in range(m):
        x = x + (x @ A.T + u @ B.T) * tau + D * x * tau**0.5 * noise[:, step]
    return x


@pytest.mark.equation("4.1.3", "4.1.3a", "4.1.3c")
@pytest.mark.parametrize(("dt", "m"), [(0.04, 1), (0.36, 1), (0.04, 4)])
def test_a_sample_is_so_many_steps(study, dt, m):
    """Against numpy; and mean and covariance over many draws, from a spread-out state."""
    process, n = study(process={"sampling_time": dt, "integration_steps": m}).process, 200_000
    noise = torch.randn(n, process.n_disturbances, generator=stream(0, "steps"), dtype=F64)
    start = torch.tensor(X0) + torch.randn(n, 2, generator=stream(0, "start"), dtype=F64) * torch.tensor([0.1, 0.2])
    found = process.step(start, repeat(U0, n), noise)
    torch.testing.assert_close(found, torch.tensor(by_hand(start.numpy(), U0[None], noise.numpy().reshape(n, m, 2), dt, m)))
    still = process.step(repeat(X0, 1), repeat(U0, 1), torch.zeros(1, 2 * m, dtype=F64))
    expected = process.state_step @ torch.tensor(X0) + process.input_step @ torch.tensor(U0)
    torch.testing.assert_close(still[0], expected, rtol=1e-12, atol=1e-12)
    mean, covariance = process.moments(torch.tensor(X0), torch.tensor([0.01, 0.04], dtype=F64).diag(), torch.tensor(U0))
    error = found.std(0) / n**0.5
    assert ((found.mean(0) - mean).abs() < 5 * error).all()
    torch.testing.assert_close(torch.cov(found.T), covariance, rtol=0.02, atol=2e-4)
    torch.testing.assert_close(mean, expected, rtol=1e-12, atol=1e-12)


def test_noise_for_another_number_of_steps_is_refused(study):
    with pytest.raises(ValueError, match="noise of 2 columns, expected 8"):
        study().process.step(repeat(X0, 1), repeat(U0, 1), repeat(X0, 1))


def test_before_its_last_kick_the_next_state_is_normal(study):
    """Whatever moves the last part of the noise alone moves the state by so many of its standard deviations."""
    process = study().process
    x, u = (torch.randn(5, 3, 2, generator=stream(0, name), dtype=F64) for name in ("x", "u"))
    noise = torch.randn(5, 3, 8, generator=stream(0, "w"), dtype=F64)
    for given in (process, process.scaled(*torch.tensor([[0.7, 1.0, 1.3], [1.2, 1.0, 0.8]], dtype=F64))):
        mean, std = given.before_last_kick(x, u, noise)
        after = given.step(x, u, noise)
        torch.testing.assert_close(((after - mean) / std).abs(), noise[..., 6:].abs())


@pytest.mark.equation("4.1.3b")
def test_factors_of_each_trajectory_are_processes_of_their_own(study):
    x, u, factors, noise = torch.randn(3, 14, generator=stream(0, "factors"), dtype=F64).split([2, 2, 2, 8], dim=1)
    state, entry = 1 + 0.3 * factors.T
    process = study().process
    found = process.scaled(state, entry)
    for k in range(3):
        changes = {"drift_state": state[k].item() * A, "drift_input": entry[k].item() * B}
        alone = study(process={name: tuple(map(tuple, matrix)) for name, matrix in changes.items()}).process
        rows = x[k : k + 1], u[k : k + 1]
        torch.testing.assert_close(found.step(x, u, noise)[k : k + 1], alone.step(*rows, noise[k : k + 1]), rtol=1e-12, atol=1e-12)
        drift = changes["drift_state"] @ x[k].numpy() + changes["drift_input"] @ u[k].numpy()
        np.testing.assert_allclose(found.drift(x, u)[k], drift, rtol=1e-12)
        np.testing.assert_allclose(alone.drift(*rows)[0], drift, rtol=1e-12)
    assert torch.equal(process.drift_state, torch.tensor(A))  # the process itself is as it was


@pytest.mark.equation("4.1.3")
def test_without_noise_the_step_converges_to_first_order(study):
    exact = expm(2 * A) @ X0 + np.linalg.solve(A, (expm(2 * A) - np.eye(2)) @ B @ U0)
    errors = []
    for halving in range(8):
        process = study(process={"sampling_time": 2.0, "integration_steps": 50 * 2**halving}).process
        end = process.step(repeat(X0, 1), repeat(U0, 1), torch.zeros(1, process.n_disturbances, dtype=F64))
        errors.append(np.linalg.norm(end[0].numpy() - exact))
    ratios = np.array(errors[:-1]) / errors[1:]
    np.testing.assert_allclose(ratios[-3:], 2, rtol=0.02)
    assert errors[-1] < 1e-2 * np.linalg.norm(exact)


@pytest.mark.equation("4.1.4")
def test_observation_is_read_with_a_relative_error(study):
    process, n = study().process, 200_000
    x = repeat(X0, n)
    ratio = (process.observe(x, torch.randn(n, 2, generator=stream(0, "observe"), dtype=F64)) / x).numpy()
    np.testing.assert_array_less(np.abs(ratio.mean(0) - 1), 5 * 0.025 / np.sqrt(n))
    np.testing.assert_allclose(ratio.std(0), 0.025, rtol=5 / np.sqrt(2 * n))
    assert abs(np.corrcoef(ratio.T)[0, 1]) < 5 / np.sqrt(n)
    rest = torch.zeros(1, 2, dtype=F64)
    assert torch.equal(process.observe(rest, torch.ones_like(rest)), rest)


@pytest.mark.equation("4.1.3b")
def test_the_balances_give_the_printed_matrices(study):
    balance = study().params.process.balance
    state, inputs = linearised_balances(balance)
    # The groups have three decimals; a22 = -1.582 comes out where the paper prints -1.581, so its last digit is allowed to differ.
    np.testing.assert_allclose(state, A, rtol=0, atol=1e-3)
    np.testing.assert_allclose(np.array(state)[[0, 0, 1], [0, 1, 0]].round(3), A[[0, 0, 1], [0, 1, 0]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(inputs, B, rtol=0, atol=1e-12)


@pytest.mark.equation("4.1.3b")
@pytest.mark.parametrize(
    ("concentration", "temperature", "jacket"), [(1.0, 350.0, 420.0), (0.2, 500.0, 480.0), (5.0, 298.0, 390.0)]
)
def test_linearised_balances_are_the_jacobian_of_the_arrhenius_balances(study, concentration, temperature, jacket):
    """At any steady state with these groups: central differences of the nonlinear balances, in absolute variables."""
    groups = study().params.process.balance
    q, k, exchange, heat = groups.dilution_rate, groups.rate_constant, groups.heat_exchange, groups.reaction_heat
    activation = groups.rate_sensitivity * temperature**2 / (k * concentration)  # E/R
    prefactor = k * np.exp(activation / temperature)
    feed = concentration * (1 + k / q)
    inlet = temperature + (heat * k * concentration - exchange * (jacket - temperature)) / q

    def balances(z):
        c, t, c0, t_e = z
        rate = prefactor * np.exp(-activation / t) * c
        return np.array([q * (c0 - c) - rate, q * (inlet - t) - heat * rate + exchange * (t_e - t)])

    steady = np.array([concentration, temperature, feed, jacket])
    np.testing.assert_allclose(balances(steady), 0, atol=1e-9)
    steps = 1e-5 * steady
    jacobian = np.column_stack([(balances(steady + row) - balances(steady - row)) / (2 * row.sum()) for row in np.diag(steps)])
    state, inputs = linearised_balances(groups)
    np.testing.assert_allclose(jacobian, np.hstack([state, inputs]), rtol=1e-6, atol=1e-6)
