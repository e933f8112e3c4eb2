"""A case ready to run, the verbs of the notebooks (imitate, improve, judge), and the tables that are saved."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from helpers.learning.algorithm_1 import improve_online
from helpers.learning.algorithm_2 import Apprenticeship, IterationRecord, algorithm_2, initial_weights
from helpers.learning.evaluation import feature_gap, relative_gap, scores
from helpers.learning.features import FeatureMap, feature_names
from helpers.learning.learner import EpochRecord, Learner
from helpers.learning.policy import LSTMPolicy, PolicyController
from helpers.learning.tracking_policy import TrackingPolicy
from helpers.plant.controllers import PID, Controller, MinimumVariance
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import rollout, stream
from helpers.plant.task import ControlTask, Trajectories
from helpers.plant.tracking import AtSetPoint
from helpers.runs.finished import State
from helpers.runs.progress import ProgressBar
from helpers.settings.paper import HEADLINE, LearnerParams, Params, PublishedCase, ScaleParams, VariantParams


@dataclass(frozen=True)
class Demonstrations:
    """The recorded trajectories of the expert, and the expert's own figures of merit on many fresh ones."""

    trajectories: Trajectories
    scores: pd.Series

    def features(self, features: FeatureMap) -> Tensor:
        """v_E as the learner knows it: the mean over the recorded trajectories, shape (d,)."""
        return features.trajectory(self.trajectories).mean(0)

    def true_features(self, names: list[str]) -> Tensor:
        """v_E of the demonstrating controller on many fresh trajectories, to judge by, shape (d,)."""
        return torch.tensor([self.scores[f"v:{name}"] for name in names])


@dataclass(frozen=True)
class Improvement:
    """The result of online learning."""

    policy: LSTMPolicy
    records: tuple[EpochRecord, ...]


