"""Behavioural cloning: its loss by hand, that it learns, and that what is held back is not learned from."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector

from helpers.learning.cloning import clone, cloning_loss
from helpers.learning.learner import TrainingError
from helpers.plant.rollout import rollout, stream
from helpers.settings.evidence import load_experiments


@pytest.fixture
def params(root, study):
    return load_experiments(root, study().params).cloning


@pytest.fixture
def demonstrations(case):
    return rollout(case.process, case.pid, case.task, 12, stream(0, "demonstrations"))


def test_loss_of_a_policy_that_always_gives_the_same_input(case, demonstrations):
    policy = case.policy()
    with torch.no_grad():
        policy.output.weight.zero_()
        policy.output.bias[:2] = torch.tensor([3.0, 1.5])  # of the six of ReLU6: the middle and a quarter of the range
    rows = torch.tensor([7, 2, 4])
    low, high = np.array(case.params.process.input_low), np.array(case.params.process.input_high)
    given = low + (high - low) * np.array([0.5, 0.25])
    assert not torch.equal(demonstrations.u[:, rows], demonstrations.command[:, rows])  # as applied, not as asked for
    expected = (((demonstrations.u[:, [7, 2, 4]].numpy() - given) / (high - low)) ** 2).mean()
    assert cloning_loss(policy, demonstrations, rows, case.task).item() == pytest.approx(expected, rel=1e-12)


def test_cloning_learns_and_repeats(case, demonstrations, params):
    held = torch.arange(10, 12)  # a fifth of twelve, rounded
    before = cloning_loss(case.policy(), demonstrations, held, case.task).item()
    runs = [clone(case.policy(), demonstrations, case.task, params, 75, stream(1)) for _ in range(2)]
    assert runs[0].loss < before / 2
    assert torch.equal(parameters_to_vector(runs[0].policy.parameters()), parameters_to_vector(runs[1].policy.parameters()))
    assert cloning_loss(runs[0].policy, demonstrations, held, case.task).item() == pytest.approx(runs[0].loss, rel=1e-12)


def test_what_is_held_back_is_not_learned_from(case, demonstrations, params):
    spoilt = copy.deepcopy(demonstrations)
    spoilt.u[:, 10:] = -spoilt.u[:, 10:]
    once = params.model_copy(update={"check_every": 6})  # only the last step is looked at
    found = [clone(case.policy(), data, case.task, once, 6, stream(1)) for data in (demonstrations, spoilt)]
    assert torch.equal(parameters_to_vector(found[0].policy.parameters()), parameters_to_vector(found[1].policy.parameters()))
    assert found[0].loss != found[1].loss


def test_the_step_with_the_least_loss_is_kept(case, demonstrations, params):
    wild = params.model_copy(update={"learning_rate_start": 0.5, "learning_rate_end": 0.5, "check_every": 1})
    found = clone(case.policy(), demonstrations, case.task, wild, 12, stream(1))
    assert found.chosen_step < 12
    assert clone(case.policy(), demonstrations, case.task, wild, found.chosen_step, stream(1)).loss == found.loss


def test_refusals(case, demonstrations, params):
    single = replace(demonstrations, **{name: signal[:, :1] for name, signal in vars(demonstrations).items()})
    with pytest.raises(TrainingError, match="two demonstrations or more, one of them to validate on, found 1"):
        clone(case.policy(), single, case.task, params, 1, stream(1))
    broken = replace(demonstrations, y=demonstrations.y * torch.nan)
    with pytest.raises(TrainingError, match="step 3: the loss is not finite"):
        clone(case.policy(), broken, case.task, params, 3, stream(1))
