"""Where a controller of one's own plant has to work, and the episodes that are drawn from there."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from helpers.learning.tracking_policy import Gains, TrackingPID
from helpers.own_plant.description import PlantDescription
from helpers.own_plant.model import ArmaxModel
from helpers.own_plant.quality import CleanRecords
from helpers.own_plant.settings import OperationParams
from helpers.plant.tracking import Bounds, Scenarios, Tracked, Tracker, track
from helpers.settings.leaf import InputError

SHRUNK = (1.0, 0.8, 0.6, 0.4, 0.2)  # shares of a drawn set point change, of which the first is taken that the inputs can hold
TINY = 1e-9


@dataclass(frozen=True)
class Operation:
    """The range over which a plant is operated; deviation variables.

    Attributes:
        loops: the outputs that have a loop, by place; the others are measured and free.
        low, high: least and greatest set point of each output, (n_y,); zero where it has no loop.
        unit: in which errors count alike, (n_y,): half the range of the set points, or the described scale where it has none.
        bounds: of the inputs.
    """

    loops: tuple[int, ...]
    low: Tensor
    high: Tensor
    unit: Tensor
    bounds: Bounds

    @property
    def reach(self) -> Tensor:
        """From the least to the greatest set point, (n_y,); the unit where they do not differ."""
        return torch.where(self.high > self.low, self.high - self.low, self.unit)

    @property
    def centre(self) -> Tensor:
        """Middle of the set points, (n_y,)."""
        return (self.low + self.high) / 2

    def run(self, controller: Tracker | Gains, scenarios: Scenarios) -> Tracked:
        """A controller, or the PID with these gains, through all scenarios; without gradients."""
        with torch.no_grad():
            tracker = TrackingPID(controller, self.bounds) if isinstance(controller, Gains) else controller
            return track(tracker, scenarios, self.bounds)

    def figures(self, controller: Tracker | Gains, scenarios: Scenarios) -> tuple[Tensor, Tensor]:
        """Mean |e| and movement of each of its episodes, (K,) each."""
        run = self.run(controller, scenarios)
        return self.error(run), self.movement(run)

    def error(self, run: Tracked) -> Tensor:
        """Mean over samples and loops of |e| of each episode in units of `unit`, (K,)."""
        return (run.error.abs() / self.unit)[..., list(self.loops)].mean((0, 2))

    def movement(self, run: Tracked) -> Tensor:
        """Sum over the inputs of |u_t - u_{t-1}| as a share of their ranges, mean over samples, of each episode, (K,)."""
        return (run.movement / self.bounds.span).sum(-1).mean(0)


def operation(clean: CleanRecords, description: PlantDescription, loops: tuple[int, ...], dtype: torch.dtype) -> Operation:
    """The range that the record covers: its set points under automatic control, and those that the description names."""
    ends = []
    for index, variable in enumerate(description.controlled):
        named = [variable.set_point, description.transfer.get(variable.name, variable.set_point)]
        if variable.set_point_tag is not None:
            rows = clean.table["automatic"] & (clean.table["segment"] >= 0)
            named += clean.table.loc[rows, variable.set_point_tag].agg(["min", "max"]).dropna().tolist()
        ends.append((min(named), max(named)) if index in loops else (variable.steady_state,) * 2)
    least, greatest = np.array(ends).T - description.values("controlled", "steady_state")
    reach = (greatest - least) / 2
    scale = np.where(reach > TINY, reach, abs(description.values("controlled", "scale")))
    steady = description.steady("manipulated")
    bounds = [torch.tensor(description.values("manipulated", key), dtype=torch.float32) - steady for key in ("low", "high")]
    rate = torch.tensor(description.values("manipulated", "fastest"))
    low, high, unit = (torch.tensor(part, dtype=dtype) for part in (least, greatest, scale))
    return Operation(loops, low, high, unit, Bounds(*(part.to(dtype) for part in (*bounds, rate))))


def targets(
    models: ArmaxModel, operation: Operation, params: OperationParams, generator: torch.Generator, before: Tensor | None = None
) -> Tensor:
    """Set points within the range that the inputs of each model can hold, (K, n_y); some loops stay where they were before."""
    dtype, n_models = models.entry.dtype, len(models)
    drawn = operation.low + (operation.high - operation.low) * torch.rand(
        n_models, len(operation.low), generator=generator, dtype=dtype
    )
    if before is not None:
        keep = torch.rand(drawn.shape, generator=generator) < params.still
        moving = torch.randint(len(operation.loops), (n_models,), generator=generator)
        keep[torch.arange(n_models), torch.tensor(operation.loops)[moving]] = False
        drawn = torch.where(keep, before, drawn)
    reserve = params.reserve * operation.bounds.span
    found, open_ = torch.zeros_like(drawn), torch.ones(n_models, dtype=torch.bool)
    for share in SHRUNK:
        _, _, u = models.at_rest(share * drawn, operation.loops)
        holds = open_ & ((u > operation.bounds.low + reserve) & (u < operation.bounds.high - reserve)).all(1)
        found[holds] = share * drawn[holds]
        open_ &= ~holds
    return found


def draw_scenarios(
    models: ArmaxModel, operation: Operation, params: OperationParams, n_steps: int, generator: torch.Generator, quiet: bool = False
) -> Scenarios:
    """An episode for each model: at rest, two set point steps and a load step.

    A `quiet` one has no noise and a single step at its start, and ends long after its load step: what is left then is offset.

    Raises:
        InputError: if hardly any model can be held at a set point of the range.
    """
    dtype, n_models = models.entry.dtype, len(models)

    def share(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    first = targets(models, operation, params, generator)
    second = targets(models, operation, params, generator, first)
    third = targets(models, operation, params, generator, second)
    start, _, before = models.at_rest(first, operation.loops)
    if not torch.isfinite(start).all():
        raise InputError("the model has no steady state at the set points of the record")
    time = torch.arange(n_steps)[:, None]
    steps = (0.15 * share(n_models) * (share(n_models) < 0.5), 0.4 + 0.3 * share(n_models), 0.15 + 0.6 * share(n_models))
    if quiet:
        steps = (torch.zeros(n_models), torch.ones(n_models), torch.full((n_models,), 0.25))
    to_second, to_third, to_load = ((n_steps * part).long() for part in steps)
    set_point = torch.where((time >= to_second)[..., None], second, first)
    set_point = torch.where((time >= to_third)[..., None], third, set_point)
    size = params.load * (2 * share(n_models, models.n_inputs) - 1) * operation.bounds.span
    load = torch.where((time >= to_load)[..., None], size * (share(n_models, 1) < 0.7), torch.zeros(()))
    noise = torch.randn(n_steps, n_models, models.n_disturbances, generator=generator, dtype=dtype) * (not quiet)
    return Scenarios(
        models, set_point, load, start, before.clamp(operation.bounds.low, operation.bounds.high), noise,
        torch.zeros(n_steps + 1, n_models, models.n_outputs, dtype=dtype),
    )  # fmt: skip


def described_gains(description: PlantDescription, dtype: torch.dtype) -> Gains | None:
    """The PID of the description per sample, or None where it names none."""
    if not description.pid:
        return None
    parts, dt = torch.zeros(3, len(description.manipulated), len(description.controlled), dtype=dtype), description.sampling_time
    for output, index, loop in description.loops:
        parts[:, index, output] = torch.tensor([loop.proportional, loop.integral * dt, loop.derivative / dt], dtype=dtype)
    return Gains(*parts)


def recorded_gains(clean: CleanRecords, description: PlantDescription, dtype: torch.dtype) -> tuple[Gains, float]:
    """The PID that explains the moves of the inputs in the record best, one loop an input, and the share of them it explains.

    The moves u_t - u_{t-1} = P (e_t - e_{t-1}) + I e_t + D (e_t - 2 e_{t-1} + e_{t-2}) are regressed on the measured errors of one
    output after the other, over samples in automatic whose input is not at a bound.
    """
    table = clean.table
    whole, automatic = table["segment"].to_numpy(), table["automatic"].to_numpy()
    usable = automatic & (whole >= 0)
    for back in (1, 2):
        usable[back:] &= (whole[back:] == whole[:-back]) & automatic[:-back]
        usable[:back] = False
    parts = np.zeros((3, len(description.manipulated), len(description.controlled)))
    explained = []
    for j, manipulated in enumerate(description.manipulated):
        u = table[manipulated.tag].to_numpy()
        reach = 1e-3 * (manipulated.high - manipulated.low)
        free = usable & (u > manipulated.low + reach) & (u < manipulated.high - reach)
        free[1:] &= free[:-1]
        move = np.diff(u, prepend=u[:1])[free]
        found = []
        for i, controlled in enumerate(description.controlled):
            if controlled.set_point_tag is None or len(move) < 10:
                continue
            e = (table[controlled.set_point_tag] - table[controlled.tag]).to_numpy()
            change = np.diff(e, prepend=e[:1])
            past = np.column_stack([change, e, np.diff(change, prepend=change[:1])])[free]
            gains = np.linalg.lstsq(past, move, rcond=None)[0]
            found.append((1 - ((move - past @ gains) ** 2).sum() / max(float((move**2).sum()), TINY), i, gains))
        if found:
            share, i, gains = max(found, key=lambda fit: fit[0])
            parts[:, j, i] = gains
            explained.append(share)
    return Gains(*torch.tensor(parts, dtype=dtype)), min(explained, default=0.0)
