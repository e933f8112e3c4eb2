"""The control task holds what Table 1 and the input bounds say; the record of a batch checks its shapes at birth."""

import pytest
import torch

from helpers.plant.task import Trajectories


@pytest.mark.parametrize(("case", "set_point"), [(1, [-1.0, 4.0]), (2, [1.0, 4.0]), (3, [-2.5, 3.0])])
def test_set_points_of_table_1(study, case, set_point):
    task = study(case, torch.float32).task
    assert torch.equal(task.set_point, torch.tensor(set_point))
    assert torch.equal(task.error_scale, task.set_point)  # the steady state is the origin
    assert task.initial_mean.tolist() == [0.0, 0.0]
    assert {getattr(task, name).dtype for name in ("error_scale", "initial_std", "input_low", "input_high")} == {torch.float32}


SHAPES = {"x": (6, 4, 3), "y": (6, 4, 2), "u": (5, 4, 1), "command": (5, 4, 1)}


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("x", (5, 4, 3)),  # no final state
        ("x", (6, 3, 3)),  # a trajectory too few
        ("y", (5, 4, 2)),
        ("y", (6, 4)),  # no axis of variables
        ("u", (6, 4, 1)),  # an input after the last state
        ("command", (5, 4, 2)),
    ],
)
def test_shapes_that_do_not_fit_together_are_refused(name, shape):
    with pytest.raises(ValueError, match=rf"trajectories: .*\b({name}|u)\b"):
        Trajectories(**{signal: torch.zeros(size) for signal, size in (SHAPES | {name: shape}).items()})
