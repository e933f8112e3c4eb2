"""The critic of online learning: what it learns of the plant, and where it leads the policy."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.critic import Critic
from helpers.learning.learner import TrainingError
from helpers.plant.rollout import rollout


def test_the_critic_finds_the_expected_reward_of_the_next_sample(study):
    """Against the process itself: the mean reward over many disturbances from the same state and input."""
    case = study(1, process={"horizon": 20})
    features, process = case.features.on("x"), case.process
    batch = rollout(process, case.expert, case.task, 2000, torch.Generator().manual_seed(0))
    normal = partial(torch.randn, generator=torch.Generator().manual_seed(1), dtype=batch.u.dtype)
    u = batch.u + normal(batch.u.shape)
    x = torch.stack([process.step(state, entry, normal(len(state), 8)) for state, entry in zip(batch.x[:-1], u, strict=True)])
    critic = Critic(features)
    critic.learn(replace(batch, u=u, y=batch.x, x=torch.cat([batch.x[:1], x])))  # each step of its own, seen without noise
    state = case.task.set_point * torch.tensor([[1.0, 1.0], [0.95, 1.05]], dtype=u.dtype)
    entry = case.minimum_variance.act(state, None)[0] + torch.tensor([[0.0, 0.0], [0.1, 5.0]], dtype=u.dtype)
    after = torch.stack([process.step(state, entry, normal(2, 8)) for _ in range(5000)])
    truth = torch.exp(-((30.0 * (case.task.set_point - after) / case.task.error_scale) ** 2)).sum(-1).mean(0)
    assert torch.allclose(critic.value(state, entry, 30.0), truth, rtol=0.1)


def test_the_critic_leads_the_policy_where_few_returns_do_not(study):
    """Forty episodes of Case I: the mean return after eight epochs, with the same draws; REINFORCE alone hardly moves."""
    case = study(1, torch.float32)
    online = case.params.learning.online

    def reached(share):
        params = online.learner.model_copy(update={"critic": share})
        learner = case.learner(case.policy(std_low=0.01), 5, 8, params)
        return algorithm_1(learner, learner.tracking(3.0), 8)[-1].mean_return

    assert reached(1.0) > 1.2 * reached(0.0)


def test_without_a_tracking_reward_the_critic_is_silent(case):
    params = case.params.learning.online.learner.model_copy(update={"critic": 1.0})
    learner = case.learner(case.policy(), 5, 1, params)
    algorithm_1(learner, partial(case.features.tracking, beta=3.0), 1)
    assert not learner.critic.batches
    batch = learner.realise()
    nothing = torch.zeros(batch.n_steps, 5, dtype=batch.x.dtype)
    with pytest.raises(TrainingError, match="the same reward"):
        learner.advantage(nothing, batch)
    learner.tracking(3.0)
    assert not learner.advantage(nothing, batch).any()  # led by the critic alone, it asks for no difference between episodes
