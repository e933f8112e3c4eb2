"""What a practitioner would take: the PID of the record, the same re-tuned on all models, and offset-free predictive control."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import cma
import numpy as np
import torch
from torch import Tensor

from helpers.learning.tracking_policy import Gains
from helpers.own_plant.model import ArmaxModel
from helpers.own_plant.operation import Operation
from helpers.own_plant.settings import RivalParams
from helpers.plant.tracking import Scenarios

Price = Callable[[Tensor, Tensor], Tensor]  # of each episode's mean |e| and movement, (..., K) each


def side_by_side(scenarios: Scenarios, n_copies: int) -> Scenarios:
    """The same episodes several times over, for several controllers at once."""
    model = scenarios.process
    assert isinstance(model, ArmaxModel)
    index = torch.arange(len(model)).repeat(n_copies)
    rows = {name: getattr(scenarios, name)[index] for name in ("start", "before")}
    columns = {name: getattr(scenarios, name)[:, index] for name in ("set_point", "load", "disturbance", "noise")}
    return Scenarios(model.members(index), **rows, **columns)


def step_response(model: ArmaxModel, n_steps: int) -> np.ndarray:
    """The undisturbed outputs after a unit step of each input, from rest at zero, (n_u, n_steps + 1, n_y)."""
    one = model.members(torch.zeros(model.n_inputs, dtype=torch.long))
    still = replace(one, constant=one.constant * 0, spread=one.spread * 0)
    x, u = model.window.new_zeros(model.n_inputs, model.n_states), torch.eye(model.n_inputs, dtype=model.window.dtype)
    outputs = [still.observe(x, x)]
    for _ in range(n_steps):
        x = still.step(x, u, torch.zeros_like(x))
        outputs.append(still.observe(x, x))
    return torch.stack(outputs, dim=1).numpy()


def simc(response: np.ndarray) -> tuple[float, float]:
    """P and I per sample of a PI by the SIMC rule (Skogestad 2003, Section 4) with a closed-loop time constant of the dead time.

    The first-order model is read off a step response, (n,): gain, and the times at which 28 and 63 % of it are reached. A response
    that still goes up at its end is that of an integrator.
    """
    end, slope = response[-1], response[-1] - response[-2]
    if abs(slope) * len(response) > 0.5 * abs(end):
        rate = slope
        dead = max(1.0, len(response) - 1 - end / slope)
        return 1 / (rate * 2 * dead), 1 / (rate * 2 * dead) / (8 * dead)
    share = response / end
    early, late = (float(np.argmax(share >= level)) for level in (0.283, 0.632))
    time = max(1.0, 1.5 * (late - early))
    dead = max(1.0, late - time)
    gain = time / (end * 2 * dead)
    return gain, gain / min(time, 8 * dead)


def tuned_pid(
    nominal: ArmaxModel, scenarios: Scenarios, record: Gains, operation: Operation, price: Price, params: RivalParams, seed: int
) -> Gains:
    """The PID of the record with its gains re-tuned on all models at once, from several starts, by CMA-ES (Hansen 2016).

    The starts are the record's gains, those with a third of the integral action, and those of the SIMC rule for each loop. What is
    searched are factors of the gains that are not zero.
    """
    given = torch.stack([record.proportional, record.integral, record.derivative])
    slow, textbook = given.clone(), given.clone()
    slow[1] /= 3
    response = step_response(nominal.to(torch.float64), params.response)
    for j, i in torch.nonzero(given[1]).tolist():
        rule = torch.tensor(simc(response[j, :, i]), dtype=given.dtype)
        if rule.isfinite().all() and rule[1] * given[1, j, i] > 0:
            textbook[:2, j, i] = rule
    n_episodes = len(scenarios.start)

    def gains(start: Tensor, logs: Tensor) -> Tensor:
        """Gains of many candidates, (n, 3, n_u, n_y)."""
        many = start.repeat(len(logs), 1, 1, 1)
        many[:, start != 0] *= logs.exp()
        return many

    def costs(start: Tensor, logs: Tensor) -> list[float]:
        spread = Gains(*gains(start, logs).repeat_interleave(n_episodes, dim=0).unbind(1))
        figures = operation.figures(spread, side_by_side(scenarios, len(logs)))
        value = price(*(figure.reshape(len(logs), n_episodes) for figure in figures))
        return list(value.nan_to_num(1e9).clamp(max=1e9).tolist())

    found: list[tuple[float, Tensor]] = []
    for number, start in enumerate((given, slow, textbook), 1):
        options = {"seed": seed + number, "verbose": -9, "maxiter": params.generations, "popsize": params.population}
        search = cma.CMAEvolutionStrategy([0.0] * int((start != 0).sum()), 0.4, options)
        while not search.stop():
            asked = search.ask()
            search.tell(asked, costs(start, torch.tensor(np.array(asked), dtype=given.dtype)))
        best = torch.tensor(search.result.xbest, dtype=given.dtype)[None]
        found += [(costs(start, logs)[0], gains(start, logs)[0]) for logs in (best, torch.zeros_like(best))]
    return Gains(*min(found, key=lambda pair: pair[0])[1])


class PredictiveControl:
    """Offset-free predictive control in increments (generalised predictive control, Clarke et al. 1987), its first move clipped.

    It minimises sum_{i=1..N} |(y_sp - y_{t+i}) / unit|^2 + penalty sum_{i=0..N-1} |Delta u_{t+i} / span|^2 along the identified
    model in increments, A(q) Delta y = B(q) Delta u + C(q) (1 - kappa q^-1) e: the observer's zero kappa lets the disturbance
    drift, so that no offset stays. Without bounds the plan is a linear law; a constrained one differs from its clipped form only
    while an input sits at a bound.

    Args:
        model: one member. horizon: N, samples.
    """

    def __init__(self, model: ArmaxModel, operation: Operation, horizon: int, penalty: float, kappa: float) -> None:
        n_y, n_u, lags, taps = model.n_outputs, model.n_inputs, model.lags, model.taps
        dtype, loops, exact = model.window.dtype, list(operation.loops), model.to(torch.float64)
        zero = exact.window.new_zeros
        own, inputs, zeros = exact.window[0].split([n_y * lags, n_u * (taps - 1), n_y * lags], dim=-1)
        one = torch.cat([torch.eye(n_y, dtype=own.dtype), zeros], dim=-1).unflatten(-1, (-1, n_y))
        drifting = torch.cat([one, zero(n_y, 1, n_y)], 1)
        drifting[:, 1:] -= kappa * one
        window = torch.cat([own, zero(n_y, n_y), inputs, drifting[:, 1:].flatten(1)], dim=-1)
        self.model = ArmaxModel(window[None], exact.entry[:1], zero(1, n_y), zero(1, n_y, 2), lags + 1, taps)
        # Side by side: every state at one without a move, and a unit move of every input from rest.
        n_x = self.model.n_states
        x = torch.cat([torch.eye(n_x, dtype=own.dtype), zero(n_u, n_x)])
        u, outputs = torch.cat([zero(n_x, n_u), torch.eye(n_u, dtype=own.dtype)]), []
        for _ in range(horizon):
            x, u = self.model.step(x, u, torch.zeros_like(x)), torch.zeros_like(u)
            outputs.append(self.model.observe(x, x))
        ahead, step = torch.stack(outputs).cumsum(0)[..., loops].split([n_x, n_u], dim=1)  # (N, n_x or n_u, loops)
        effect = zero(horizon, len(loops), horizon, n_u)
        for i in range(horizon):
            effect[i:, :, i] = step[: horizon - i].mT
        scale = operation.unit[loops].double()
        weighted = (effect / scale[:, None, None]).reshape(horizon * len(loops), -1)
        moves = penalty * operation.bounds.span.double().repeat(horizon) ** -2
        law = torch.linalg.solve(weighted.T @ weighted + moves.diag(), weighted.T)[:n_u].reshape(n_u, horizon, len(loops)) / scale
        self.on_error = zero(n_u, n_y)
        self.on_error[:, loops] = law.sum(1)
        self.on_error = self.on_error.to(dtype)
        self.on_state = torch.einsum("uil,ixl->ux", law, ahead).to(dtype)
        self.model = self.model.to(dtype)

    def start(self, n_trajectories: int) -> tuple[Tensor, Tensor, Tensor]:
        """At rest: the window of increments, and the output and the input before (nan: none yet)."""
        zero, nan = self.on_state.new_zeros, torch.nan
        n_y, n_u = self.model.n_outputs, self.model.n_inputs
        return zero(n_trajectories, self.model.n_states), zero(n_trajectories, n_y) + nan, zero(n_trajectories, n_u) + nan

    def act(
        self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """The first move of the plan made at this sample."""
        x, y_before, u_before = memory
        n_y, lags = self.model.n_outputs, self.model.lags
        change, move = torch.nan_to_num(y - y_before), torch.nan_to_num(u_previous - u_before)
        x = self.model.step(x, move, torch.zeros_like(x))
        x[:, -n_y * lags :][:, :n_y] = change - x[:, :n_y]  # the innovation
        x[:, :n_y] = change
        return u_previous + (set_point - y) @ self.on_error.T - x @ self.on_state.T, (x, y, u_previous)


def tuned_predictive(
    nominal: ArmaxModel, scenarios: Scenarios, operation: Operation, price: Price, params: RivalParams
) -> PredictiveControl:
    """Predictive control whose penalty on moves and observer do best on all models."""
    model = nominal.to(operation.unit.dtype)
    controls = [
        PredictiveControl(model, operation, params.horizon, penalty, kappa)
        for kappa, penalty in product(params.observer, params.penalties)
    ]
    return min(controls, key=lambda control: float(price(*operation.figures(control, scenarios))))
