"""The price of exploring: what every episode of online learning earned, beside the PID under the same disturbances."""

import numpy as np
import pandas as pd
import torch

from helpers.evidence.equal_budget import Contest
from helpers.learning.policy import LSTMPolicy
from helpers.plant.rollout import rollout
from helpers.runs.study import copied


def exploring_episodes(contest: Contest) -> pd.DataFrame:
    """Every exploring episode of the case's online epochs, from an imitating (hot), a cloned and an untrained policy (scratch).

    Beside each the episode that the PID would have had from the same initial state under the same disturbances. From scratch the
    first round has the smaller beta of `dense`, without which there is nothing to learn from; all are judged by the real
    objective. Columns: run, epoch, episode, objective, expert.
    """
    online = contest.session.params.case.online
    starts = {
        "hot": (contest.imitator, online.beta),
        "cloned": (contest.clone, online.beta),
        "scratch": (contest.session.fresh_policy(), (contest.limits.dense.beta, *online.beta[1:])),
    }
    return pd.concat([_explore(contest, name, *start) for name, start in starts.items()], ignore_index=True)


def _explore(contest: Contest, run: str, start: LSTMPolicy, betas: tuple[float, ...]) -> pd.DataFrame:
    session = contest.session
    generator = session.stream("limits", "safety")
    epochs = [session.epochs(n_epochs) for n_epochs in session.params.case.online.epochs]
    learner = session.online_learner(copied(start), contest.batch, sum(epochs), generator, from_scratch=run == "scratch")
    frames = []
    for n_epochs, beta in zip(epochs, betas, strict=True):
        reward = learner.tracking(beta)
        for _ in range(n_epochs):  # of Algorithm 1
            twin = torch.Generator().set_state(generator.get_state())
            batch = learner.realise()
            learner.ascend(batch, learner.advantage(reward(batch), batch))
            paired = contest.returns(rollout(session.process, session.expert, session.task, contest.batch, twin))
            earned = contest.returns(batch).numpy()
            columns = {"run": run, "epoch": learner.epochs, "objective": earned, "expert": paired.numpy()}
            frames.append(pd.DataFrame(columns))
    episodes = pd.concat(frames, ignore_index=True)
    return episodes.assign(episode=np.arange(1, len(episodes) + 1))[["run", "epoch", "episode", "objective", "expert"]]


def safety(episodes: pd.DataFrame) -> pd.DataFrame:
    """The price of exploring: a row for each run.

    worst: the least objective of an episode, worst_expert: the PID's on the same draws; worse: the share of episodes worse than
    the PID's; regret: the sum of what they earned less than the PID (negative: more), regret_peak: the greatest sum on the way,
    regret_episodes: the sum in mean episodes of the PID.
    """
    rows = []
    for run, group in episodes.groupby("run", sort=False):
        lost = group["expert"] - group["objective"]
        row = {"run": run, "episodes": len(group), "worst": group["objective"].min(), "worst_expert": group["expert"].min()}
        row |= {"worse": (lost > 0).mean(), "regret": lost.sum(), "regret_episodes": lost.sum() / group["expert"].mean()}
        rows.append(row | {"regret_peak": lost.cumsum().max()})
    return pd.DataFrame(rows)
