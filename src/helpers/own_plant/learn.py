"""From a historian file to a policy: read, identify, learn offline, improve online, transfer, compare.

The learning is that of the paper's plant; what differs is that a plant shows y alone, so that the features are on y.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from helpers.learning.algorithm_2 import Apprenticeship, algorithm_2, initial_weights
from helpers.learning.features import FeatureMap, feature_names
from helpers.learning.learner import Learner
from helpers.learning.model_gradient import Descent, GradientRecord, model_gradient
from helpers.learning.policy import LSTMPolicy
from helpers.learning.tracking_policy import Gains, TrackingPolicy, VelocityPID
from helpers.own_plant.description import PlantDescription, load_description
from helpers.own_plant.episodes import Episodes, episodes, stretches
from helpers.own_plant.gate import Verdict, judge
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
from helpers.plant.tracking import Scenarios, Tracked, Tracker, track
from helpers.runs.progress import ProgressBar
from helpers.settings.leaf import InputError
from helpers.settings.paper import FeatureParams, LearningParams, Params, ScaleParams, load

PIECE = 5  # episodes: how long the pieces of a long record are that the model is identified from
VARIANT = "improved"  # of Algorithms 1 and 2
HELD, FEWEST = 2.0, 0.1  # |e| in units of the range that a loop which is held never exceeds; least share of such models
SLACK, BEYOND = 0.95, 10.0  # share of the allowed movement that is aimed at, and the price of more while the rivals are tuned


@dataclass(frozen=True)
class OwnPlant:
    """A plant, its clean record, its demonstrations of one task, and how to learn from them."""

    description: PlantDescription
    params: OwnPlantParams
    learning: LearningParams
    feature_params: FeatureParams
    scale: ScaleParams
    seed: int
    clean: CleanRecords
    demonstrations: Episodes

    @property
    def dtype(self) -> torch.dtype:
        """The number type of the scale."""
        return getattr(torch, self.scale.number_type)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Names of the controlled variables."""
        return tuple(variable.name for variable in self.description.controlled)

    @property
    def manipulated(self) -> tuple[str, ...]:
        """Names of the manipulated variables."""
        return tuple(variable.name for variable in self.description.manipulated)

    @property
    def feature_names(self) -> list[str]:
        """Names of the features in their order."""
        return feature_names(self.controlled)

    def task(self, initial_mean: Tensor, initial_std: Tensor) -> ControlTask:
        """The control task, for a process whose first state is distributed so."""
        return self.description.task(initial_mean, initial_std, self.dtype)

    def features(self, task: ControlTask) -> FeatureMap:
        """The features, on y."""
        return FeatureMap(self.feature_params, task, self.description.sampling_time)

    def epochs(self, full: int) -> int:
        """How many of the full number of epochs this scale runs."""
        return max(1, round(full * self.scale.epoch_share))

    def stream(self, *purpose: str) -> torch.Generator:
        """The random stream for one purpose."""
        return stream(self.seed, "own plant", *purpose)

    def fresh_policy(self, task: ControlTask) -> LSTMPolicy:
        """An untrained policy."""
        unit = tuple((self.params.learning.error_unit * task.error_scale.abs()).tolist())
        return LSTMPolicy.initial(self.learning.policy.model_copy(update={"error_unit": unit}), task, self.stream("policy"))

    def with_set_points(self, set_points: Mapping[str, float]) -> "OwnPlant":
        """The same plant and record with the task and the demonstrations of other set points."""
        description = self.description.with_set_points(dict(set_points))
        return replace(
            self, description=description, demonstrations=episodes(self.clean, description, self.params.quality, self.dtype)
        )


def open_plant(path: Path, params_root: Path, scale: str, seed: int, params: Params | None = None) -> OwnPlant:
    """Read a plant's description and its historian file, and find its demonstrations.

    Raises:
        InputError: in one sentence, if the files cannot be used.
    """
    description, own = load_description(path), load_own_plant(params_root)
    params = params or load(params_root, 1)
    records = read_records(path.parent / description.data, description)
    clean = examine(records, description, own.quality)
    scale_params = params.learning.scales[scale]
    return OwnPlant(
        description=description,
        params=own,
        learning=params.learning,
        feature_params=params.features.model_copy(update={"features_on": "y"}),
        scale=scale_params,
        seed=seed,
        clean=clean,
        demonstrations=episodes(clean, description, own.quality, getattr(torch, scale_params.number_type)),
    )


