"""The verbs of the notebooks: record, imitate, improve and judge, each for the case and scale of a session."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from helpers.learning.algorithm_1 import improve_online
from helpers.learning.algorithm_2 import Apprenticeship, IterationRecord, algorithm_2, initial_weights
from helpers.learning.evaluation import feature_gap, relative_gap, scores
from helpers.learning.features import FeatureMap
from helpers.learning.learner import EpochRecord, Learner
from helpers.learning.policy import LSTMPolicy, PolicyController
from helpers.plant.controllers import Controller
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.artifacts import ArtifactError, trajectories_from_table
from helpers.runs.finished import State
from helpers.runs.progress import ProgressBar
from helpers.runs.session import Session


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


def load_demonstrations(session: Session) -> Demonstrations:
    """What notebook 01 recorded for the session's case."""
    stage = session.load("demonstrations", "01_demonstrations")
    process = session.params.process
    trajectories = trajectories_from_table(
        stage.table("demonstrations.csv"), process.controlled, process.manipulated, session.dtype, stage.path("demonstrations.csv")
    )
    rows = stage.table("scores.csv", ("stage", "metric", "value"))
    return Demonstrations(trajectories, rows.set_index("metric")["value"])


def fresh_policy(session: Session) -> LSTMPolicy:
    """An untrained policy."""
    return LSTMPolicy.initial(session.params.learning.policy, session.task, session.stream("policy"))


def load_policy(session: Session, stage: str, made_by: str, case: int | None = None) -> tuple[LSTMPolicy, Tensor]:
    """The policy and the weights alpha* of an earlier offline stage, maybe of another case."""
    found = session.load(stage, made_by, case)
    weights = found.table("weights.csv", ("feature", "alpha"))
    if weights["feature"].tolist() != session.feature_names or not pd.api.types.is_numeric_dtype(weights["alpha"]):
        raise ArtifactError(f"{found.path('weights.csv')}: expected a number for each of {', '.join(session.feature_names)}")
    alpha = torch.tensor(weights["alpha"].to_numpy(), dtype=session.dtype)
    if not alpha.isfinite().all():
        raise ArtifactError(f"{found.path('weights.csv')}: column 'alpha': expected finite numbers")
    return found.policy(session.params.learning, session.task), alpha


def apprentice(
    session: Session,
    demonstrations: Demonstrations,
    policy: LSTMPolicy,
    start: Tensor | None = None,
    features: FeatureMap | None = None,
) -> tuple[Learner, Tensor, Tensor, int]:
    """What Algorithm 2 begins with: the learner, v_E, alpha before the first iteration, and the number of iterations.

    Without `start` the weights begin at their signs. A policy that was trained before gets its initial exploration back.
    `features`: those to match, if not the session's own.
    """
    variant, scale, offline = session.variant_params, session.scale_params, session.params.case.offline
    n_epochs = session.epochs(offline.epochs)
    n_iterations = n_epochs if variant.weights.iterations == "epochs" else min(offline.iterations, n_epochs)
    if start is None:
        start = initial_weights(variant.weights, len(session.task.set_point), session.dtype)
    policy.reset_exploration(variant.exploration)
    generator = session.stream("offline", session.params.base(session.variant))
    learner = Learner(policy, session.process, features or session.features, variant.learner, scale.episodes, n_epochs, generator)
    return learner, demonstrations.features(learner.features), start, n_iterations


def imitate(
    session: Session,
    demonstrations: Demonstrations,
    policy: LSTMPolicy,
    start: Tensor | None = None,
    features: FeatureMap | None = None,
) -> Apprenticeship:
    """Offline learning: Algorithm 2 from a policy and weights; see `apprentice`. Notebook 02 shows its steps."""
    learner, v_expert, start, n_iterations = apprentice(session, demonstrations, policy, start, features)
    params, measured = session.variant_params.weights, session.scale_params.measured

    def train() -> State:
        bar = ProgressBar(learner.total_epochs, "offline")
        found = algorithm_2(learner, v_expert, start, params, n_iterations, measured, bar)
        records = [asdict(record) for record in found.records]
        return {"weights": found.weights, "policy": found.policy.state_dict(), "epoch": found.chosen_epoch, "records": records}

    kept = once(session, train, learner, v_expert, start)
    records = (IterationRecord(**row | {"weights": tuple(row["weights"])}) for row in kept["records"])
    return Apprenticeship(kept["weights"], restored(policy, kept["policy"]), kept["epoch"], tuple(records))


def once(session: Session, train: Callable[[], State], learner: Learner, *more: Any) -> State:
    """A training by a learner that has not begun, once in a run; `more`: what it starts from beside learner and session."""
    settings = (session.variant, vars(learner.features), learner.params, learner.n_episodes, learner.total_epochs)
    return session.once(train, *settings, learner.generator.get_state(), *learner.policy.state_dict().values(), *more)


def restored(like: LSTMPolicy, parameters: Mapping[str, Tensor]) -> LSTMPolicy:
    """A policy like another one, with parameters of its own."""
    policy = copy.deepcopy(like)
    policy.load_state_dict(parameters)
    return policy


@dataclass(frozen=True)
class Improvement:
    """The result of online learning."""

    policy: LSTMPolicy
    records: tuple[EpochRecord, ...]


