"""The trained policies of the published run: `load_policy("case_1_online")` gives one, ready for the simulated plant.

Each is a safetensors file in reports/reference/policies whose header holds its card: what it was trained on, where, and its score.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

from helpers.learning.policy import LSTMPolicy
from helpers.learning.tracking_policy import Gains, TrackingPolicy
from helpers.plant.tracking import Bounds
from helpers.runs.artifacts import ArtifactError
from helpers.runs.sources import PROJECT
from helpers.runs.study import Study
from helpers.settings.paper import PolicyParams, load

FOLDER = PROJECT / "reports/reference/policies"


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy of a finished run, and its card: `scores` holds J of it and its rivals by case."""

    policy: LSTMPolicy | TrackingPolicy
    card: dict[str, Any]

    def study(self, case: int | None = None, params_root: Path = PROJECT / "params") -> Study:
        """The simulated plant of a case that the policy was trained for, the first of them unless given."""
        case = case or self.card["cases"][0]
        params = load(params_root, case)
        scale = params.learning.scales[self.card["scale"]]
        return Study(params=params, scale_params=scale, seed=self.card["seed"], case=case)


def load_policy(name: str, folder: Path | None = None) -> TrainedPolicy:
    """A policy by its name, loaded without executing code; `folder`: where it lies, if not among the published ones.

    Raises:
        ArtifactError: if there is no policy of that name, or its file is damaged.
    """
    folder = folder or FOLDER
    path = folder / f"{name}.safetensors"
    if not path.is_file():
        known = ", ".join(sorted(found.stem for found in folder.glob("*.safetensors"))) or "none yet"
        raise ArtifactError(f"{path}: there is no such policy; the policies are: {known}")
    try:
        with safe_open(path, "pt") as file:
            card = json.loads(file.metadata()["card"])
            state = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118 (not a dictionary)
        return TrainedPolicy(rebuilt(PolicyParams.model_construct(**card["policy"]), state), card)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ArtifactError(f"{path}: not a policy of this project: {' '.join(str(error).split())[:200]}") from error


def rebuilt(params: PolicyParams, state: dict[str, Tensor]) -> LSTMPolicy | TrackingPolicy:
    """The policy with this state; which kind it is, and its shapes, the state tells."""
    policy: LSTMPolicy | TrackingPolicy
    if "integral" in state:
        gains, bounds = Gains(*[state["integral"]] * 3), Bounds(state["low"], state["high"], state["high"])  # its rate is not used
        kept = 0.5 if "kept_logit" in state else None  # the patient form; its value is in the state
        policy = TrackingPolicy(params, gains, state["unit"], state["centre"], state["reach"], bounds, kept)
    else:
        n_u = len(state["output.bias"]) // 2  # of each input the mean and the standard deviation
        policy = LSTMPolicy(params, state["layers.0.weight_ih_l0"].shape[1] - n_u, n_u).to(state["output.bias"].dtype)
    policy.load_state_dict(state)
    return policy
