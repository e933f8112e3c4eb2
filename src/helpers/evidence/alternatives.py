"""Imitation put to the test: other features, other demonstrators, and cloning, each as a verb like those of `experiments`."""

from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor

from helpers.evidence.experiments import Prepared, Scores, economical, gap_to, scaled
from helpers.learning.algorithm_2 import initial_weights
from helpers.learning.cloning import clone
from helpers.learning.evaluation import feature_gap, objective
from helpers.learning.features import FeatureMap
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import Controller, Operator, SaturatedLQ
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.study import Demonstrations, Study, copied

# What can be learned from --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SomeFeatures(FeatureMap):
    """A feature map that keeps only some of the features, by their place in Eq. 4.2.5."""

    kept: tuple[int, ...] = ()

    def state(self, trajectories: Trajectories) -> Tensor:
        """phi of the kept features at t = 1..T, shape (T, K, number kept)."""
        return super().state(trajectories)[..., self.kept]


def feature_sets(prepared: Prepared) -> Scores:
    """Algorithm 2 with the Type I features alone (type_one) and with all (all_types), alike in everything else.

    own_gap: the gap in the features that were matched; gap: in all six; distance: between the mean responses of policy and
    expert, root mean square over time and loops, as a share of the set point change; then the outcome of improving each online
    alike.
    """
    session, params = prepared.session, prepared.params
    if not prepared.planned(params.feature_sets):
        return {}
    short = economical(session.varied(offline={"epochs": params.feature_sets.epochs}))
    expert = session.features.errors(session.fresh(session.expert)).mean(1)
    truth, scores = prepared.expert_features, Scores()
    everything = tuple(range(len(truth)))
    for name, kept in (("type_one", everything[: len(session.task.set_point)]), ("all_types", everything)):
        chosen = SomeFeatures(**vars(short.features), kept=kept)
        start = initial_weights(short.variant_params.weights, len(short.task.set_point), short.dtype)[list(kept)]
        policy = short.imitate(prepared.demonstrations, short.fresh_policy(), start, chosen).policy
        fresh, improved = session.fresh(policy), session.improve(copied(policy), "x").policy
        v = session.features.trajectory(fresh).mean(0).double()
        scores[name] = {
            "own_gap": feature_gap(v[list(kept)], truth[list(kept)]),
            "gap": feature_gap(v, truth),
            "distance": (session.features.errors(fresh).mean(1) - expert).square().mean().sqrt().item(),
            "objective_after_online": session.judge(session.fresh(improved))["objective_x"],
        }
    return scores


def record(session: Study, controller: Controller, purpose: str) -> Demonstrations:
    """Demonstrations of another controller in the session's task, as notebook 01 records those of the PID."""
    scale = session.scale_params
    trajectories = rollout(session.process, controller, session.task, scale.demonstrations, session.stream("experiments", purpose))
    truth = session.judge(session.fresh(controller, scale.expert_evaluation))
    return Demonstrations(trajectories, pd.Series(truth))


def demonstrators(prepared: Prepared) -> Scores:
    """Algorithm 2 on the data of a predictive controller, of an operator who intervenes, and of a plant at rest."""
    if not prepared.planned(prepared.params.demonstrators):
        return {}
    return _from_predictive(prepared) | _from_operator(prepared) | _from_rest(prepared)


def _learned_from(prepared: Prepared, data: Demonstrations) -> tuple[LSTMPolicy, dict[str, float]]:
    """The policy that Algorithm 2 learns from such data; its gap to them, and the tracking objective of both."""
    session = prepared.session
    short = economical(session.varied(offline={"epochs": prepared.params.demonstrators.epochs}))
    learned = short.imitate(data, session.fresh_policy()).policy
    fresh = session.fresh(learned)
    return learned, {
        "gap": gap_to(session, fresh, data.true_features(session.feature_names).double()),
        "objective_x": session.judge(fresh)["objective_x"],
        "objective_x_of_demonstrator": float(data.scores["objective_x"]),
    }


def _from_predictive(prepared: Prepared) -> Scores:
    session, params = prepared.session, prepared.params.demonstrators
    process = session.process
    controller = SaturatedLQ(process.state_step, process.input_step, session.task, params.horizon, params.move_penalty)
    return {"from_predictive": _learned_from(prepared, record(session, controller, "predictive"))[1]}


def _from_operator(prepared: Prepared) -> Scores:
    """How well the interventions are repeated (`miss_by_hand`) by the policies learned from the operator's data through
    Algorithm 2 and through cloning, and by one learned from the controller's alone."""
    session, params = prepared.session, prepared.params.demonstrators
    held = torch.tensor([params.held if name == params.by_hand else torch.nan for name in session.params.process.manipulated])
    operator = Operator(session.expert, session.task, params.threshold, held.to(session.dtype))
    data = record(session, operator, "operator")
    learned, figures = _learned_from(prepared, data)
    own = session.fresh(operator)
    policies = {"from_operator": learned, "operator_cloned": cloned(prepared, data.trajectories), "from_pid": prepared.imitator}
    misses = {name: {"miss_by_hand": miss_by_hand(own, operator, policy)} for name, policy in policies.items()}
    return misses | {"from_operator": figures | misses["from_operator"]}


