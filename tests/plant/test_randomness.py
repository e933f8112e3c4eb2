"""Random streams: each depends on its seed and purpose alone."""

import numpy as np
import pytest
import torch

from helpers.plant.rollout import stream


def draw(*arguments, n=1000):
    return torch.randn(n, generator=stream(*arguments), dtype=torch.float64)


def test_the_same_purpose_gives_the_same_numbers_bit_for_bit():
    first = draw(3, "case", 1, "rollout")
    torch.manual_seed(99)  # the global generator plays no part
    stream(3, "another purpose")
    assert torch.equal(first, draw(3, "case", 1, "rollout"))


@pytest.mark.parametrize("other", [(4, "case", 1), (3, "case", 2), (3, "cas", "e1"), (3, 1, "case"), (3, "case"), (3,)], ids=str)
def test_another_seed_or_purpose_gives_unrelated_numbers(other):
    first, second = draw(3, "case", 1, n=10_000), draw(*other, n=10_000)
    correlation = np.corrcoef(first, second)[0, 1]
    assert abs(correlation) < 5 / np.sqrt(10_000)


def test_many_seeds_do_not_collide():
    starts = {draw(seed, "purpose", n=1).item() for seed in range(500)}
    assert len(starts) == 500


def test_drawing_leaves_the_global_generator_alone():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    draw(0, "anything")
    assert torch.equal(before, torch.get_rng_state())
