"""What is measured: each subject is one repeatable piece of work and the number of learnt steps that it stands for."""

import importlib
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.one_at_a_time import OneAtATime
from benchmarks.side_by_side import PROCESSES, SideBySide
from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.algorithm_2 import apprentice_reward, initial_weights
from helpers.learning.features import FeatureMap
from helpers.learning.learner import Learner
from helpers.learning.policy import LSTMPolicy
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import stream
from helpers.plant.task import ControlTask
from helpers.settings.paper import LearnerParams, Params, load

PROJECT = Path(__file__).resolve().parents[1]
OURS, OURS_AS_SET, ONE_AT_A_TIME = "ours", "ours, with the minibatches of the improved variant", "one episode at a time"
SIDE_BY_SIDE = "ours, two seeds side by side"  # `threads` of its row counts the processes
BOUND, GATES = "bound: small-matrix products", "gate functions alone"
JAX = "the same epoch in JAX, scan and vjp"
LIBRARY = "RecurrentPPO, {environments} environment(s), {passes} gradient pass(es)"
LIBRARY_SIZES = ((1, 1), (1, 10), (32, 1), (32, 10))  # environments, gradient passes; 10 is the library's default
PRODUCT = (500, 40, 80)  # rows, inner width, columns: one layer's gates for a batch of 500, input and hidden side by side


@dataclass(frozen=True)
class Size:
    """How large the benchmark is."""

    K: int
    T: int
    many_episodes: tuple[int, ...]
    many_steps: tuple[int, ...]
    rounds: int
    scaling_rounds: int
    epochs: int  # of ours in one round
    episodes: int  # of the one-at-a-time variant in one round
    products: int  # of the bound in one round


FULL = Size(500, 50, (100, 300, 1000, 3000, 10_000), (25, 50, 100, 200, 400), 9, 5, 5, 8, 4000)
QUICK = Size(12, 4, (12, 24), (4, 8), 2, 1, 1, 2, 20)


@dataclass(frozen=True)
class Subject:
    """One thing to time. `run` does the work once; `steps` is the number of learnt environment steps it amounts to."""

    what: str
    threads: int
    K: int
    T: int
    steps: float
    run: Callable[[], object]


def flops_of_a_learnt_step(params: Params) -> int:
    """Floating-point operations of the products of one learnt step, two a multiply-add, from the network's layer widths.

    The rollout takes the weights once, its gradient twice: for the weights and for the signals, the network's inputs excepted. The
    gradient starts from what the rollout has computed: there is no learning pass beside it.
    """
    n_controlled, n_manipulated = len(params.process.controlled), len(params.process.manipulated)
    widths = [n_controlled + n_manipulated, *params.learning.policy.hidden_cells]
    gates = sum(4 * width * (below + width) for below, width in pairwise(widths))
    return 2 * (3 * (gates + widths[-1] * 2 * n_manipulated) - 4 * widths[1] * widths[0])


def gate_functions(params: Params) -> int:
    """Logistic functions and hyperbolic tangents of one learnt step, in the rollout: four gates and the cell of each layer."""
    return 5 * sum(params.learning.policy.hidden_cells)


