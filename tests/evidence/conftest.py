"""Sessions of notebooks 06 and 08 at a size of their own: one epoch and few trajectories."""

import shutil

import pytest
from ruamel.yaml import YAML

from helpers.evidence.experiments import prepare
from helpers.runs.session import open_session

FEW = {"epoch_share": 0.001, "episodes": 4, "measured": 2, "evaluation": 20, "expert_evaluation": 20}


@pytest.fixture(scope="session")
def short(root, tmp_path_factory):
    """A session of a case with those parameters."""
    folder = shutil.copytree(root, tmp_path_factory.mktemp("files") / "params")
    yaml = YAML(typ="safe", pure=True)
    content = yaml.load(folder / "learning.yaml")
    for name, value in FEW.items():
        content["scales"]["smoke"][name]["value"] = value
    yaml.dump(content, folder / "learning.yaml")

    def build(case, notebook="08_claims"):
        roots = {"params_root": str(folder), "input_root": "", "output_root": ""}
        return open_session(notebook, {"case": case, "seed": 0, "scale": "smoke", **roots})

    return build


@pytest.fixture(scope="session")
def prepared(short):
    """What the experiments of a case start from."""
    return lambda case=1: prepare(short(case))
