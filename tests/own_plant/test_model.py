"""What may stand for a plant: the identified model, a class of one's own, a gymnasium environment; refusals in one sentence."""

import sys
import types

import numpy as np
import pytest
import torch

from helpers.own_plant.description import load_description
from helpers.own_plant.model import load_plant
from helpers.plant.rollout import rollout
from helpers.settings.leaf import InputError
from tests.own_plant.plants import MadeUpPlant
from tests.plant.test_rollout import Constant


@pytest.fixture
def description(tmp_path):
    return load_description(MadeUpPlant(1, 2, n_cycles=1).write(tmp_path))


class Own:
    n_states, n_outputs, n_inputs, n_disturbances = 2, 1, 2, 2

    def __init__(self, description):
        self.title = description.title

    def step(self, x, u, noise):
        return x + u

    def observe(self, x, noise):
        return x[:, :1]


@pytest.fixture
def own(monkeypatch):
    module = types.ModuleType("own_module")
    module.Own = Own
    monkeypatch.setitem(sys.modules, "own_module", module)
    return module


def test_a_class_of_one_s_own_is_found_by_its_import_path(own, description):
    plant = load_plant("own_module:Own", description)
    task = description.task(torch.zeros(2), torch.zeros(2), torch.float64)
    batch = rollout(plant, Constant([0.5, 1.0]), task, 3, torch.Generator())
    assert batch.y[:3, 0, 0].tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"step": None}, "lacks 'step'"),
        ({"n_inputs": 3}, "'n_inputs' is 3, the description has 2"),
        ({"observe": lambda self, x, noise: x}, r"'observe' gave the shape \(1, 2\), expected \(1, 1\)"),
    ],
)
def test_a_class_that_does_not_fit_is_refused(own, description, changes, says):
    body = {key: value for key, value in ({**vars(Own)} | changes).items() if value is not None}
    own.Own = type("Own", (), body)
    with pytest.raises(InputError, match=says):
        load_plant("own_module:Own", description)


NO_CLASS, NO_ENVIRONMENT = r"expected package\.module:Class", "plant 'gymnasium:.*': it cannot be made: "


@pytest.mark.parametrize(
    ("name", "says"),
    [(name, NO_CLASS) for name in ("no_such_module:Plant", "helpers.own_plant.model:Nothing", "helpers.own_plant.model")]
    + [(f"gymnasium:{name}", NO_ENVIRONMENT) for name in ("NoSuch-v0", "CartPole-v999", "no_such_module:Env-v0", "")],
)
def test_what_cannot_be_imported_or_made_is_refused(description, name, says):
    if name.startswith("gymnasium"):
        pytest.importorskip("gymnasium")
    with pytest.raises(InputError, match=says):
        load_plant(name, description)


def test_a_gymnasium_environment_runs_in_engineering_units(description):
    gymnasium = pytest.importorskip("gymnasium")

    class Environment(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0.0, 100.0, (1,), np.float64)
        action_space = gymnasium.spaces.Box(0.0, 100.0, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.y = 50.0 + self.np_random.normal(size=1)
            return self.y, {}

        def step(self, action):
            self.y = self.y + 0.1 * (action.sum() - 41.0)
            return self.y, 0.0, False, False, {}

    gymnasium.register("Made/Up-v0", entry_point=Environment, disable_env_checker=True)
    plant = load_plant("gymnasium:Made/Up-v0", description)
    task = description.task(torch.zeros(1), torch.zeros(1), torch.float64)
    first, second = (rollout(plant, Constant([1.0, 2.0]), task, 4, torch.Generator().manual_seed(0)) for _ in range(2))
    assert first.y[0].std() > 0.1
    assert torch.equal(first.y, second.y)
    # The inputs rest at 20 and 21; with deviations of 1 and 2 the output rises by 0.3 a sample.
    assert (first.y[-1] - first.y[0]).squeeze(1).tolist() == pytest.approx([0.3 * task.n_steps] * 4)
    with pytest.raises(InputError, match=r"expected observations of shape \(1,\)"):
        load_plant("gymnasium:CartPole-v1", description)
