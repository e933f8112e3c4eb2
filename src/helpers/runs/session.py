"""One run of a notebook for one case: a study whose trainings and results are kept on disk."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pandas as pd
import torch
from IPython.display import Markdown
from torch import Tensor

from helpers.learning.policy import LSTMPolicy
from helpers.runs import artifacts
from helpers.runs.finished import State
from helpers.runs.identity import inputs
from helpers.runs.opening import Run, checked, roots_of
from helpers.runs.request import SessionError
from helpers.runs.study import Demonstrations, Study
from helpers.settings.paper import HEADLINE, load_published


@dataclass(frozen=True, kw_only=True)
class Session(Run, Study):
    """One run of a notebook for one case."""

    case: int

    def expect_transfer(self, expected: bool) -> None:
        """Refuse a case that belongs to another notebook: one that starts from another case, or one that does not."""
        if (self.params.case.offline.transfer_from is not None) != expected:
            rule = "names a case to start from" if not expected else "names no case to start from"
            other = "04_knowledge_transfer" if not expected else "03_online_improvement"
            raise SessionError(
                f"notebooks/{self.notebook}.ipynb: parameter 'case': params/case_{self.case}.yaml {rule} "
                f"(key 'offline.transfer_from'), so it belongs to notebooks/{other}.ipynb"
            )

    def once(self, train: Callable[[], State], *start: Any) -> State:
        """A training of this run, or what it gave before the run was interrupted; see `Finished.once`.

        Args:
            start: all that it starts from beside the session's parameters.
        """
        return self.finished.once(train, self.params, *start)

    def load_demonstrations(self) -> Demonstrations:
        """What notebook 01 recorded for this case."""
        stage, process = self.load("demonstrations", "01_demonstrations"), self.params.process
        path, table = stage.path("demonstrations.csv"), stage.table("demonstrations.csv")
        trajectories = artifacts.trajectories_from_table(table, process.controlled, process.manipulated, self.dtype, path)
        rows = stage.table("scores.csv", ("stage", "metric", "value"))
        return Demonstrations(trajectories, rows.set_index("metric")["value"])

    def load_policy(self, stage: str, made_by: str, case: int | None = None) -> tuple[LSTMPolicy, Tensor]:
        """The policy and the weights alpha* of an earlier offline stage, maybe of another case."""
        found = self.load(stage, made_by, case)
        weights, path = found.table("weights.csv", ("feature", "alpha")), found.path("weights.csv")
        if weights["feature"].tolist() != self.feature_names or not pd.api.types.is_numeric_dtype(weights["alpha"]):
            raise artifacts.ArtifactError(f"{path}: expected a number for each of {', '.join(self.feature_names)}")
        alpha = torch.tensor(weights["alpha"].to_numpy(), dtype=self.dtype)
        if not alpha.isfinite().all():
            raise artifacts.ArtifactError(f"{path}: column 'alpha': expected finite numbers")
        return found.policy(self.params.learning, self.task), alpha

    def banner(self) -> Markdown:
        """What kind of run this is, for the top of the notebook."""
        return self.banner_of(self.params.case.title, "epochs", f"_case_{self.case}")

    def settings(self) -> pd.DataFrame:
        """What the notebook was run with."""
        return self.settings_table(self.scale_params)


def open_session(notebook: str, namespace: dict[str, Any]) -> Session:
    """Check what the notebook was given, and set the scale up.

    Args:
        notebook: its name without ending.
        namespace: its `globals()`, taken before anything else was defined, so that a misspelt parameter is found:
            papermill itself only logs a warning and runs on with the defaults.

    Raises:
        SessionError, ParameterError: in one sentence.
    """
    given, params = checked(notebook, namespace)
    roots = roots_of(given)
    scale, variant, case = given["scale"], given.get("variant", HEADLINE), given.get("case", 1)
    return Session(
        notebook=notebook,
        seed=given["seed"],
        scale=scale,
        **roots,
        made_from=inputs(notebook, roots["params_root"], scale, case, variant),
        case=case,
        variant=variant,
        params=params,
        scale_params=params.learning.scales[scale],
        published=load_published(roots["params_root"]).get(case),
    )
