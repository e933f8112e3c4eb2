"""A critic for online learning: what the plant's own episodes say about the next reward. Ours, not the paper's.

REINFORCE, Eq. 3.2.4, learns from returns alone, and every later disturbance blurs them. But the tracking reward, Eq. 5.1.2.1, is
a known function of the next error. Only how that follows from observation and input has to be learned, and least squares over
all episodes so far learns it, e_{t+1} ~ N(W (1, y_t, u_t), a + b y_t^2), loop by loop. The expected reward q(y, u) then has a
closed form, and its gradient in the input leads that of the policy (deterministic policy gradient, Silver et al. 2014), alone or
together with REINFORCE's (interpolated policy gradient, Gu et al. 2017, arXiv 1706.00387). It sees one sample ahead, as minimum
variance does.
"""

import torch
from torch import Tensor

from helpers.learning.features import FeatureMap
from helpers.plant.task import Trajectories

RIDGE = 1e-9  # share of each regressor's own size
LEAST = 1e-5  # variance of a normalised error, below which none is believed


class Critic:
    """The expected tracking reward of the next sample, learned anew from all episodes each time there are more.

    Args:
        features: whose errors are rewarded.
    """

    def __init__(self, features: FeatureMap) -> None:
        self.features = features
        self.batches: list[tuple[Tensor, Tensor]] = []

    def learn(self, batch: Trajectories) -> None:
        """Fit mean and variance of the next normalised error to these episodes and all before them."""
        seen = torch.cat([torch.ones_like(batch.u[..., :1]), batch.y[:-1], batch.u], dim=-1)
        self.batches.append((seen.flatten(0, 1).double(), self.features.errors(batch).flatten(0, 1).double()))
        x, error = (torch.cat(part) for part in zip(*self.batches, strict=True))
        self.mean = _regressed(x, error)
        spread = (error - x @ self.mean) ** 2
        n_y = error.shape[1]
        scale = torch.stack([torch.ones_like(error), x[:, 1 : 1 + n_y] ** 2], dim=-1)  # of each loop 1 and y^2
        self.variance = _regressed(scale.transpose(0, 1), spread.T[..., None])[..., 0]

    def value(self, y: Tensor, u: Tensor, beta: float) -> Tensor:
        """q: the expected sum of exp(-(beta e)^2) over the loops one sample after y (..., n_y) and u (..., n_u); shape (...)."""
        mean, variance = self.mean.to(y.dtype), self.variance.to(y.dtype)
        expected = torch.cat([torch.ones_like(u[..., :1]), y, u], dim=-1) @ mean
        wide = 1 + 2 * beta**2 * (variance[:, 0] + variance[:, 1] * y**2).clamp(min=LEAST)
        return (torch.exp(-((beta * expected) ** 2) / wide) / wide.sqrt()).sum(-1)


def _regressed(design: Tensor, target: Tensor) -> Tensor:
    """Least squares by the normal equations, which, unlike torch's own, give the same bits wherever the arrays lie in memory."""
    products = design.mT @ design
    ridge = RIDGE * products.diagonal(dim1=-2, dim2=-1).clamp(min=1.0).diag_embed()  # an input that stood still has no effect
    return torch.linalg.solve(products + ridge, design.mT @ target)
