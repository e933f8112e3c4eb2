"""The extra runs behind the claims: each verb takes what `prepare` loaded and returns figures of merit by the name of a run.

Every run draws from the same random streams as the stages, so that runs of one seed can be compared with each other. A verb
whose experiment is not planned for the session's case or seed (params/experiments.yaml) returns nothing.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import pandas as pd
import torch
from torch import Tensor

from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.algorithm_2 import apprentice_reward
from helpers.learning.control_quality import settling_time
from helpers.learning.evaluation import feature_gap
from helpers.learning.learner import TrainingError, baseline_regressors, discounted_return, regression_advantage, surrogate
from helpers.learning.policy import LSTMPolicy, PolicyController
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.finished import State
from helpers.runs.progress import ProgressBar
from helpers.runs.session import Session
from helpers.runs.study import Demonstrations, Study, copied, history_table
from helpers.settings.evidence import ComparisonParams, ExperimentCases, ExperimentParams, load_experiments
from helpers.settings.paper import HEADLINE

Scores = dict[str, dict[str, float]]  # run, metric, value

# Share of the episodes of an epoch, in the learning that only a claim reads. In Case I, seed 0, the gap to the predictive
# controller was 5.1 % with it and 4.1 % without, to the operator 2.0 and 1.9 %, from data at rest 25 and 26 %.
ECONOMY = 3 / 8


@dataclass(frozen=True)
class Prepared:
    """A session with what the stages before it made: demonstrations, the imitating policy with its alpha*, the improved one."""

    session: Session
    params: ExperimentParams
    demonstrations: Demonstrations
    imitator: LSTMPolicy
    weights: Tensor
    improved: LSTMPolicy
    curve: pd.DataFrame  # of the online learning that gave the improved policy: its history.csv

    def planned(self, experiment: ExperimentCases) -> bool:
        """Whether an experiment is to be run in the session's case and for its seed."""
        return experiment.planned(self.session.case, self.session.seed)

    @property
    def expert_features(self) -> Tensor:
        """v_E of the demonstrating controller on many fresh trajectories, shape (d,)."""
        return self.demonstrations.true_features(self.session.feature_names).double()


def prepare(session: Session) -> Prepared:
    """What the experiments start from: the results of notebooks 01 to 04 for the session's case."""
    transferred = session.params.case.offline.transfer_from is not None
    kind, made_by = ("transfer", "04_knowledge_transfer") if transferred else ("offline", "02_offline_irl")
    imitator, weights = session.load_policy(f"{kind}_{HEADLINE}", made_by)
    online = session.load(f"online_{HEADLINE}", made_by if transferred else "03_online_improvement")
    return Prepared(
        session=session,
        params=load_experiments(session.params_root, session.params),
        demonstrations=session.load_demonstrations(),
        imitator=imitator,
        weights=weights,
        improved=online.policy(session.params.learning, session.task),
        curve=online.table("history.csv", ("epochs", "episodes", "mean_return")),
    )


def economical(session: Study) -> Study:
    """The session with fewer episodes an epoch, learned from and measured, for runs that nothing but a claim reads."""
    scale = session.scale_params
    fewer = {name: max(2, round(ECONOMY * getattr(scale, name))) for name in ("episodes", "measured")}
    return replace(session, scale_params=scale.model_copy(update=fewer))


def scaled(factor: float, values: Sequence[float]) -> tuple[float, ...]:
    """Entries of a parameter file times a factor."""
    return tuple(factor * value for value in values)


def gap_to(session: Study, trajectories: Trajectories, expert_features: Tensor) -> float:
    """The feature gap of trajectories to the features of an expert, shape (d,)."""
    return feature_gap(session.features.trajectory(trajectories).mean(0).double(), expert_features)


# How controllers respond ---------------------------------------------------------------------------------------------