def _from_rest(prepared: Prepared) -> Scores:
    """Data and simulation both begin at the set point and stay there; the gap is to the controller in the task itself."""
    session, params = prepared.session, prepared.params.demonstrators
    case = {"initial_mean": session.params.case.set_point, "initial_std": scaled(params.rest_std, session.params.case.initial_std)}
    at_rest = session.varied(case=case, offline={"epochs": params.epochs})
    learned = economical(at_rest).imitate(record(at_rest, at_rest.expert, "at rest"), session.fresh_policy()).policy
    fresh = session.fresh(learned)
    objective_x = session.judge(fresh)["objective_x"]
    return {"from_rest": {"gap": gap_to(session, fresh, prepared.expert_features), "objective_x": objective_x}}


def miss_by_hand(trajectories: Trajectories, operator: Operator, policy: LSTMPolicy) -> float:
    """How far a policy's input lies from the operator's under hand control: root mean square, as a share of the input range.

    Given the same recorded past; at the first sample of each spell of hand control only, because later ones show the policy
    the held input as its own previous one, which any policy could repeat.

    Args:
        trajectories: the operator's own.
    """
    task = operator.task
    by_hand = operator.by_hand(trajectories.y[:-1])
    by_hand[1:] &= ~operator.by_hand(trajectories.y[:-2])
    with torch.no_grad():
        mean, _ = policy(trajectories.y, trajectories.u, task)
    miss = (mean - trajectories.u) / (task.input_high - task.input_low)
    return miss[by_hand].square().mean().sqrt().item()


# How robust imitation is ---------------------------------------------------------------------------------------------


def conditions(prepared: Prepared) -> dict[str, Study]:
    """The session as it is, and under conditions that no learning has seen."""
    session, params = prepared.session, prepared.params.conditions
    case, process = session.params.case, session.params.process
    pairs = zip(case.initial_mean, params.initial_shift, case.initial_std, strict=True)
    shifted = tuple(mean + shift * std for mean, shift, std in pairs)
    target = tuple(factor * value for factor, value in zip(params.set_point_factor, case.set_point, strict=True))
    return {
        "nominal": session,
        "initial_state": session.varied(case={"initial_mean": shifted}),
        "set_point": session.varied(case={"set_point": target}),
        "disturbance": session.varied(process={"disturbance": scaled(params.disturbance_factor, process.disturbance)}),
    }


def cloned(prepared: Prepared, data: Trajectories) -> LSTMPolicy:
    """The policy that behavioural cloning learns from such data."""
    session, params = prepared.session, prepared.params.cloning
    n_steps, generator = session.epochs(params.steps), session.stream("experiments", "cloning")
    return clone(session.fresh_policy(), data, session.task, params, n_steps, generator).policy


def first(demonstrations: Demonstrations, n_trajectories: int) -> Demonstrations:
    """Only the first of the recorded trajectories."""
    kept = {name: signal[:, :n_trajectories] for name, signal in vars(demonstrations.trajectories).items()}
    return Demonstrations(Trajectories(**kept), demonstrations.scores)


def robustness(prepared: Prepared) -> Scores:
    """Imitation through Algorithm 2 and behavioural cloning, each under every condition, from few and many demonstrations.

    gap: to the features that the expert has under the same condition; objective_ratio: the tracking objective as a share of
    the expert's there. Algorithm 2 has the model of the process besides the data, cloning has the data alone. The improved
    policy is judged along with them.
    """
    session, params = prepared.session, prepared.params
    if not prepared.planned(params.cloning):
        return {}
    policies = {"irl_500": prepared.imitator, "improved": prepared.improved}
    for number in params.cloning.demonstrations:
        policies[f"clone_{number}"] = cloned(prepared, first(prepared.demonstrations, number).trajectories)
    if prepared.planned(params.fewer_demonstrations):
        short = economical(session.varied(offline={"epochs": params.fewer_demonstrations.epochs}))
        for number in params.fewer_demonstrations.demonstrations:
            fewer = first(prepared.demonstrations, number)
            policies[f"irl_{number}"] = short.imitate(fewer, session.fresh_policy()).policy
    scores: Scores = {}
    for condition, run in conditions(prepared).items():
        expert = run.fresh(run.expert)
        truth = run.features.trajectory(expert).mean(0).double()
        aim = _objective(prepared, run, expert)
        for name, policy in policies.items():
            fresh = run.fresh(policy)
            ratio = _objective(prepared, run, fresh) / aim
            scores[f"{name}:{condition}"] = {"gap": gap_to(run, fresh, truth), "objective_ratio": ratio}
    return scores


def _objective(prepared: Prepared, session: Study, trajectories: Trajectories) -> float:
    return objective(trajectories, session.features.on("x"), prepared.params.comparison.beta).mean().item()
