"""Algorithm 1: REINFORCE with a baseline, Section 3.2, and its use online, Section 5.1.2."""

from collections.abc import Callable, Sequence

from torch import Tensor

from helpers.learning.learner import EpochRecord, Learner
from helpers.plant.task import Trajectories

Reward = Callable[[Trajectories], Tensor]  # of a batch: R_1..R_T of each trajectory, shape (T, K)
Watch = Callable[[EpochRecord], object]  # called with the record of each epoch


def algorithm_1(
    learner: Learner, reward: Reward, n_epochs: int, patience: int = 0, watch: Watch = lambda record: None
) -> list[EpochRecord]:
    """At most `n_epochs` epochs of policy optimisation under one reward.

    The printed algorithm ends when the policy no longer gets better: with `patience` > 0, once that many epochs in a row brought
    no better mean return.

    Raises:
        TrainingError: if the return or the gradient is not finite.
    """
    records: list[EpochRecord] = []
    while len(records) < n_epochs and not stalled(records, patience):
        tau = learner.realise()  # 1. K episodes of T steps under pi_theta
        R = reward(tau)  #           R_1..R_T, Eq. 4.2.5 offline, 5.1.2.1 online
        A = learner.advantage(R, tau)  # G - b as printed; ours, where credit is not whole_return: reward-to-go less a regression
        learner.ascend(
            tau, A
        )  # 2. theta <- theta + omega / K sum_k A^k grad sum_t ln pi(u_t | y_t), Eq. 3.2.4; ours: Adam, a critic
        records.append(learner.record(R, tau))
        watch(records[-1])
    return records


def stalled(records: Sequence[EpochRecord], patience: int) -> bool:
    """Whether the best mean return is `patience` epochs old; of equals the last counts. Without patience never."""
    if not (patience and records):
        return False
    best = max(range(len(records)), key=lambda index: (records[index].mean_return, index))
    return len(records) - 1 - best >= patience


def improve_online(
    learner: Learner, epochs: Sequence[int], betas: Sequence[float], watch: Watch = lambda record: None
) -> list[EpochRecord]:
    """Online learning, Section 5.1.2: rounds of Algorithm 1 under the tracking objective, each with its own beta."""
    records: list[EpochRecord] = []
    for n_epochs, beta in zip(epochs, betas, strict=True):
        records += algorithm_1(learner, learner.tracking(beta), n_epochs, learner.params.patience, watch)
    return records