def identify_plant(plant: OwnPlant) -> tuple[Identified, Validation]:
    """Models from the record; order and dead times, and the fit that is shown, are judged on its last part.

    Raises:
        InputError: if no stable model describes the record.
    """
    description, params = plant.description, plant.params.identification
    first, last = hold_out(stretches(plant.clean, description, 2), params.held_out)
    scales = (
        np.array([abs(variable.scale) for variable in description.controlled]),
        np.array([(variable.high - variable.low) / 2 for variable in description.manipulated]),
    )
    training, held_out = (thin_out(part, params.longest, PIECE * description.horizon) for part in (first, last))
    names = (plant.controlled, plant.manipulated)
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
    return plant.task(torch.cat(means), torch.cat(stds))


def learn_offline(plant: OwnPlant, process: Process, task: ControlTask) -> Apprenticeship:
    """Algorithm 2 on whatever stands for the plant: what the record's controller was after, as weights, and a policy like it."""
    variant, scale = plant.learning.variants[VARIANT], plant.scale
    n_epochs = plant.epochs(plant.params.learning.offline_epochs)
    weights = initial_weights(variant.weights, len(plant.controlled), plant.dtype)
    policy, features = plant.fresh_policy(task), plant.features(task)
    policy.reset_exploration(variant.exploration)
    learner = Learner(policy, process, features, variant.learner, scale.episodes, n_epochs, plant.stream("offline"))
    expert = features.trajectory(plant.demonstrations.trajectories).mean(0)
    return algorithm_2(learner, expert, weights, variant.weights, n_epochs, scale.measured, ProgressBar(n_epochs, "offline"))


@dataclass(frozen=True)
class Workshop:
    """Everything that controllers are tuned, trained and judged on; float32, as they run.

    Attributes:
        operation: the range of set points, the loops and the bounds. record: the PID of the record, and `explained` of its moves.
        nominal: the most likely model. training, held_out: models drawn for learning and for the gate, from different members.
    """

    plant: OwnPlant
    operation: Operation
    record: Gains
    explained: float
    nominal: ArmaxModel
    training: ArmaxModel
    held_out: ArmaxModel

    @property
    def n_steps(self) -> int:
        """Samples of an episode: long enough for two set point steps."""
        shortest, longest = self.plant.params.operation.samples
        return min(max(2 * self.plant.description.horizon, shortest), longest)

    def draw(
        self, models: ArmaxModel, n_episodes: int, generator: torch.Generator, longer: int = 1, quiet: bool = False
    ) -> Scenarios:
        """Episodes of models drawn from these; `longer` than those of training by this factor."""
        drawn = models.members(torch.randint(len(models), (n_episodes,), generator=generator))
        return draw_scenarios(drawn, self.operation, self.plant.params.operation, longer * self.n_steps, generator, quiet)

    def reference(self, scenarios: Scenarios) -> tuple[Tensor, Tensor]:
        """Mean |e| and movement of the record's PID in each episode, (K,) each."""
        with torch.no_grad():
            run = track(VelocityPID(self.record), scenarios, self.operation.bounds)
        return self.operation.error(run), self.operation.movement(run)


def open_workshop(plant: OwnPlant, identified: Identified) -> Workshop:
    """Draw the models, find the record's PID and the range of operation; models on which that PID runs away are left out.

    Raises:
        InputError: if the record's controller is no PID and the description names none.
    """
    dtype, params, clean, description = torch.float32, plant.params, plant.clean, plant.description
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
        replace(identified, members=part).ensemble(params.margins, n_models, plant.seed + k).to(dtype)
        for k, part in enumerate((members[:edge], members[edge:]))
    )
    whole = operation(clean, description, loops, dtype)
    workshop = Workshop(plant, whole, record, explained, identified.nominal.to(dtype), training, held_out)
    return replace(workshop, training=plausible(workshop, training), held_out=plausible(workshop, held_out))


