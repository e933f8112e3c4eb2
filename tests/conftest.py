"""Fixtures shared by the tests: the committed parameters and the objects that they describe, in float64."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from helpers.learning.features import FeatureMap
from helpers.learning.learner import Learner
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import PID
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import stream
from helpers.plant.task import ControlTask
from helpers.settings.paper import LearnerParams, Params, load

torch.set_num_threads(1)
LONGEST = ("test_notebooks.py", "test_report.py", "test_run.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, so that processes side by side end together."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@dataclass(frozen=True)
class Study:
    """A case study ready to run."""

    params: Params
    process: LinearProcess
    task: ControlTask
    features: FeatureMap
    pid: PID

    def policy(self, seed: int = 0, **changes: object) -> LSTMPolicy:
        """A fresh policy; `changes` replace entries of its parameters."""
        return LSTMPolicy.initial(self.params.learning.policy.model_copy(update=changes), self.task, stream(seed, "policy"))

    def learner(self, policy: LSTMPolicy, n_episodes: int, total_epochs: int, params: LearnerParams, seed: int = 0) -> Learner:
        """A learner for that policy."""
        return Learner(policy, self.process, self.features, params, n_episodes, total_epochs, stream(seed, "learner"))


def assemble(params: Params, dtype: torch.dtype) -> Study:
    """The objects that the parameters describe."""
    process = LinearProcess(params.process, dtype)
    task = ControlTask.from_params(params.process, params.case, dtype)
    features = FeatureMap(params.features, task, params.process.sampling_time)
    return Study(params, process, task, features, PID(params.demonstrator, task.set_point, params.process.sampling_time))


@pytest.fixture(scope="session")
def root() -> Path:
    """The committed parameter files."""
    return Path(__file__).resolve().parents[1] / "params"


@pytest.fixture(scope="session")
def study(root: Path) -> Callable[..., Study]:
    """Case study `case`; changes replace entries of process.yaml (`process`) or of the case file (`case_study`)."""

    def build(
        case: int = 1, dtype: torch.dtype = torch.float64, process: dict | None = None, case_study: dict | None = None
    ) -> Study:
        params = load(root, case)
        values = {**vars(params)}
        values["process"] = params.process.model_copy(update=process or {})
        values["case"] = params.case.model_copy(update=case_study or {})
        return assemble(Params(**values), dtype)

    return build


@pytest.fixture(scope="session")
def synthetic(root: Path) -> Callable[..., Study]:
    """A made-up stable process with any number of controlled and manipulated variables, without noise where asked."""

    def build(n_controlled: int, n_manipulated: int, n_steps: int = 12, noise: float = 0.1) -> Study:
        params = load(root, 1)
        mixing = torch.rand(n_controlled, n_manipulated, generator=stream(0, "synthetic")) + 1.0
        drift = -torch.eye(n_controlled) - 0.1
        process = params.process.model_copy(
            update={
                "controlled": tuple(f"y{index}" for index in range(n_controlled)),
                "manipulated": tuple(f"u{index}" for index in range(n_manipulated)),
                "drift_state": tuple(map(tuple, drift.tolist())),
                "drift_input": tuple(map(tuple, mixing.tolist())),
                "disturbance": (noise,) * n_controlled,
                "observation_noise": (noise / 10,) * n_controlled,
                "sampling_time": 0.1,
                "horizon": n_steps,
                "input_low": (-4.0,) * n_manipulated,
                "input_high": (6.0,) * n_manipulated,
            }
        )
        case = params.case.model_copy(
            update={
                "set_point": tuple(1.0 + index for index in range(n_controlled)),
                "steady_state": (0.0,) * n_controlled,
                "initial_mean": (0.0,) * n_controlled,
                "initial_std": (noise,) * n_controlled,
            }
        )
        gains = params.demonstrator.model_copy(
            update={name: (gain,) * n_controlled for name, gain in (("proportional", 2.0), ("integral", 1.0), ("derivative", 0.0))}
        )
        policy = params.learning.policy.model_copy(update={"error_unit": (0.5,) * n_controlled})
        learning = params.learning.model_copy(update={"policy": policy})
        return assemble(Params(process, gains, params.features, learning, case, ()), torch.float64)

    return build
