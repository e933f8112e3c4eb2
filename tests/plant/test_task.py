"""The control task holds what Table 1 and the input bounds say; the record of a batch checks its shapes at birth."""

from dataclasses import FrozenInstanceError

import pytest
import torch

from helpers.plant.task import Trajectories


@pytest.mark.parametrize(("case", "set_point"), [(1, [-1.0, 4.0]), (2, [1.0, 4.0]), (3, [-2.5, 3.0])])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_set_points_of_table_1(study, case, set_point, dtype):
    task = study(case, dtype).task
    assert torch.equal(task.set_point, torch.tensor(set_point, dtype=dtype))
    assert torch.equal(task.error_scale, task.set_point)  # the steady state is the origin
    assert task.initial_mean.tolist() == [0.0, 0.0]
    assert task.n_steps == 50
    assert all(getattr(task, name).dtype == dtype for name in ("error_scale", "initial_std", "input_low", "input_high"))


@pytest.mark.equation("4.2.1")
@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"set_point": (3.0, -2.0), "steady_state": (1.0, 2.0)}, [2.0, -4.0]),
        ({"set_point": (0.0, 4.0), "error_scale": (0.5, 2.0)}, [0.5, 2.0]),  # a given one takes its place
    ],
)
def test_the_error_scale_is_the_change_of_set_point(study, given, expected):
    assert study(1, case_study=given).task.error_scale.tolist() == expected


SHAPES = {"x": (6, 4, 3), "y": (6, 4, 2), "u": (5, 4, 1), "command": (5, 4, 1)}


def build(**changes):
    return Trajectories(**{name: torch.zeros(shape) for name, shape in {**SHAPES, **changes}.items()})


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("x", (5, 4, 3)),  # no final state
        ("x", (6, 3, 3)),  # a trajectory too few
        ("y", (5, 4, 2)),
        ("y", (6, 4)),  # no axis of variables
        ("u", (6, 4, 1)),  # an input after the last state
        ("u", (5, 4, 2)),
        ("command", (5, 4, 2)),
        ("command", (4, 4, 1)),
    ],
)
def test_shapes_that_do_not_fit_together_are_refused(name, shape):
    with pytest.raises(ValueError, match=rf"trajectories: .*\b({name}|u)\b"):
        build(**{name: shape})


def test_the_record_is_frozen():
    with pytest.raises(FrozenInstanceError):
        build().x = torch.zeros(1)
