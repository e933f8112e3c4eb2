"""The record of a batch of trajectories checks its shapes at birth."""

from dataclasses import FrozenInstanceError

import pytest
import torch

from helpers.plant.task import Trajectories

SHAPES = {"x": (6, 4, 3), "y": (6, 4, 2), "u": (5, 4, 1), "command": (5, 4, 1)}


def build(**changes):
    return Trajectories(**{name: torch.zeros(shape) for name, shape in {**SHAPES, **changes}.items()})


def test_counts_are_those_of_the_inputs():
    trajectories = build()
    assert (trajectories.n_steps, trajectories.n_trajectories) == (5, 4)


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
