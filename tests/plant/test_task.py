"""The control task holds what Table 1 and the input bounds say."""

import pytest
import torch


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
def test_the_error_scale_is_the_change_of_set_point(study):
    task = study(1, case_study={"set_point": (3.0, -2.0), "steady_state": (1.0, 2.0)}).task
    assert task.error_scale.tolist() == [2.0, -4.0]


def test_a_given_error_scale_takes_its_place(study):
    task = study(1, case_study={"set_point": (0.0, 4.0), "error_scale": (0.5, 2.0)}).task
    assert task.error_scale.tolist() == [0.5, 2.0]