def plausible(workshop: Workshop, models: ArmaxModel) -> ArmaxModel:
    """The models that the record's PID can hold, since the record shows that it holds the plant; all, if it can hold few."""
    generator = workshop.plant.stream("plausible")
    quiet = draw_scenarios(models, workshop.operation, workshop.plant.params.operation, 3 * workshop.n_steps, generator, quiet=True)
    with torch.no_grad():
        run = track(VelocityPID(workshop.record), quiet, workshop.operation.bounds)
    late = (run.error[-workshop.n_steps :].abs() / workshop.operation.unit)[..., list(workshop.operation.loops)].amax((0, 2))
    held = late < HELD
    return models.members(held) if held.double().mean() > FEWEST else models


def tune(workshop: Workshop) -> tuple[Gains, PredictiveControl]:
    """The rivals: the record's PID re-tuned, and predictive control, each at its best on the models of training."""
    plant, params = workshop.plant, workshop.plant.params.rivals
    scenarios = workshop.draw(workshop.training, params.episodes, plant.stream("rivals"))
    reference = workshop.reference(scenarios)

    def price(error: Tensor, movement: Tensor) -> Tensor:
        beyond = (movement.mean(-1) / reference[1].mean() / plant.params.policy.movement - SLACK).clamp(min=0)
        return (error / reference[0]).mean(-1) + BEYOND * beyond

    generations = params.model_copy(update={"generations": plant.epochs(params.generations)})
    gains = tuned_pid(workshop.nominal, scenarios, workshop.record, workshop.operation, price, generations, plant.seed)
    return gains, tuned_predictive(workshop.nominal, scenarios, workshop.operation, price, params)


def learn_policy(
    workshop: Workshop, start: Gains | TrackingPolicy, purpose: str = "policy"
) -> tuple[TrackingPolicy, list[GradientRecord]]:
    """One policy for the whole range, by the gradient through the models; it begins as the PID or the policy `start`."""
    plant, operation = workshop.plant, workshop.operation
    params, generator = plant.params.policy, plant.stream(purpose)
    torch.manual_seed(
        int(torch.randint(2**31, (1,), generator=generator))
    )  # torch.nn draws the first weights from the global stream
    policy = (
        TrackingPolicy(plant.learning.policy, start, operation.unit, operation.centre, operation.unit, operation.bounds)
        if isinstance(start, Gains)
        else copy.deepcopy(start)
    )

    def measure(scenarios: Scenarios, run: Tracked) -> tuple[Tensor, Tensor]:
        error, movement = workshop.reference(scenarios)
        return operation.error(run) / error, operation.movement(run) / movement / params.movement

    descent = Descent(plant.epochs(params.steps))
    records = model_gradient(
        policy, lambda: workshop.draw(workshop.training, params.episodes, generator), measure, operation.bounds, descent,
        ProgressBar(descent.steps, purpose),
    )  # fmt: skip
    return policy, records


def pass_gate(workshop: Workshop, candidates: Mapping[str, Tracker]) -> Verdict:
    """All candidates on models held out, in episodes twice as long as those of training."""
    params, generator = workshop.plant.params, workshop.plant.stream("gate")
    noisy, quiet = (
        workshop.draw(workshop.held_out, params.gate.episodes, generator, longer=2, quiet=still) for still in (False, True)
    )
    return judge(candidates, noisy, quiet, workshop.operation, params.policy.movement, params.gate)


def parameter_table(plant: OwnPlant, identified: Identified) -> pd.DataFrame:
    """What was identified, a row an output: order, dead times, gains or rates, and the spread of the innovations; scaled."""
    rows = {}
    for name, equation in zip(plant.controlled, identified.equations, strict=True):
        structure = equation.structure
        kind = "rate" if structure.integrating else "gain"
        free = 1 - equation.parameters[: structure.n_own].sum()
        row: dict[str, Any] = {"order": structure.order, "integrating": structure.integrating}
        for j, entry in enumerate(plant.manipulated):
            row |= {f"dead time of {entry}": structure.dead_times[j], f"{kind} of {entry}": equation.inputs[j].sum() / free}
        rows[name] = row | {"noise": equation.spread[0], "noise, share of y": equation.spread[1]}
    return pd.DataFrame(rows).T


def history(records: Sequence[Any], names: Sequence[str]) -> pd.DataFrame:
    """Records of learning as a table; the weights become one column a feature, `alpha:<feature>`."""
    rows = []
    for record in records:
        row = dict(vars(record))
        weights = row.pop("weights", ())
        rows.append(row | {f"alpha:{name}": value for name, value in zip(names, weights, strict=False)})
    return pd.DataFrame(rows)
