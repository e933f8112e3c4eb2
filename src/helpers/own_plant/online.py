"""A few episodes of the plant itself: explore gently, identify again, improve through the new models, take over only if better."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd
import torch
from scipy.stats import ttest_rel
from torch import Tensor

from helpers.learning.tracking_policy import TrackingPolicy
from helpers.own_plant.episodes import Stretch
from helpers.own_plant.identify import Identified, identify
from helpers.own_plant.learn import Workshop, learn_policy, open_workshop
from helpers.plant.process import Process
from helpers.plant.tracking import Scenarios, Tracker

CAREFUL = 0.9  # share of the allowed movement that the policy is given to learn with
HALVINGS, REHEARSED = 8, 400  # of the disturbance, at most; episodes of the model to choose it by
FIGURES = ("mean |e|", "movement", "offset")
PLACES = (0.0, 0.5, 1.0)  # of the set points of a loop within its range; every combination of those of all loops is judged


@dataclass(frozen=True)
class Exploring:
    """A policy whose command is disturbed, so that the plant shows more of itself.

    Attributes:
        policy: what is disturbed. size: of the disturbance, standard deviation (n_u,).
    """

    policy: TrackingPolicy
    size: Tensor
    generator: torch.Generator

    def start(self, n_trajectories: int) -> Any:
        """The policy's."""
        return self.policy.start(n_trajectories)

    def act(self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: Any) -> tuple[Tensor, Any]:
        """The policy's command and a normal disturbance."""
        command, memory = self.policy.act(y, set_point, u_previous, memory)
        return command + self.size * torch.randn(command.shape, generator=self.generator, dtype=command.dtype), memory


@dataclass(frozen=True)
class Improvement:
    """What the episodes of the plant brought.

    Attributes:
        policy: the one to go on with. taken: whether it is the new one.
        before, after: mean |e| of the old and the new policy on fresh episodes, as shares of the record's PID's.
        worse: share of the exploring episodes that were worse than those of the record's PID.
        words: all of it in a sentence.
    """

    policy: TrackingPolicy
    taken: bool
    before: float
    after: float
    worse: float
    words: str


def from_rest(process: Process, set_point: Tensor, load: Tensor, generator: torch.Generator) -> Scenarios:
    """Episodes of whatever stands for the plant, from its steady state; set points (T, K, n_y) and loads (T, K, n_u)."""
    n_steps, n_episodes, _ = set_point.shape
    sizes = (n_steps, n_episodes, process.n_disturbances), (n_steps + 1, n_episodes, process.n_outputs)
    noise = [torch.randn(size, generator=generator, dtype=set_point.dtype) for size in sizes]
    start, before = set_point.new_zeros(n_episodes, process.n_states), set_point.new_zeros(n_episodes, process.n_inputs)
    return Scenarios(process, set_point, load, start, before, *noise)


def plant_episodes(workshop: Workshop, process: Process, n_episodes: int, generator: torch.Generator) -> Scenarios:
    """Episodes of the plant at its steady state, with set points of the range that its nominal model can hold, and a load step."""
    drawn = workshop.draw(workshop.nominal, n_episodes, generator)
    return from_rest(process, drawn.set_point, drawn.load, generator)


def gentle(workshop: Workshop, policy: TrackingPolicy, generator: torch.Generator) -> Tensor:
    """The disturbance of the inputs, (n_u,): the given one, halved until few episodes are worse than the record's PID's.

    They are rehearsed on the model; few are half of the allowed share, since the plant is not the model.
    """
    operation, params = workshop.operation, workshop.plant.params.online
    rehearsal, size = plant_episodes(workshop, workshop.nominal, REHEARSED, generator), params.disturbance * operation.bounds.span
    recorded, _ = operation.figures(workshop.record, rehearsal)
    for _ in range(HALVINGS):
        error, _ = operation.figures(Exploring(policy, size, generator), rehearsal)
        if (error > recorded).double().mean() <= params.worse / 2:
            break
        size = size / 2
    return size


