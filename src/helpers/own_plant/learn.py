"""From a historian file to a policy for the range of the record: read, identify, tune the rivals, learn, pass the gate."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from helpers.learning.algorithm_2 import Apprenticeship
from helpers.learning.model_gradient import Descent, GradientRecord, model_gradient
from helpers.learning.tracking_policy import Gains, TrackingPID, TrackingPolicy
from helpers.own_plant import gate
from helpers.own_plant.description import PlantDescription, load_description
from helpers.own_plant.episodes import Episodes, episodes, set_point_moves, stretches
from helpers.own_plant.identify import Identified, Validation, hold_out, identify, thin_out, validate_model
from helpers.own_plant.model import ArmaxModel
from helpers.own_plant.operation import Operation, described_gains, draw_scenarios, operation, recorded_gains
from helpers.own_plant.quality import CleanRecords, examine
from helpers.own_plant.records import read_records
from helpers.own_plant.rivals import PredictiveControl, tuned_pid, tuned_predictive
from helpers.own_plant.settings import OwnPlantParams, load_own_plant
from helpers.plant.process import Process
from helpers.plant.rollout import stream
from helpers.plant.task import ControlTask
from helpers.plant.tracking import Scenarios, Tracked, Tracker
from helpers.runs.progress import ProgressBar
from helpers.runs.study import Demonstrations, Study
from helpers.settings.leaf import InputError
from helpers.settings.paper import Params, ScaleParams, load

PIECE = 5  # episodes: how long the pieces of a long record are that the model is identified from
HELD, FEWEST = 0.2, 0.25  # |e| in units of the range within which a loop that is held settles; least share of such models
AT_ENDS = 0.3  # share of the models of training at the ends of the declared margins
HARM = 20.0  # how many times more an error counts that goes beyond that of the record's PID
SLACK, BEYOND = 0.95, 10.0  # share of the allowed movement that is aimed at, and the price of more while the rivals are tuned


@dataclass(frozen=True)
class OwnPlant:
    """A plant, its clean record, and how to learn from it.

    Attributes:
        params: of params/own_plant.yaml. base: of the paper's learning, which is used as it is. scale: how much is computed.
    """

    description: PlantDescription
    params: OwnPlantParams
    base: Params
    scale: ScaleParams
    seed: int
    clean: CleanRecords

    @cached_property
    def demonstrations(self) -> Episodes:
        """Those of the task of the description; only Algorithm 2 needs them.

        Raises:
            InputError: if the record has too few.
        """
        return episodes(self.clean, self.description, self.params.quality, self.dtype)

    @property
    def dtype(self) -> torch.dtype:
        """The number type of the scale."""
        return getattr(torch, self.scale.number_type)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Names of the controlled variables."""
        return self.description.names("controlled")

    @property
    def manipulated(self) -> tuple[str, ...]:
        """Names of the manipulated variables."""
        return self.description.names("manipulated")

    def epochs(self, full: int) -> int:
        """How many of the full number of epochs this scale runs."""
        return max(1, round(full * self.scale.epoch_share))

    def stream(self, *purpose: str) -> torch.Generator:
        """The random stream for one purpose."""
        return stream(self.seed, "own plant", *purpose)

    def study(self, process: Process, task: ControlTask) -> Study:
        """The paper's offline learning on whatever stands for the plant, with the features on y, the one signal that it shows."""
        base, own = self.base, self.params.learning
        unit = tuple((own.error_unit * task.error_scale.abs()).tolist())
        names = {"controlled": self.controlled, "manipulated": self.manipulated, "sampling_time": self.description.sampling_time}
        policy = base.learning.policy.model_copy(update={"error_unit": unit})
        params = replace(base, learning=base.learning.model_copy(update={"policy": policy}))
        study = Study(params=params, scale_params=self.scale, seed=self.seed, case="own plant", own=(process, task))
        return study.varied(process=names, features={"features_on": "y"}, offline={"epochs": own.offline_epochs})


def open_plant(path: Path, params_root: Path, scale: str, seed: int, params: Params | None = None) -> OwnPlant:
    """Read a plant's description and its historian file.

    Raises:
        InputError: in one sentence, if the files cannot be used.
    """
    description, own = load_description(path), load_own_plant(params_root)
    base = params or load(params_root, 1)
    clean = examine(read_records(path.parent / description.data, description), description, own.quality)
    set_point_moves(clean, description, own.quality)
    return OwnPlant(description, own, base, base.learning.scales[scale], seed, clean)


