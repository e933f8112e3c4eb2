"""Sessions of notebooks 06 and 08 at a size of their own: one epoch and few trajectories."""

from dataclasses import replace

import pytest

from helpers.evidence.experiments import prepare
from helpers.runs.session import open_session

FEW = {"epoch_share": 0.001, "episodes": 4, "measured": 2, "evaluation": 20, "expert_evaluation": 20}


@pytest.fixture(scope="session")
def short(root, tmp_path_factory):
    """A session of a case with those parameters."""
    roots = {"params_root": str(root), "input_root": "", "output_root": str(tmp_path_factory.mktemp("results"))}

    def build(case, notebook="08_claims"):
        session = open_session(notebook, {"case": case, "seed": 0, "scale": "smoke", **roots})
        return replace(session, scale_params=session.scale_params.model_copy(update=FEW))

    return build


@pytest.fixture(scope="session")
def prepared(short):
    """What the experiments of a case start from."""
    return lambda case=1: prepare(short(case))
