"""params/limits.yaml: it loads, and what is wrong with it is one sentence that names file and key."""

import shutil

import pytest
from ruamel.yaml import YAML

from helpers.settings.leaf import ParameterError
from helpers.settings.limits import load_limits
from helpers.settings.paper import load


def changed(root, folder, *path, value):
    """The parameter files with one leaf of limits.yaml changed."""
    shutil.copytree(root, folder, dirs_exist_ok=True)
    yaml = YAML(typ="safe", pure=True)
    content = yaml.load(folder / "limits.yaml")
    leaf = content
    for key in path:
        leaf = leaf[key]
    leaf["value"] = value
    yaml.dump(content, folder / "limits.yaml")
    return folder


@pytest.mark.parametrize("case", [1, 2, 3])
def test_the_committed_file_fits_every_case(root, case):
    record = load_limits(root, load(root, case))
    assert {"paper", "smoke"} <= set(record.scales)
    assert record.attainable.betas == (10.0, 30.0)


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("attainable", "nodes"), 0, "attainable.nodes"),
        (("quality", "order"), 150, "quality.order.*at_rest"),
        (("quality", "n_last"), 51, "quality.n_last.*50 samples"),
        (("scales", "smoke", "states"), [11], "'states' and 'inputs' differ"),
        (("scales", "smoke", "listed"), [0, 70], "multiples of 'every'"),
        (("robustness", "improve_state"), [1.3], "'improve_state' and 'improve_input' differ"),
        (("robustness", "load"), "much", "robustness.load"),
    ],
)
def test_what_is_wrong_is_one_sentence(root, tmp_path, path, value, says):
    folder = changed(root, tmp_path / "params", *path, value=value)
    with pytest.raises(ParameterError, match=says) as raised:
        load_limits(folder, load(folder, 1))
    assert "limits.yaml" in str(raised.value)
    assert "\n" not in str(raised.value)