def identify_plant(plant: OwnPlant) -> tuple[Identified, Validation]:
    """Models from the record; order and dead times, and the fit that is shown, are judged on its last part.

    Raises:
        InputError: if no stable model describes the record.
    """
    description, params = plant.description, plant.params.identification
    first, last = hold_out(stretches(plant.clean, description, 2), params.held_out)
    half = (description.values("manipulated", "high") - description.values("manipulated", "low")) / 2
    scales, names = (abs(description.values("controlled", "scale")), half), (plant.controlled, plant.manipulated)
    training, held_out = (thin_out(part, params.longest, PIECE * description.horizon) for part in (first, last))
    identified = identify((training, held_out), scales, names, params, max(4, plant.epochs(params.members)), plant.seed)
    return identified, validate_model(identified, held_out, description.horizon, plant.controlled, params)


def task_on(plant: OwnPlant, model: ArmaxModel) -> ControlTask:
    """The task on an identified model: its first state is where the demonstrations began, at rest."""
    y, before = plant.demonstrations.trajectories.y[0].double(), plant.demonstrations.before.double()
    spread = model.spread[0, :, 0].double()
    std = (y.var(0) - spread**2).clamp(min=0).sqrt()
    zero = torch.zeros_like(std).repeat(model.lags)
    means = [y.mean(0).repeat(model.lags), before.mean(0).repeat(model.taps - 1), zero]
    stds = [std.repeat(model.lags), before.std(0).repeat(model.taps - 1), zero]
    return plant.description.task(torch.cat(means), torch.cat(stds), plant.dtype)


def learn_offline(plant: OwnPlant, process: Process, task: ControlTask) -> tuple[Study, Apprenticeship]:
    """Algorithm 2 on whatever stands for the plant: what the record's controller was after, as weights, and a policy like it."""
    study = plant.study(process, task)
    return study, study.imitate(Demonstrations(plant.demonstrations.trajectories, pd.Series(dtype=float)), study.fresh_policy())


@dataclass(frozen=True)
class Workshop:
    """Everything that controllers are tuned, trained and judged on.

    Attributes:
        operation: the range of set points, the loops and the bounds. record: its PID.
        explained: share of the moves of the inputs that a PID fitted to the record explains.
        nominal: the most likely model. training, held_out: models drawn for learning and for the gate, from different members.
        corners: the most likely model at the ends of the declared margins.
    """

    plant: OwnPlant
    operation: Operation
    record: Gains
    explained: float
    nominal: ArmaxModel
    training: ArmaxModel
    held_out: ArmaxModel
    corners: ArmaxModel

    @property
    def n_steps(self) -> int:
        """Samples of an episode: long enough for two set point steps."""
        shortest, longest = self.plant.params.operation.samples
        return min(max(2 * self.plant.description.horizon, shortest), longest)

    def draw(
        self, models: ArmaxModel, n_models: int, generator: torch.Generator, longer: int = 1, each: int = 1, quiet: bool = False
    ) -> Scenarios:
        """`each` episodes of models drawn from these, after each other; `longer` than those of training by this factor."""
        drawn = models.members(torch.randint(len(models), (n_models,), generator=generator).repeat_interleave(each))
        return draw_scenarios(drawn, self.operation, self.plant.params.operation, longer * self.n_steps, generator, quiet)


