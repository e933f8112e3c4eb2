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

from helpers.learning.algorithm_1 import improve_online
from helpers.learning.algorithm_2 import Apprenticeship, algorithm_2, initial_weights
from helpers.learning.evaluation import scores
from helpers.learning.features import FeatureMap, feature_names
from helpers.learning.learner import EpochRecord, Learner
from helpers.learning.policy import LSTMPolicy, PolicyController
from helpers.own_plant.description import PlantDescription, load_description
from helpers.own_plant.episodes import Episodes, episodes, stretches
from helpers.own_plant.identify import Identified, Validation, hold_out, identify, thin_out, validate_model
from helpers.own_plant.model import LinearModel
from helpers.own_plant.quality import CleanRecords, examine
from helpers.own_plant.records import read_records
from helpers.own_plant.settings import OwnPlantParams, load_own_plant
from helpers.plant.controllers import Controller
from helpers.plant.process import Process
from helpers.plant.rollout import rollout, stream
from helpers.plant.task import ControlTask, Trajectories
from helpers.runs.progress import ProgressBar
from helpers.settings.paper import FeatureParams, LearningParams, Params, ScaleParams, load

PIECE = 5  # episodes: how long the pieces of a long record are that the model is identified from
VARIANT = "improved"  # of Algorithms 1 and 2


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
    """A linear model from the first part of the record, judged on its last part."""
    description, params = plant.description, plant.params.identification
    pieces = stretches(plant.clean, description, max(params.lags) + 1)
    first, last = hold_out(pieces, params.held_out)
    scales = (
        np.array([abs(variable.scale) for variable in description.controlled]),
        np.array([(variable.high - variable.low) / 2 for variable in description.manipulated]),
    )
    training = thin_out(first, params.longest, PIECE * description.horizon)
    names = (plant.controlled, plant.manipulated)
    identified = identify(training, scales, names, params, plant.epochs(params.iterations))
    held_out = thin_out(last, params.longest, PIECE * description.horizon)
    return identified, validate_model(identified, held_out, description.horizon, plant.controlled, params)