@dataclass(frozen=True, kw_only=True)
class Study:
    """A case ready to run: a process and its task, how a policy learns there, how much is computed, and the random numbers.

    Attributes:
        case: its number, or a name of your own: the first word of its random streams.
        own: process and task, where they are not those that the parameters describe. The parameters then tell the names of the
            variables, the sampling time, the features and the budgets of learning.
        published: the paper's table for this case; None for a case of your own.
    """

    params: Params
    scale_params: ScaleParams
    seed: int
    case: int | str
    variant: str = HEADLINE
    own: tuple[Any, ControlTask] | None = None
    published: PublishedCase | None = None

    # What the parameters describe --------------------------------------------------------------------------------------

    @property
    def dtype(self) -> torch.dtype:
        """The number type of the scale."""
        return getattr(torch, self.scale_params.number_type)

    @property
    def variant_params(self) -> VariantParams:
        """The settings of Algorithms 1 and 2."""
        return self.params.learning.variants[self.variant]

    @cached_property
    def process(self) -> LinearProcess:
        """The process of Eq. 4.1.3-4.1.4, or your own."""
        return self.own[0] if self.own else LinearProcess(self.params.process, self.dtype)

    @cached_property
    def task(self) -> ControlTask:
        """The control task, Table 1, or your own."""
        return self.own[1] if self.own else ControlTask.from_params(self.params.process, self.params.case, self.dtype)

    @cached_property
    def features(self) -> FeatureMap:
        """The features of this task."""
        return FeatureMap(self.params.features, self.task, self.params.process.sampling_time)

    @cached_property
    def expert(self) -> PID:
        """The demonstrating controller."""
        return PID(self.params.demonstrator, self.task.set_point, self.params.process.sampling_time)

    @cached_property
    def minimum_variance(self) -> MinimumVariance:
        """The reference for what is attainable: it knows the process and acts on the observation."""
        return MinimumVariance(self.process.state_step, self.process.input_step, self.task.set_point)

    @property
    def feature_names(self) -> list[str]:
        """Names of the features in their order."""
        return feature_names(self.params.process.controlled)

    def epochs(self, full: int) -> int:
        """How many of the paper's epochs this scale runs."""
        return max(1, round(full * self.scale_params.epoch_share))

    def online_epochs(self) -> list[int]:
        """How many epochs of each round of online learning this scale runs."""
        share = self.scale_params.online_share or self.scale_params.epoch_share
        return [max(1, round(full * share)) for full in self.params.case.online.epochs]

    def stream(self, *purpose: str) -> torch.Generator:
        """The random stream of this seed and case for one purpose."""
        return stream(self.seed, self.case, *purpose)

    def varied(self, **changes: Mapping[str, Any]) -> Self:
        """The same with entries of its parameters replaced: `case`, `offline`, `online`, `process` or `features`."""
        params = self.params
        new = {name: dict(changes.get(name, {})) for name in ("case", "offline", "online", "process", "features")}
        halves = {half: getattr(params.case, half).model_copy(update=new[half]) for half in ("offline", "online")}
        return replace(
            self,
            params=replace(
                params,
                case=params.case.model_copy(update=new["case"] | halves),
                process=params.process.model_copy(update=new["process"]),
                features=params.features.model_copy(update=new["features"]),
            ),
        )

    # Learning ----------------------------------------------------------------------------------------------------------

    def fresh_policy(self) -> LSTMPolicy:
        """An untrained policy."""
        params, scale = self.params.learning.policy, self.variant_params.initial_output_scale
        if scale is not None:
            params = params.model_copy(update={"initial_output_scale": scale})
        return LSTMPolicy.initial(params, self.task, self.stream("policy"))

    def learner(
        self,
        policy: LSTMPolicy,
        n_episodes: int,
        n_epochs: int,
        params: LearnerParams,
        generator: torch.Generator,
        features: FeatureMap | None = None,
    ) -> Learner:
        """A learner on this study's process; `features`: those of its rewards, if not the study's own."""
        return Learner(policy, self.process, features or self.features, params, n_episodes, n_epochs, generator)

    def online_learner(
        self,
        policy: LSTMPolicy,
        n_episodes: int,
        n_epochs: int,
        generator: torch.Generator,
        features_on: str = "x",
        from_scratch: bool = False,
    ) -> Learner:
        """A learner with the online settings of learning.yaml. The policy gets their exploration back; wider where untrained."""
        online = self.params.learning.online
        policy.reset_exploration(online.from_scratch if from_scratch else online.exploration)
        return self.learner(policy, n_episodes, n_epochs, online.learner, generator, self.features.on(features_on))

    def online_episodes(self, asked: int | None = None) -> int:
        """Plant episodes of an epoch of online learning: as many as asked for, or as in learning.yaml; fewer at smoke scale."""
        return min(asked or self.params.learning.online.episodes, self.scale_params.episodes + self.scale_params.measured)

    def once(self, train: Callable[[], State], *start: Any) -> State:
        """What a training gives; the run of a notebook keeps it, and does not repeat it after an interruption."""
        return train()

    def trained(self, train: Callable[[], State], learner: Learner, *more: Any) -> State:
        """`once` for a learner that has not begun; `more`: what the training starts from beside study and learner."""
        settings = (self.variant, vars(learner.features), learner.params, learner.n_episodes, learner.total_epochs)
        return self.once(train, *settings, learner.generator.get_state(), *learner.policy.state_dict().values(), *more)

    def apprentice(
        self, demonstrations: Demonstrations, policy: LSTMPolicy, start: Tensor | None = None, features: FeatureMap | None = None
    ) -> tuple[Learner, Tensor, Tensor, int]:
        """What Algorithm 2 begins with: the learner, v_E, alpha before the first iteration, and the number of iterations.

        Without `start` the weights begin at their signs. A policy that was trained before gets its initial exploration back.
        `features`: those to match, if not the study's own.
        """
        variant, offline = self.variant_params, self.params.case.offline
        n_epochs = self.epochs(offline.epochs)
        n_iterations = n_epochs if variant.weights.iterations == "epochs" else min(offline.iterations, n_epochs)
        if start is None:
            start = initial_weights(variant.weights, len(self.task.set_point), self.dtype)
        policy.reset_exploration(variant.exploration)
        generator = self.stream("offline", self.params.base(self.variant))
        n_episodes = min(variant.episodes or self.scale_params.episodes, self.scale_params.episodes)
        learner = self.learner(policy, n_episodes, n_epochs, variant.learner, generator, features)
        return learner, demonstrations.features(learner.features), start, n_iterations

    def imitate(
        self, demonstrations: Demonstrations, policy: LSTMPolicy, start: Tensor | None = None, features: FeatureMap | None = None
    ) -> Apprenticeship:
        """Offline learning: Algorithm 2 from a policy and weights; see `apprentice`. Notebook 02 shows its steps."""
        learner, v_expert, start, n_iterations = self.apprentice(demonstrations, policy, start, features)
        params, measured = self.variant_params.weights, self.scale_params.measured

        def train() -> State:
            bar = ProgressBar(learner.total_epochs, "offline")
            found = algorithm_2(learner, v_expert, start, params, n_iterations, measured, bar)
            records = [asdict(record) for record in found.records]
            return {"weights": found.weights, "policy": found.policy.state_dict(), "epoch": found.chosen_epoch, "records": records}

        kept = self.trained(train, learner, v_expert, start)
        records = (IterationRecord(**row | {"weights": tuple(row["weights"])}) for row in kept["records"])
        return Apprenticeship(kept["weights"], copied(policy, kept["policy"]), kept["epoch"], tuple(records))

    def improve(self, policy: LSTMPolicy, features_on: str, episodes: int | None = None, from_scratch: bool = False) -> Improvement:
        """Online learning: the case's rounds of Algorithm 1 under the tracking objective, read from x or from y.

        `episodes` an epoch, each a run of the plant, are those of the parameter files unless given. A policy that begins
        `from_scratch` explores further.
        """
        online = self.params.case.online
        epochs = self.online_epochs()
        generator = self.stream("online", self.variant, features_on)
        learner = self.online_learner(policy, self.online_episodes(episodes), sum(epochs), generator, features_on, from_scratch)

        def train() -> State:
            records = improve_online(learner, epochs, online.beta, ProgressBar(sum(epochs), f"online on {features_on}"))
            return {"policy": learner.average.state_dict(), "records": [asdict(record) for record in records]}

        kept = self.trained(train, learner, epochs, online.beta)
        return Improvement(copied(policy, kept["policy"]), tuple(EpochRecord(**row) for row in kept["records"]))

    # Judging -----------------------------------------------------------------------------------------------------------

    def deploy(self, policy: LSTMPolicy | TrackingPolicy) -> Controller:
        """The policy as it would run on the plant: its mode, at the set point of the task."""
        if isinstance(policy, TrackingPolicy):
            return AtSetPoint(policy, self.task)
        return PolicyController(policy, self.task, exploring=False)

    def fresh(self, controller: Controller | LSTMPolicy | TrackingPolicy, n_trajectories: int | None = None) -> Trajectories:
        """Trajectories that no learning has seen; the same disturbances for every controller. A policy is deployed."""
        if isinstance(controller, LSTMPolicy | TrackingPolicy):
            controller = self.deploy(controller)
        number = n_trajectories or self.scale_params.evaluation
        return rollout(self.process, controller, self.task, number, self.stream("evaluation"))

    def judge(self, trajectories: Trajectories) -> dict[str, float]:
        """All figures of merit of a controller from its trajectories, at the headline beta."""
        process = self.params.process
        return scores(trajectories, self.features, self.params.case.online.headline_beta, process.controlled, process.manipulated)

    def judge_imitation(
        self, trajectories: Trajectories, demonstrations: Demonstrations, result: Apprenticeship
    ) -> dict[str, float]:
        """`judge`, the feature gap to the true expert, the weights, and what learning cost."""
        names, mean = self.feature_names, self.features.trajectory(trajectories).mean(0).double()
        truth = demonstrations.true_features(names).double()
        rows = self.judge(trajectories) | {"feature_gap": feature_gap(mean, truth)}
        for kind, values in (("gap", relative_gap(mean, truth)), ("alpha", result.weights)):
            rows |= {f"{kind}:{name}": value for name, value in zip(names, values.tolist(), strict=True)}
        return rows | {"chosen_epoch": float(result.chosen_epoch)} | cost(result.records[-1])

    def judge_online(
        self, offline: LSTMPolicy, results: Mapping[str, Improvement]
    ) -> tuple[dict[str, Trajectories], dict[str, dict[str, float]]]:
        """Trajectories and scores of PID, offline policy, the policies improved on x and on y, and minimum variance, by stage.

        All meet the same disturbances.
        """
        learned = {"online": results["x"], "online_y": results["y"]}
        controllers: dict[str, Controller | LSTMPolicy] = {"expert_paired": self.expert, "offline": offline}
        controllers |= {name: result.policy for name, result in learned.items()} | {"minimum_variance": self.minimum_variance}
        trajectories = {name: self.fresh(controller) for name, controller in controllers.items()}
        scores = {name: self.judge(batch) for name, batch in trajectories.items()}
        return trajectories, scores | {name: scores[name] | cost(result.records[-1]) for name, result in learned.items()}

    def feature_table(self, scores: Mapping[str, float], demonstrations: Demonstrations) -> pd.DataFrame:
        """Features of policy and expert, their gap in per cent and alpha*, beside the paper's rows; a row for each feature."""
        names = self.feature_names
        columns: dict[str, Any] = {
            "expert": demonstrations.true_features(names),
            "policy": [scores[f"v:{name}"] for name in names],
            "gap, %": [100 * scores[f"gap:{name}"] for name in names],
            "alpha*": [scores[f"alpha:{name}"] for name in names],
        }
        if self.published is not None:
            columns |= {f"published {row}": getattr(self.published, row) for row in ("expert", "policy", "alpha")}
        return pd.DataFrame(columns, index=names).astype(float)

    def outcome(self, scores: Mapping[str, float]) -> pd.DataFrame:
        """The feature gap, the paper's own, and what learning cost."""
        rows = {"feature gap, %": 100 * scores["feature_gap"]}
        if self.published is not None:
            rows["feature gap of the paper, %"] = 100 * self.published.feature_gap
        rows |= {name.replace("_", " "): scores[name] for name in ("chosen_epoch", "epochs", "episodes", "gradient_steps")}
        return pd.Series(rows).to_frame("value")

    def response_table(self, agent: Trajectories, expert: Trajectories) -> pd.DataFrame:
        """`response_table` of this study's variables."""
        return response_table(agent, expert, self.params.process.controlled, self.params.process.manipulated)