def open_workshop(plant: OwnPlant, identified: Identified) -> Workshop:
    """Draw the models, find the record's PID and the range of operation; models on which that PID runs away are left out.

    Raises:
        InputError: if the record's controller is no PID and the description names none.
    """
    dtype, params, clean, description = plant.dtype, plant.params, plant.clean, plant.description
    found, explained = recorded_gains(clean, description, dtype)
    record = described_gains(description, dtype) or found
    loops = tuple(torch.nonzero(record.integral.abs().sum(0) > 0).flatten().tolist())
    if not loops:
        raise InputError(
            f"{description.title}: no loop with integral action is found in the record: describe its controller under 'pid'"
        )
    members, edge = identified.members, max(1, len(identified.members) * 3 // 4)
    n_models = max(16, plant.epochs(params.policy.models))
    training, held_out = (
        replace(identified, members=part).ensemble(params.margins, n_models, plant.seed + k, at_ends).to(dtype)
        for k, (part, at_ends) in enumerate(((members[:edge], AT_ENDS), (members[edge:], 0.0)))
    )
    whole = operation(clean, description, loops, dtype)
    others = (identified.nominal.to(dtype), training, held_out, identified.corners(params.margins).to(dtype))
    workshop = Workshop(plant, whole, record, explained, *others)
    return replace(workshop, training=plausible(workshop, training), held_out=plausible(workshop, held_out))


def plausible(workshop: Workshop, models: ArmaxModel) -> ArmaxModel:
    """The models that the record's PID can hold, since the record shows that it holds the plant; all, if it can hold few."""
    plant, operation = workshop.plant, workshop.operation
    quiet = draw_scenarios(models, operation, plant.params.operation, 3 * workshop.n_steps, plant.stream("plausible"), quiet=True)
    late = operation.run(workshop.record, quiet).error[-workshop.n_steps :]
    held = (late.abs() / operation.unit)[..., list(operation.loops)].amax((0, 2)) < HELD
    return models.members(held) if held.double().mean() > FEWEST else models


def tune(workshop: Workshop) -> tuple[Gains, PredictiveControl]:
    """The rivals: the record's PID re-tuned, and predictive control, each at its best on the models of training."""
    plant, operation, params = workshop.plant, workshop.operation, workshop.plant.params.rivals
    scenarios = workshop.draw(workshop.training, params.episodes, plant.stream("rivals"))
    reference, moved = operation.figures(workshop.record, scenarios)

    def price(error: Tensor, movement: Tensor) -> Tensor:
        beyond = (movement.mean(-1) / moved.mean() / plant.params.policy.movement - SLACK).clamp(min=0)
        return (error / reference).mean(-1) + BEYOND * beyond

    generations = params.model_copy(update={"generations": plant.epochs(params.generations)})
    gains = tuned_pid(workshop.nominal, scenarios, workshop.record, operation, price, generations, plant.seed)
    return gains, tuned_predictive(workshop.nominal, scenarios, operation, price, params)


def learn_policy(
    workshop: Workshop, start: Gains | TrackingPolicy, purpose: str = "policy"
) -> tuple[TrackingPolicy, list[GradientRecord]]:
    """One policy for the whole range, by the gradient through the models; it begins as the PID or the policy `start`."""
    plant, operation = workshop.plant, workshop.operation
    params, generator = plant.params.policy, plant.stream(purpose)
    # torch.nn draws the first weights from the global stream.
    torch.manual_seed(int(torch.randint(2**31, (1,), generator=generator)))
    if isinstance(start, Gains):
        shown = operation.unit, operation.centre, operation.unit
        policy = TrackingPolicy(plant.base.learning.policy, start, *shown, operation.bounds)
    else:
        policy = copy.deepcopy(start)

    def measure(scenarios: Scenarios, run: Tracked) -> tuple[Tensor, Tensor]:
        error, movement = operation.figures(workshop.record, scenarios)
        share = operation.error(run) / error
        # The record's PID may rest at a bound in an episode: its mean movement is what the gate compares with too.
        return share + HARM * (share - 1).clamp(min=0), operation.movement(run) / movement.mean() / params.movement

    descent = Descent(plant.epochs(params.steps))
    records = model_gradient(
        policy, lambda: workshop.draw(workshop.training, params.episodes, generator), measure, operation.bounds, descent,
        ProgressBar(descent.steps, purpose),
    )  # fmt: skip
    return policy, records


def candidates(workshop: Workshop, tuned: Gains, predictive: PredictiveControl, policy: TrackingPolicy) -> dict[str, Tracker]:
    """The controllers between which the gate decides, by name."""
    bounds = workshop.operation.bounds
    pids = {gate.RECORD: TrackingPID(workshop.record, bounds), gate.TUNED: TrackingPID(tuned, bounds)}
    return pids | {gate.PREDICTIVE: predictive, gate.POLICY: policy}


def pass_gate(workshop: Workshop, controllers: Mapping[str, Tracker]) -> gate.Verdict:
    """All candidates on models held out, in several episodes of each, twice as long as those of training, and in the corners."""
    params, generator = workshop.plant.params, workshop.plant.stream("gate")
    n_models, each = params.gate.models, params.gate.episodes
    noisy = workshop.draw(workshop.held_out, n_models, generator, longer=2, each=each)
    quiet = workshop.draw(workshop.held_out, n_models, generator, longer=2, each=each, quiet=True)
    all_corners = workshop.corners.members(torch.arange(len(workshop.corners)).repeat_interleave(params.gate.corner_episodes))
    corners = draw_scenarios(all_corners, workshop.operation, params.operation, workshop.n_steps, generator)
    return gate.judge(controllers, (noisy, quiet, corners), workshop.operation, params.policy.movement, params.gate)


def parameter_table(plant: OwnPlant, identified: Identified) -> pd.DataFrame:
    """What was identified, a row an output: order, dead times, gains or rates, and the spread of the innovations; scaled."""
    rows = {}
    for name, equation in zip(plant.controlled, identified.equations, strict=True):
        structure = equation.structure
        kind = "rate" if structure.integrating else "gain"
        effects = equation.inputs.sum(1) / (1 - equation.free.sum())
        row: dict[str, Any] = {"order": structure.order, "integrating": structure.integrating}
        for entry, dead, effect in zip(plant.manipulated, structure.dead_times, effects, strict=True):
            row |= {f"dead time of {entry}": dead, f"{kind} of {entry}": effect}
        rows[name] = row | {"noise": equation.spread[0], "noise, share of y": equation.spread[1]}
    return pd.DataFrame(rows).T
