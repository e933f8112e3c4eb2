"""Sessions of notebooks 06 and 08 at a size of their own: one epoch and few trajectories."""

from dataclasses import replace

import pytest

from helpers.evidence.experiments import prepare
from helpers.runs.session import open_session

FEW = {"epoch_share": 0.001, "episodes": 4, "measured": 2, "evaluation": 20, "expert_evaluation": 20}


@pytest.fixture(scope="session")
def opened(root, tmp_path_factory):
    """A session of a notebook at smoke scale, with results of its own."""

    def build(notebook, **given):
        roots = {"params_root": str(root), "input_root": "", "output_root": str(tmp_path_factory.mktemp("results"))}
        return open_session(notebook, {"seed": 0, "scale": "smoke"} | roots | given)

    return build


@pytest.fixture(scope="session")
def short(opened, tmp_path_factory):
    """A session of a case with those parameters; all in one folder, so that nothing is trained twice."""
    folder = str(tmp_path_factory.mktemp("short"))

    def build(case, notebook="08_claims"):
        session = opened(notebook, case=case, output_root=folder)
        return replace(session, scale_params=session.scale_params.model_copy(update=FEW))

    return build


@pytest.fixture(scope="session")
def prepared(short):
    """What the experiments of a case start from."""
    return lambda case=1: prepare(short(case))
