"""Plants that differ from the model in time."""

import torch

from helpers.evidence.mismatch import Delayed, LoadStep
from helpers.plant.rollout import rollout, stream


def test_the_load_comes_at_mid_horizon_in_every_batch(case):
    load = torch.tensor([0.5, -1.0], dtype=torch.float64)
    plant = LoadStep(case.process, case.task, load)
    half = case.task.n_steps // 2
    for batch in range(2):
        plain = rollout(case.process, case.pid, case.task, 3, stream(batch, "load"))
        loaded = rollout(plant, case.pid, case.task, 3, stream(batch, "load"))
        assert torch.equal(plain.x[: half + 1], loaded.x[: half + 1])
        assert torch.allclose(loaded.x[half + 1] - plain.x[half + 1], load.expand(3, -1))


def test_commands_arrive_late(case):
    plain = rollout(case.process, case.pid, case.task, 3, stream(0, "late"))
    late = rollout(case.process, Delayed(case.pid, case.task, 2), case.task, 3, stream(0, "late"))
    assert not late.command[:2].any()
    assert torch.allclose(late.command[2], plain.command[0])  # the first observation is the same
    none = rollout(case.process, Delayed(case.pid, case.task, 0), case.task, 3, stream(0, "late"))
    assert torch.equal(none.u, plain.u)
