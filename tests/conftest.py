"""Fixtures shared by the tests: studies of the committed parameters, in float64."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers.learning.learner import Learner
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import PID
from helpers.plant.rollout import stream
from helpers.runs.study import Study
from helpers.settings.paper import LearnerParams, load

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
        self,
        policy: LSTMPolicy,
        n_episodes: int,
        n_epochs: int,
        params: LearnerParams,
        draws: torch.Generator | int = 0,
        *more: Any,
    ) -> Learner:
        """A learner for that policy; `draws`: its generator, or the seed of one."""
        generator = stream(draws, "learner") if isinstance(draws, int) else draws
        return super().learner(policy, n_episodes, n_epochs, params, generator, *more)


@pytest.fixture(scope="session")
def root() -> Path:
    """The committed parameter files."""
    return Path(__file__).resolve().parents[1] / "params"


@pytest.fixture(scope="session")
def study(root: Path) -> Callable[..., Case]:
    """Case study `case` at smoke scale; changes replace entries of process.yaml (`process`) or of the case file (`case_study`)."""

    def build(
        case: int = 1, dtype: torch.dtype = torch.float64, process: dict | None = None, case_study: dict | None = None
    ) -> Case:
        params = load(root, case)
        scale = params.learning.scales["smoke"].model_copy(update={"number_type": str(dtype).removeprefix("torch.")})
        filed = Case(params=params, scale_params=scale, seed=0, case="test")
        return filed.varied(process=process or {}, case=case_study or {})

    return build


@pytest.fixture
def case(study: Callable[..., Case]) -> Case:
    """Case study I as the files have it."""
    return study()