def response_figures(session: Session, trajectories: Trajectories, comparison: ComparisonParams) -> dict[str, float]:
    """Figures of the response, in a form that is always a number; what the mean response never reaches takes the whole episode.

    settling_time: after which it stays within a band about the set point; abs_offset: the size of the mean error at the end;
    excess_travel: how much further the mean response travels than from its start to its end, as a share of the set point change
    (nought without overshoot and oscillation, up to noise). The others are those of `judge`.
    """
    dt, error = session.params.process.sampling_time, session.features.errors(trajectories)
    mean = error.mean(1)
    of_loops = {
        "settling_time": settling_time(mean, dt, comparison.band),
        "abs_offset": error[-comparison.n_last :].mean((0, 1)).abs(),
        "excess_travel": mean.diff(dim=0).abs().sum(0) - (mean[-1] - mean[0]).abs(),
    }
    judged = session.judge(trajectories).items()
    rows = {name: value for name, value in judged if name.startswith(("objective_x", "rise_time:", "overshoot:"))}
    rows |= by_loop(session, of_loops)
    return {name: session.task.n_steps * dt if math.isnan(value) else value for name, value in rows.items()}


def by_loop(session: Study, figures: Mapping[str, Tensor]) -> dict[str, float]:
    """Figures of shape (n_y,) as single numbers, <name>:<controlled variable>."""
    loops = session.params.process.controlled
    return {f"{name}:{loop}": value for name, of in figures.items() for loop, value in zip(loops, of.tolist(), strict=True)}


def responses(prepared: Prepared) -> Scores:
    """How expert, imitating policy and improved policy respond to the same disturbances."""
    session, fresh = prepared.session, prepared.session.fresh
    batches = {"expert": fresh(session.expert), "offline": fresh(prepared.imitator), "online": fresh(prepared.improved)}
    return {name: response_figures(session, batch, prepared.params.comparison) for name, batch in batches.items()}


def readings(prepared: Prepared) -> Scores:
    """What can be read off model, data and weights without learning.

    loop_share of each loop: the share of alpha* in the 1-norm. pulled: how far reaching the other loop's set point by its own
    input moves a loop at rest, as a share of the loop's own set point change (from Eq. 4.1.3b; negative: away). not_reached:<n>:
    the share of demonstrations whose true state, on average over the last n samples, lies outside the band about the set point.
    """
    session, comparison = prepared.session, prepared.params.comparison
    share = prepared.weights.abs().reshape(-1, len(session.task.set_point)).sum(0) / prepared.weights.abs().sum()
    drift, target = session.process.drift_state, session.task.set_point
    change = -(drift - drift.diagonal().diag()) @ target / drift.diagonal() / target
    error = session.features.on("x").errors(prepared.demonstrations.trajectories)
    outside = {n: error[-n:].mean(0).abs() > comparison.band for n in comparison.reached}
    figures = {"loop_share": share, "pulled": change} | {f"not_reached:{n}": far.double().mean(0) for n, far in outside.items()}
    return {"readings": by_loop(session, figures)}


# How learning goes ---------------------------------------------------------------------------------------------------


def first_epoch(curve: pd.Series, level: float) -> float:
    """The first epoch, of the index, whose value reaches a level from below; one more than the last where none does."""
    return float(next(iter(curve.index[curve >= level]), curve.index[-1] + 1))


def attempt(
    session: Session, start: LSTMPolicy, betas: Sequence[float], from_scratch: bool = False
) -> tuple[LSTMPolicy, pd.DataFrame]:
    """Online learning with these betas, one a round: the policy and its curve.

    Where the reward is so sparse that every episode of a batch earns the same, learning cannot go on: the policy stays as it
    was at the start, and the curve is empty.
    """
    try:
        result = session.varied(online={"beta": tuple(betas)}).improve(copied(start), "x", from_scratch=from_scratch)
    except TrainingError:
        return start, pd.DataFrame({"epochs": [], "episodes": [], "mean_return": []})
    return result.policy, history_table(result.records, session.feature_names)


def from_imitator(prepared: Prepared, betas: Sequence[float]) -> tuple[LSTMPolicy, pd.DataFrame]:
    """`attempt` from the imitating policy. With the case's own betas that is the run of notebook 03 or 04: it is not repeated."""
    if tuple(betas) == prepared.session.params.case.online.beta:
        return prepared.improved, prepared.curve
    return attempt(prepared.session, prepared.imitator, betas)