def improve(session: Session, policy: LSTMPolicy, features_on: str, episodes: int | None = None) -> Improvement:
    """Online learning: the case's rounds of Algorithm 1 under the tracking objective, read from x or from y.

    `episodes` an epoch, each a run of the plant, are those of the parameter files unless given.
    """
    online, learning = session.params.case.online, session.params.learning.online
    epochs = [session.epochs(n_epochs) for n_epochs in online.epochs]
    generator = session.stream("online", session.variant, features_on)
    scale = session.scale_params
    n_episodes = min(episodes or learning.episodes, scale.episodes + scale.measured)
    policy.reset_exploration(learning.exploration)
    learner = Learner(
        policy, session.process, session.features.on(features_on), learning.learner, n_episodes, sum(epochs), generator
    )

    def train() -> State:
        records = improve_online(learner, epochs, online.beta, ProgressBar(sum(epochs), f"online on {features_on}"))
        return {"policy": learner.average.state_dict(), "records": [asdict(record) for record in records]}

    kept = once(session, train, learner, epochs, online.beta)
    return Improvement(restored(policy, kept["policy"]), tuple(EpochRecord(**row) for row in kept["records"]))


def deploy(session: Session, policy: LSTMPolicy) -> PolicyController:
    """The policy as it would run on the plant: its mode."""
    return PolicyController(policy, session.task, exploring=False)


def fresh_trajectories(session: Session, controller: Controller, n_trajectories: int | None = None) -> Trajectories:
    """Trajectories that no learning has seen; the same disturbances for every controller."""
    number = n_trajectories or session.scale_params.evaluation
    return rollout(session.process, controller, session.task, number, session.stream("evaluation"))


def judge(session: Session, trajectories: Trajectories) -> dict[str, float]:
    """All figures of merit of a controller from its trajectories, at the headline beta."""
    process = session.params.process
    return scores(trajectories, session.features, session.params.case.online.headline_beta, process.controlled, process.manipulated)


def judge_imitation(
    session: Session, trajectories: Trajectories, demonstrations: Demonstrations, result: Apprenticeship
) -> dict[str, float]:
    """`judge`, the feature gap to the true expert, the weights, and what learning cost."""
    mean = session.features.trajectory(trajectories).mean(0).double()
    names = session.feature_names
    truth = demonstrations.true_features(names).double()
    last = result.records[-1]
    rows = judge(session, trajectories) | {"feature_gap": feature_gap(mean, truth)}
    rows |= {f"gap:{name}": value for name, value in zip(names, relative_gap(mean, truth).tolist(), strict=True)}
    rows |= {f"alpha:{name}": value for name, value in zip(names, result.weights.tolist(), strict=True)}
    return rows | {"chosen_epoch": float(result.chosen_epoch)} | cost(last)


def feature_table(session: Session, scores: Mapping[str, float], demonstrations: Demonstrations) -> pd.DataFrame:
    """Features of policy and expert, their gap in per cent and alpha*, beside the paper's rows; a row for each feature."""
    names = session.feature_names
    columns: dict[str, Any] = {
        "expert": demonstrations.true_features(names),
        "policy": [scores[f"v:{name}"] for name in names],
        "gap, %": [100 * scores[f"gap:{name}"] for name in names],
        "alpha*": [scores[f"alpha:{name}"] for name in names],
    }
    if session.published is not None:
        columns |= {f"published {row}": getattr(session.published, row) for row in ("expert", "policy", "alpha")}
    return pd.DataFrame(columns, index=names).astype(float)


def outcome(session: Session, scores: Mapping[str, float]) -> pd.DataFrame:
    """The feature gap, the paper's own, and what learning cost."""
    rows = {"feature gap, %": 100 * scores["feature_gap"]}
    if session.published is not None:
        rows["feature gap of the paper, %"] = 100 * session.published.feature_gap
    rows |= {name.replace("_", " "): scores[name] for name in ("chosen_epoch", "epochs", "episodes", "gradient_steps")}
    return pd.Series(rows).to_frame("value")


def judge_improvement(session: Session, trajectories: Trajectories, result: Improvement) -> dict[str, float]:
    """`judge` and what learning cost."""
    return judge(session, trajectories) | cost(result.records[-1])


def judge_online(
    session: Session, offline: LSTMPolicy, results: Mapping[str, Improvement]
) -> tuple[dict[str, Trajectories], dict[str, dict[str, float]]]:
    """Trajectories and scores of PID, offline policy, the policies improved on x and on y, and minimum variance, by stage.

    All meet the same disturbances.
    """
    learned = {"online": results["x"], "online_y": results["y"]}
    controllers: dict[str, Controller] = {"expert_paired": session.expert, "offline": deploy(session, offline)}
    controllers |= {name: deploy(session, result.policy) for name, result in learned.items()}
    controllers["minimum_variance"] = session.minimum_variance
    trajectories = {name: fresh_trajectories(session, controller) for name, controller in controllers.items()}
    scores = {name: judge(session, batch) for name, batch in trajectories.items()}
    return trajectories, scores | {name: judge_improvement(session, trajectories[name], result) for name, result in learned.items()}


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