def improve_on_plant(workshop: Workshop, identified: Identified, policy: TrackingPolicy, process: Process) -> Improvement:
    """`explore` + 2 `test` episodes of the plant; the policy that is given stays unless a paired test finds a better one."""
    plant, operation, params = workshop.plant, workshop.operation, workshop.plant.params.online
    generator = plant.stream("plant episodes")
    explored = plant_episodes(workshop, process, params.explore, generator)
    run = operation.run(Exploring(policy, gentle(workshop, policy, plant.stream("rehearsal")), generator), explored)
    recorded, _ = operation.figures(workshop.record, explored)
    worse = (operation.error(run) > recorded).double().mean().item()
    pieces = [Stretch(y.double().numpy(), u.double().numpy()) for y, u in zip(run.y[:-1].unbind(1), run.u.unbind(1), strict=True)]
    parts = pieces[: len(pieces) * 3 // 4], pieces[len(pieces) * 3 // 4 :]
    names, settings = (plant.controlled, plant.manipulated), plant.params.identification
    again = identify(parts, identified.scales, names, settings, len(identified.members), plant.seed)
    # What was unknown of the plant has been seen by now; half of the declared margins stays.
    margins = plant.params.margins
    narrow = margins.model_copy(update={"gain": margins.gain / 2, "time": margins.time / 2, "dead_time": 0})
    # Models of the plant under this policy flatter its movement a little.
    careful = plant.params.policy.model_copy(update={"movement": CAREFUL * plant.params.policy.movement})
    informed = replace(plant, params=plant.params.model_copy(update={"margins": narrow, "policy": careful}))
    new, _ = learn_policy(replace(open_workshop(informed, again), record=workshop.record, operation=operation), policy, "online")
    fresh = plant_episodes(workshop, process, params.test, generator)
    errors, moved = zip(*(operation.figures(each, fresh) for each in (workshop.record, policy, new)), strict=True)
    reference, before, after = (error.double() for error in errors)
    before, after = before / reference, after / reference
    p_value = float(ttest_rel(after.numpy(), before.numpy(), alternative="less").pvalue)
    allowed = plant.params.policy.movement * moved[0].double().mean().item()
    taken = p_value < params.level and moved[2].double().mean().item() <= allowed
    old, since = before.mean().item(), after.mean().item()
    words = (
        f"{params.explore + 2 * params.test} episodes of the plant: {100 * worse:.0f} % of the exploring ones worse than the "
        f"record's PID; the policy learned after them {'takes over' if taken else 'does not take over'} ({100 * since:.0f} against "
        f"{100 * old:.0f} % of the record's PID's mean |e| in a paired test, p = {p_value:.2g})"
    )
    return Improvement(new if taken else policy, taken, old, since, worse, words)


def at_set_points(workshop: Workshop, process: Process, candidates: Mapping[str, Tracker], n_repeats: int) -> pd.DataFrame:
    """Steps from rest to set points all over the range on whatever stands for the plant, a row a set point and controller.

    Returns:
        Columns: the set point of each loop (engineering units), controller, mean |e| (in units of half the range), movement (as a
        share of the input ranges, summed over an episode), and offset: the mean error over the last fifth, as a share of the range,
        of the worst loop.
    """
    operation, dtype, loops = workshop.operation, workshop.operation.unit.dtype, list(workshop.operation.loops)
    places = torch.cartesian_prod(*[torch.tensor(PLACES, dtype=dtype)] * len(loops)).reshape(-1, len(loops))
    set_points = torch.zeros(len(places), len(operation.low), dtype=dtype)
    set_points[:, loops] = operation.low[loops] + places * (operation.high - operation.low)[loops]
    n_steps = workshop.n_steps
    aimed = set_points.repeat_interleave(n_repeats, 0).expand(n_steps, -1, -1)
    no_load = aimed.new_zeros(n_steps, aimed.shape[1], process.n_inputs)
    scenarios = from_rest(process, aimed, no_load, workshop.plant.stream("set points"))
    steady, rows = workshop.plant.description.steady("controlled", dtype), []
    for name, tracker in candidates.items():
        run = operation.run(tracker, scenarios)
        error, moved = (part.reshape(-1, n_repeats).mean(1) for part in (operation.error(run), n_steps * operation.movement(run)))
        late = (run.error[-n_steps // 5 :] / operation.reach)[..., loops].mean(0)
        late = late.reshape(-1, n_repeats, len(loops)).mean(1).abs().amax(-1)
        for point, *values in zip(set_points + steady, error, moved, late, strict=True):
            aims = {workshop.plant.controlled[index]: point[index].item() for index in loops}
            rows.append({**aims, "controller": name, **dict(zip(FIGURES, (float(value) for value in values), strict=True))})
    return pd.DataFrame(rows)