def copied(policy: LSTMPolicy, parameters: Mapping[str, Tensor] | None = None) -> LSTMPolicy:
    """A policy like another one, which may be trained further; with parameters of its own, if given."""
    found = copy.deepcopy(policy)
    if parameters is not None:
        found.load_state_dict(parameters)
    return found


# Tables --------------------------------------------------------------------------------------------------------------


def cost(record: EpochRecord | IterationRecord) -> dict[str, float]:
    """What learning had cost by the end of a record."""
    return {name: float(getattr(record, name)) for name in ("epochs", "episodes", "gradient_steps")}


def score_table(by_stage: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Figures of merit as a long table: stage, metric, value."""
    rows = [(stage, metric, value) for stage, figures in by_stage.items() for metric, value in figures.items()]
    return pd.DataFrame(rows, columns=["stage", "metric", "value"])


def history_table(records: tuple[EpochRecord, ...] | tuple[IterationRecord, ...], feature_names: list[str]) -> pd.DataFrame:
    """Records of learning as a table; the weights become one column a feature, `alpha:<feature>`."""
    rows: list[dict[str, Any]] = []
    for record in records:
        row = asdict(record)
        weights = row.pop("weights", ())
        rows.append(row | {f"alpha:{name}": value for name, value in zip(feature_names, weights, strict=False)})
    return pd.DataFrame(rows)


def weight_table(feature_names: list[str], weights: Tensor) -> pd.DataFrame:
    """alpha* as a table: feature, alpha."""
    return pd.DataFrame({"feature": feature_names, "alpha": weights.tolist()})


def response_table(
    agent: Trajectories, expert: Trajectories, controlled: Sequence[str], manipulated: Sequence[str]
) -> pd.DataFrame:
    """What Figures 3-6 draw: mean and standard deviation over the trajectories at every sample.

    True states at the samples 0..T, inputs as the process received them at 0..T-1.

    The standard deviation is that of a sample (K - 1); nan for a single trajectory.

    Returns:
        Columns controller (agent, expert), variable, kind (controlled, manipulated), time_index, mean, std.
    """
    frames = []
    for controller, trajectories in (("agent", agent), ("expert", expert)):
        for kind, names, values in (("controlled", controlled, trajectories.x), ("manipulated", manipulated, trajectories.u)):
            signal = values.double()
            for name, mean, std in zip(names, signal.mean(1).T, signal.std(1).T, strict=True):
                columns = {"time_index": np.arange(len(mean)), "mean": mean.numpy(), "std": std.numpy()}
                frames.append(pd.DataFrame({"controller": controller, "variable": name, "kind": kind, **columns}))
    return pd.concat(frames, ignore_index=True)