def online_starts(prepared: Prepared) -> tuple[Scores, pd.DataFrame]:
    """Online learning from the imitating policy (hot) and from an untrained one (scratch), judged alike, and the curves.

    Same epochs, rate, disturbances and beta; who has learned nothing explores further. scratch_dense begins with the smaller beta
    of the offline features, which gives learning from scratch a reward it can find, and has the headline beta in the later rounds
    only; <start>_beta_<beta>, where it is planned, has another beta throughout. learned: 1 where learning could go on.
    epochs_to_level: when the return first reaches what learning from scratch (the better of scratch and scratch_dense) ends with.
    """
    session, params = prepared.session, prepared.params
    rounds = session.params.case.online.epochs
    dense, sharp = session.features.params.beta, params.comparison.beta
    betas = {"hot": [sharp] * len(rounds), "scratch": [sharp] * len(rounds), "scratch_dense": [dense, *[sharp] * (len(rounds) - 1)]}
    if prepared.planned(params.offline_beta):
        betas[f"hot_beta_{dense:g}"] = [dense] * len(rounds)
    if prepared.planned(params.sparse_reward):
        betas |= {f"scratch_beta_{beta:g}": [beta] * len(rounds) for beta in params.sparse_reward.betas}
    results = {
        name: from_imitator(prepared, of)
        if name.startswith("hot")
        else attempt(session, session.fresh_policy(), of, from_scratch=True)
        for name, of in betas.items()
    }
    budget = float(sum(session.epochs(n_epochs) for n_epochs in rounds))
    level = max(results[name][1]["mean_return"].iloc[-1:].sum() for name in ("scratch", "scratch_dense"))  # nought without a curve
    scores = {}
    for name, (policy, curve) in results.items():
        reached = first_epoch(curve.set_index("epochs")["mean_return"], level) if name == "hot" else budget
        figures = response_figures(session, session.fresh(policy), params.comparison)
        scores[name] = figures | {"learned": float(len(curve) > 0), "epochs_to_level": reached, "epochs": budget}
    return scores, pd.concat([curve.assign(run=name) for name, (_, curve) in results.items()], ignore_index=True)


def online_budget(prepared: Prepared) -> pd.DataFrame:
    """The objective that online learning ends with, by the plant's episodes in each epoch; epochs and betas are the case's.

    With the episodes of learning.yaml that is the run of notebook 03 or 04, which is not repeated.
    """
    session, params = prepared.session, prepared.params.budget
    rows = []
    for number in params.episodes if prepared.planned(params) else ():
        if number == session.params.learning.online.episodes:
            policy, episodes = prepared.improved, int(prepared.curve["episodes"].iloc[-1])
        else:
            result = session.improve(copied(prepared.imitator), "x", number)
            policy, episodes = result.policy, result.records[-1].episodes
        rows.append((number, episodes, session.judge(session.fresh(policy))["objective"]))
    return pd.DataFrame(rows, columns=["episodes_per_epoch", "episodes", "objective"])


def transfer(prepared: Prepared) -> Scores:
    """Epochs that transfer and learning from scratch need to the least gap that learning from scratch gets to.

    The gap is the running mean over five iterations of the one measured while learning.
    """
    session = prepared.session
    if session.params.case.offline.transfer_from is None:
        return {}
    gaps = {}
    for name, kind, made_by in (("transfer", "transfer", "04_knowledge_transfer"), ("from_scratch", "offline", "02_offline_irl")):
        history = session.load(f"{kind}_{HEADLINE}", made_by).table("history.csv").set_index("epochs")
        gaps[name] = history["feature_gap"].rolling(5, min_periods=1).mean()
    return {name: {"epochs_to_level": first_epoch(-gap, -gaps["from_scratch"].min())} for name, gap in gaps.items()}