@dataclass(frozen=True)
class Workload:
    """Case study I in the number type of the paper's scale, with the reward that apprenticeship learning starts from."""

    params: Params
    learner_params: LearnerParams

    @classmethod
    def of(cls, params_root: Path = PROJECT / "params") -> "Workload":
        """The workload that the parameter files describe, with one gradient step an epoch."""
        params = load(params_root, 1)
        improved = params.learning.variants["improved"].learner
        return cls(params, improved.model_copy(update={"minibatches": 1}))

    @property
    def dtype(self) -> torch.dtype:
        """The number type of the paper's scale."""
        return getattr(torch, self.params.learning.scales["paper"].number_type)

    def learner(
        self, K: int, T: int, learner_params: LearnerParams | None = None, dtype: torch.dtype | None = None
    ) -> tuple[Learner, "partial[Tensor]"]:
        """A learner of K episodes of T steps an epoch with a fresh policy, and its reward."""
        params, dtype = self.params, dtype or self.dtype
        process_params = params.process.model_copy(update={"horizon": T})
        task = ControlTask.from_params(process_params, params.case, dtype)
        features = FeatureMap(params.features, task, process_params.sampling_time)
        weights = initial_weights(params.learning.variants["improved"].weights, len(task.set_point), dtype)
        policy = LSTMPolicy.initial(params.learning.policy, task, stream(0, "benchmark", "policy"))
        reward = partial(apprentice_reward, features=features, weights=weights)
        process, generator = LinearProcess(process_params, dtype), stream(0, "benchmark", "learner")
        return Learner(policy, process, features, learner_params or self.learner_params, K, 10**6, generator), reward

    def epoch(self, K: int, T: int, learner_params: LearnerParams | None = None) -> Callable[[], object]:
        """One epoch of the project's learner, ready to be called again and again."""
        return partial(algorithm_1, *self.learner(K, T, learner_params), 1)

    def ours(self, threads: int, K: int, T: int, epochs: int = 1) -> Subject:
        """Epochs of the project's learner."""
        return Subject(OURS, threads, K, T, epochs * K * T, repeated(self.epoch(K, T), epochs))

    def ours_as_set(self, threads: int, K: int, T: int, epochs: int) -> Subject:
        """The same with as many gradient steps an epoch as the headline variant takes."""
        improved = self.params.learning.variants["improved"].learner
        return Subject(OURS_AS_SET, threads, K, T, epochs * K * T, repeated(self.epoch(K, T, improved), epochs))

    def side_by_side(self, K: int, T: int, epochs: int) -> Subject:
        """The same in two processes at once, each with a seed of its own."""
        return Subject(SIDE_BY_SIDE, PROCESSES, K, T, PROCESSES * epochs * K * T, SideBySide(K, T, epochs))

    def one_at_a_time(self, episodes: int, T: int) -> Subject:
        """The usual research style. Its cost is proportional to the episodes, so a few of them tell it."""
        learner, reward = self.learner(episodes, T)
        return Subject(ONE_AT_A_TIME, 1, episodes, T, episodes * T, partial(OneAtATime(learner).epoch, reward))

    def jax(self, K: int, T: int, epochs: int) -> Subject:
        """The same epochs in JAX, with one thread; needs the package of the `bench` extra."""
        os.environ |= {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1", "NPROC": "1"}
        learner, reward = self.learner(K, T)
        epoch = importlib.import_module("benchmarks.jax_epoch").JaxLearner(learner, reward.keywords["weights"]).epoch
        return Subject(JAX, 1, K, T, epochs * K * T, repeated(epoch, epochs))

    def library(self, environments: int, T: int, passes: int) -> Subject:
        """One batch and its update in RecurrentPPO; needs the packages of the `bench` extra."""
        recurrent_ppo = importlib.import_module("benchmarks.recurrent_ppo")
        model = recurrent_ppo.library_learner(self.params, environments, T, passes)
        batch = environments * T
        what = LIBRARY.format(environments=environments, passes=passes)
        return Subject(what, 1, environments, T, batch, partial(model.learn, batch, reset_num_timesteps=False))

    def bound(self, threads: int, products: int) -> Subject:
        """The machine's rate in small products, as learnt steps.

        The output of a product is allocated beforehand and all matrices fit into the cache: nothing but arithmetic.
        """
        rows, inner, columns = PRODUCT
        generator = stream(0, "benchmark", "bound")
        left, right = (torch.randn(shape, generator=generator, dtype=self.dtype) for shape in ((rows, inner), (inner, columns)))
        out = torch.empty(rows, columns, dtype=self.dtype)
        steps = products * 2 * rows * inner * columns / flops_of_a_learnt_step(self.params)
        return Subject(BOUND, threads, rows, 1, steps, repeated(partial(torch.mm, left, right, out=out), products))

    def gates(self, threads: int, times: int) -> Subject:
        """The machine's rate in the gate functions of one layer, three of five logistic, as learnt steps."""
        rows, _, columns = PRODUCT
        width = columns // 4
        values = torch.randn(5 * width, rows, generator=stream(0, "benchmark", "gates"), dtype=self.dtype)
        out = torch.empty_like(values)

        def work() -> None:
            torch.sigmoid(values[: 3 * width], out=out[: 3 * width])
            torch.tanh(values[3 * width :], out=out[3 * width :])

        steps = times * values.numel() / gate_functions(self.params)
        return Subject(GATES, threads, rows, 1, steps, repeated(work, times))


def repeated(work: Callable[[], object], times: int) -> Callable[[], None]:
    """`work`, several times in a row."""

    def run() -> None:
        for _ in range(times):
            work()

    return run


def installed(*packages: str) -> bool:
    """Whether these packages of the `bench` extra are there."""
    return all(find_spec(name) is not None for name in packages)


def library_installed() -> bool:
    """Whether RecurrentPPO is there."""
    return installed("gymnasium", "stable_baselines3", "sb3_contrib")


def comparison(workload: Workload, size: Size) -> list[Subject]:
    """The subjects that are set side by side at one K and T."""
    subjects = [workload.ours(threads, size.K, size.T, size.epochs) for threads in (1, 2)]
    subjects.append(workload.side_by_side(size.K, size.T, size.epochs))
    subjects += [workload.ours_as_set(threads, size.K, size.T, size.epochs) for threads in (1, 2)]
    subjects += [workload.bound(threads, size.products) for threads in (1, 2)]
    subjects += [workload.gates(threads, size.products) for threads in (1, 2)]
    subjects.append(workload.one_at_a_time(size.episodes, size.T))
    if installed("jax"):
        subjects.append(workload.jax(size.K, size.T, size.epochs))
    if library_installed():
        subjects += [workload.library(environments, size.T, passes) for environments, passes in LIBRARY_SIZES]
    return subjects


def scaling_sizes(size: Size) -> list[tuple[int, int]]:
    """The pairs (K, T) at which scaling is measured: K varies at the size's T, then T at its K."""
    pairs: Iterable[Any] = [(K, size.T) for K in size.many_episodes] + [(size.K, T) for T in size.many_steps]
    return list(dict.fromkeys(pairs))


def scaling(workload: Workload, size: Size) -> list[Subject]:
    """Single epochs at all scaling sizes, with one thread: several that wait for each other on a busy machine blur a slope."""
    return [workload.ours(1, K, T) for K, T in scaling_sizes(size)]