def task_on(plant: OwnPlant, model: LinearModel) -> ControlTask:
    """The task on an identified model: its first state is where the demonstrations began, at rest."""
    y, before = plant.demonstrations.trajectories.y[0].double(), plant.demonstrations.before.double()
    std = (y.var(0) - model.noise.double() ** 2).clamp(min=0).sqrt()
    lags = -(-(model.n_states - model.n_outputs) // (model.n_outputs + model.n_inputs))
    means = [y.mean(0)] * (lags + 1) + [before.mean(0)] * lags
    stds = [std] * (lags + 1) + [before.std(0)] * lags
    return plant.task(torch.cat(means), torch.cat(stds))


def task_at_rest(plant: OwnPlant, process: Process) -> ControlTask:
    """The task on a process whose states are its outputs, begun where the demonstrations began."""
    y = plant.demonstrations.trajectories.y[0]
    if process.n_states == process.n_outputs:
        return plant.task(y.mean(0), y.std(0))
    return plant.task(torch.zeros(process.n_states), torch.zeros(process.n_states))  # of other states nothing is known but u* = 0


def learn_offline(
    plant: OwnPlant, process: Process, task: ControlTask, start: tuple[LSTMPolicy, Tensor] | None = None
) -> Apprenticeship:
    """Algorithm 2 on whatever stands for the plant; from the policy and the weights of another task, if given."""
    variant, learning, scale = plant.learning.variants[VARIANT], plant.params.learning, plant.scale
    n_epochs = plant.epochs(learning.offline_epochs if start is None else learning.transfer_epochs)
    policy = plant.fresh_policy(task) if start is None else start[0]
    weights = initial_weights(variant.weights, len(plant.controlled), plant.dtype) if start is None else start[1]
    policy.reset_exploration(variant.exploration)
    features = plant.features(task)
    generator = plant.stream("offline" if start is None else "transfer")
    learner = Learner(policy, process, features, variant.learner, scale.episodes, n_epochs, generator)
    expert = features.trajectory(plant.demonstrations.trajectories).mean(0)
    progress = ProgressBar(n_epochs, "offline")
    return algorithm_2(learner, expert, weights, variant.weights, n_epochs, scale.measured, progress)


def improve_on(plant: OwnPlant, policy: LSTMPolicy, process: Process, task: ControlTask) -> tuple[LSTMPolicy, list[EpochRecord]]:
    """Online learning under the tracking objective on whatever stands for the plant, read from y."""
    online, learning = plant.learning.online, plant.params.learning
    n_epochs = [plant.epochs(number) for number in learning.online_epochs]
    policy.reset_exploration(online.exploration)
    n_episodes = min(online.episodes, plant.scale.episodes + plant.scale.measured)
    learner = Learner(policy, process, plant.features(task), online.learner, n_episodes, sum(n_epochs), plant.stream("online"))
    records = improve_online(learner, n_epochs, learning.online_beta, ProgressBar(sum(n_epochs), "online"))
    return learner.average, records


def compare(
    plant: OwnPlant, process: Process, task: ControlTask, controllers: Mapping[str, Controller | LSTMPolicy]
) -> dict[str, Trajectories]:
    """Fresh trajectories of each controller on the same disturbances; a policy is deployed with its mode."""
    return {
        name: rollout(
            process,
            PolicyController(controller, task, exploring=False) if isinstance(controller, LSTMPolicy) else controller,
            task,
            plant.scale.evaluation,
            plant.stream("evaluation"),
        )
        for name, controller in controllers.items()
    }


def as_measured(trajectories: Trajectories) -> Trajectories:
    """The same with the observations in the place of the states, which a plant does not show."""
    return replace(trajectories, x=trajectories.y)


def judge(plant: OwnPlant, task: ControlTask, batches: Mapping[str, Trajectories]) -> pd.DataFrame:
    """Figures of merit of each batch on the observations, a column each; `gap` is the feature gap to the demonstrations."""
    features, beta = plant.features(task), plant.params.learning.online_beta[-1]
    expert = features.trajectory(plant.demonstrations.trajectories).mean(0)
    columns: dict[str, dict[str, Any]] = {}
    for name, batch in batches.items():
        rows = scores(as_measured(batch), features, beta, plant.controlled, plant.manipulated)
        mean = features.trajectory(batch).mean(0)
        gap = ((expert - mean) / expert.abs()).abs().mean().item()
        kept = {key: value for key, value in rows.items() if not key.endswith(":std") and key not in ("objective_x", "objective_y")}
        columns[name] = kept | {"feature gap": gap}
    return pd.DataFrame(columns)


@dataclass(frozen=True)
class Transfer:
    """Policy and weights carried to other set points: the plant with that task, the policy after each step, and the task."""

    plant: OwnPlant
    offline: Apprenticeship
    online: LSTMPolicy
    task: ControlTask


def transfer(
    plant: OwnPlant, learned: Apprenticeship, model: LinearModel, process: Process, set_points: Mapping[str, float]
) -> Transfer:
    """Section 5.3 on records: offline on the demonstrations of other set points, online on what stands for the plant.

    Args:
        set_points: in engineering units, by name of the controlled variable.
    """
    other = plant.with_set_points(set_points)
    start = copy.deepcopy(learned.policy), learned.weights
    offline = learn_offline(other, model, task_on(other, model), start)
    task = task_at_rest(other, process)
    online, _ = improve_on(other, copy.deepcopy(offline.policy), process, task)
    return Transfer(other, offline, online, task)


def parameter_table(plant: OwnPlant, identified: Identified) -> pd.DataFrame:
    """A, B and c of the identified model with their standard errors, scaled; a row for each output."""
    before = [*(f"A {name}" for name in plant.controlled), *(f"B {name}" for name in plant.manipulated)]
    lagged = [f"{name} at lag {lag}" for kind in "AB" for lag in range(identified.lags) for name in before if name.startswith(kind)]
    columns = [*(before if identified.lags == 1 else lagged), "c"]
    values = pd.DataFrame(identified.parameters, index=plant.controlled, columns=columns)
    errors = pd.DataFrame(identified.errors, index=plant.controlled, columns=columns)
    return pd.concat({"value": values.T, "standard error": errors.T}, axis=1)


def history(records: Sequence[Any], names: Sequence[str]) -> pd.DataFrame:
    """Records of learning as a table; the weights become one column a feature, `alpha:<feature>`."""
    rows = []
    for record in records:
        row = dict(vars(record))
        weights = row.pop("weights", ())
        rows.append(row | {f"alpha:{name}": value for name, value in zip(names, weights, strict=False)})
    return pd.DataFrame(rows)
