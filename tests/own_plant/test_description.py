"""The description of a plant: what it gives, and how wrong ones are refused in one sentence that names file and key."""

import copy

import pytest
import torch

from helpers.own_plant.description import load_description
from helpers.own_plant.tank import load_tank
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import ParameterError
from tests.own_plant.plants import MadeUpPlant

PLANT = MadeUpPlant(2, 2, n_cycles=1)


def changed(*path, value):
    content = copy.deepcopy(PLANT.content)
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return content


def test_the_committed_description_gives_the_task_of_case_study_one_with_its_own_bounds(study, root):
    description = load_description(PROJECT / "notebooks/plant/tank.yaml")
    expected = study().task
    task = description.task(torch.zeros(2), torch.ones(2), torch.float64)
    assert task.set_point.tolist() == expected.set_point.tolist()
    assert task.error_scale.tolist() == expected.error_scale.tolist()
    tank, params = load_tank(root, study().params.process)
    history = params.history
    assert task.input_low.tolist() == pytest.approx(history.input_low)
    assert task.input_high.tolist() == pytest.approx(history.input_high)
    for kind in ("controlled", "manipulated"):
        assert description.values(kind, "steady_state") == pytest.approx(getattr(tank.steady, kind), abs=1e-3)
    assert [loop.proportional for loop in description.pid] == list(history.proportional)
    assert [loop.integral for loop in description.pid] == list(history.integral)
    assert task.n_steps == expected.n_steps
    aim = [description.transfer[variable.name] - variable.steady_state for variable in description.controlled]
    assert aim == list(history.other_set_point)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (changed("sampling_time", value=0.0), ["'sampling_time'", "greater than 0"]),
        (changed("sampling_time", value=1e308), ["'sampling_time'", "less than or equal to 1000000"]),
        (changed("separator", value="::"), ["'separator'"]),
        (changed("decimal", value=";"), ["'decimal'"]),
        (changed("encoding", value="klingon"), ["'encoding'", "latin-1"]),
        (changed("encoding", value="rot13"), ["'encoding'"]),
        (changed("colour", value="red"), ["'colour'", "unknown"]),
        (changed("controlled", 0, "low", value=100.0), ["'controlled.0'", "'low' must lie below 'high'"]),
        (changed("controlled", 1, "steady_state", value=-3.0), ["'controlled.1'", "'steady_state' lies outside"]),
        (changed("controlled", 1, "set_point", value=51.0), ["'controlled.1'", "give 'error_scale'"]),
        (changed("manipulated", 0, "rate", value=-1.0), ["'manipulated.0.rate'"]),
        (changed("manipulated", 1, "tag", value="U0.OP"), ["the tag 'U0.OP' occurs twice"]),
        (changed("controlled", 0, "tag", value="run"), ["'controlled.0.tag'", "found 'run'"]),
        (changed("controlled", 0, "set_point_tag", value="clock"), ["'controlled.0.set_point_tag'", "found 'clock'"]),
        (changed("manipulated", 1, "tag", value="row"), ["'manipulated.1.tag'", "other than the program's own columns"]),
        (changed("manipulated", 1, "name", value="y0"), ["the name 'y0' occurs twice"]),
        (changed("pid", 0, "manipulated", value="valve"), ["the manipulated variable 'valve', which is not described"]),
        (changed("controlled", value=[]), ["'controlled'"]),
        (changed("transfer", value={"u0": 51.0}), ["'transfer' names 'u0', which is no controlled variable"]),
        (changed("transfer", value={"y0": 1.0e9}), ["'transfer' takes 'y0' outside 'low' to 'high'"]),
        (changed("transfer", value={"y0": "far"}), ["'transfer.y0'"]),
    ],
)
def test_what_cannot_be_is_refused(content, says, tmp_path):
    path = PLANT.write(tmp_path, **content)
    with pytest.raises(ParameterError) as caught:
        load_description(path)
    sentence = str(caught.value)
    assert sentence.startswith(str(path))
    assert "\n" not in sentence
    assert all(words in sentence for words in says), sentence


def test_columns_that_hold_no_numbers_may_be_called_as_they_like(tmp_path):
    path = PLANT.write(tmp_path, time="clock", episode="run", mode="automatic")
    assert load_description(path).columns[:3] == ("clock", "run", "automatic")