def learn_under(session: Study, weights: Tensor, n_epochs: int, label: str) -> LSTMPolicy:
    """Algorithm 1 from an untrained policy under a reward whose weights stay as they are."""
    generator, params = session.stream("experiments", "frozen"), session.variant_params.learner
    n_episodes = economical(session).scale_params.episodes
    policy = session.fresh_policy()
    learner = session.learner(policy, n_episodes, n_epochs, params, generator)
    reward = partial(apprentice_reward, features=session.features, weights=weights)

    def train() -> State:
        algorithm_1(learner, reward, n_epochs, params.patience, ProgressBar(n_epochs, label))
        return {"policy": learner.average.state_dict()}

    return copied(policy, session.trained(train, learner, weights)["policy"])


def frozen_weights(prepared: Prepared) -> Scores:
    """A policy from scratch under weights that stay as they are: does alpha* by itself lead to the expert's behaviour?

    frozen: under our alpha*; frozen_published: under the paper's; frozen_undiscounted: ours, learned with gamma = 1. Beside the
    response and the gap: alpha . v of the policy and of the expert, and the policy's without discount.
    """
    session, params, scores = prepared.session, prepared.params, Scores()
    if not prepared.planned(params.frozen_weights):
        return scores
    runs = {"frozen": (session, prepared.weights)}
    if session.published is not None:
        runs["frozen_published"] = (session, torch.tensor(session.published.alpha, dtype=session.dtype))
    if prepared.planned(params.undiscounted):
        runs["frozen_undiscounted"] = (session.varied(features={"discount": 1.0}), prepared.weights)
    expert, gamma = session.fresh(session.expert), session.features.params.discount
    for name, (run, weights) in runs.items():
        fresh = session.fresh(learn_under(run, weights, session.epochs(params.frozen_weights.epochs), name))
        rewards, of_expert = (apprentice_reward(batch, session.features, weights) for batch in (fresh, expert))
        scores[name] = response_figures(session, fresh, params.comparison) | {
            "gap": gap_to(session, fresh, prepared.expert_features),
            "return": discounted_return(rewards, gamma).mean().item(),
            "return_undiscounted": rewards.sum(0).mean().item(),
            "return_of_expert": discounted_return(of_expert, gamma).mean().item(),
        }
    return scores


def gradient_spread(prepared: Prepared) -> Scores:
    """The variance of the policy gradient (the trace of its covariance over batches) with and without a baseline.

    Of the imitating policy, exploring, under the tracking reward. none: the whole return; mean: less the mean return, as in
    Algorithm 1; regression: reward-to-go less a regression, as in the improved variant. Each in units of the first.
    """
    session, params = prepared.session, prepared.params.baseline
    if not prepared.planned(params):
        return {}
    policy, generator = copied(prepared.imitator), session.stream("experiments", "baseline")
    policy.reset_exploration()
    gamma, beta = session.features.params.discount, prepared.params.comparison.beta
    gradients: dict[str, list[Tensor]] = {"none": [], "mean": [], "regression": []}
    controller = PolicyController(policy, session.task, exploring=True)
    for _ in range(max(2, session.epochs(params.batches))):  # as the epochs, fewer at smoke scale
        batch = rollout(session.process, controller, session.task, params.episodes, generator)
        rewards = session.features.tracking(batch, beta)
        returns = discounted_return(rewards, gamma)
        weights = {
            "none": returns.expand_as(rewards),
            "mean": (returns - returns.mean()).expand_as(rewards),
            "regression": regression_advantage(rewards, gamma, 1.0, baseline_regressors(batch, session.features)),
        }
        for name, weight in weights.items():
            log_probability = policy.log_probability(batch.y, batch.u, batch.command, session.task)
            slopes = torch.autograd.grad(surrogate(log_probability, weight), list(policy.parameters()))
            gradients[name].append(torch.cat([slope.flatten() for slope in slopes]))
    variance = {name: torch.stack(found).var(0).sum().item() for name, found in gradients.items()}
    return {"gradient": {f"variance:{name}": value / variance["none"] for name, value in variance.items()}}
