"""Fixtures shared by the tests: studies of the committed parameters, in float64."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers.learning.learner import Learner
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import PID
from helpers.plant.rollout import stream
from helpers.runs.study import Study
from helpers.settings.paper import LearnerParams, Params, load

torch.set_num_threads(1)
LONGEST = ("test_notebooks.py", "test_report.py", "test_run.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, so that processes side by side end together."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


class Case(Study):
    """A study with what tests ask for by short names."""

    @property
    def pid(self) -> PID:
        """The demonstrating controller."""
        return self.expert

    def policy(self, seed: int = 0, **changes: object) -> LSTMPolicy:
        """A fresh policy; `changes` replace entries of its parameters."""
        return LSTMPolicy.initial(self.params.learning.policy.model_copy(update=changes), self.task, stream(seed, "policy"))

    def learner(
        self, policy: LSTMPolicy, n_episodes: int, n_epochs: int, params: LearnerParams, draws: Any = 0, *more: Any
    ) -> Learner:
        """A learner for that policy; `draws`: its generator, or the seed of one."""
        generator = stream(draws, "learner") if isinstance(draws, int) else draws
        return super().learner(policy, n_episodes, n_epochs, params, generator, *more)


def of(params: Params, dtype: torch.dtype = torch.float64) -> Case:
    """A study at smoke scale."""
    scale = params.learning.scales["smoke"].model_copy(update={"number_type": str(dtype).removeprefix("torch.")})
    return Case(params=params, scale_params=scale, seed=0, case="test")


@pytest.fixture(scope="session")
def root() -> Path:
    """The committed parameter files."""
    return Path(__file__).resolve().parents[1] / "params"


@pytest.fixture(scope="session")
def study(root: Path) -> Callable[..., Case]:
    """Case study `case`; changes replace entries of process.yaml (`process`) or of the case file (`case_study`)."""

    def build(case: int = 1, dtype: torch.dtype = torch.float64, process: Any = None, case_study: Any = None) -> Case:
        return of(load(root, case), dtype).varied(process=process or {}, case=case_study or {})

    return build


@pytest.fixture(scope="session")
def synthetic(root: Path) -> Callable[..., Case]:
    """A made-up stable process with any number of controlled and manipulated variables, without noise where asked."""

    def build(n_controlled: int, n_manipulated: int, n_steps: int = 12, noise: float = 0.1) -> Case:
        params = load(root, 1)
        mixing = torch.rand(n_controlled, n_manipulated, generator=stream(0, "synthetic")) + 1.0
        drift = -torch.eye(n_controlled) - 0.1
        each: dict[str, Any] = {  # one entry a loop
            "disturbance": noise, "observation_noise": noise / 10, "steady_state": 0.0, "initial_mean": 0.0, "initial_std": noise,
            "proportional": 2.0, "integral": 1.0, "derivative": 0.0,
        }  # fmt: skip
        each = {name: (value,) * n_controlled for name, value in each.items()}
        each |= {"drift_state": tuple(map(tuple, drift.tolist())), "drift_input": tuple(map(tuple, mixing.tolist()))}
        each |= {"input_low": (-4.0,) * n_manipulated, "input_high": (6.0,) * n_manipulated}
        each |= {"set_point": tuple(1.0 + index for index in range(n_controlled)), "sampling_time": 0.1, "horizon": n_steps}
        for name, letter, number in (("controlled", "y", n_controlled), ("manipulated", "u", n_manipulated)):
            each[name] = tuple(f"{letter}{index}" for index in range(number))

        def changed(record):
            return record.model_copy(update={name: value for name, value in each.items() if name in type(record).model_fields})

        parts = {name: changed(getattr(params, name)) for name in ("process", "demonstrator", "case")}
        policy = params.learning.policy.model_copy(update={"error_unit": (0.5,) * n_controlled})
        learning = params.learning.model_copy(update={"policy": policy})
        return of(replace(params, **parts, learning=learning))

    return build
