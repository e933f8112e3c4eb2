"""Which reward weights make an expert-like policy: a sample of alpha, each with a policy learnt under it as it stands.

The policy is that of Section 3.2, acting by its mode, and its reward that of Eq. 4.2.5. It is learnt by the gradient through the
model (`learning.model_gradient` says how), not by REINFORCE: which policy is best under a given alpha does not depend on who finds
it, and this way costs a tenth. All weights of a batch are learnt side by side, each with parameters of its own.
"""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional

from helpers.evidence.printed_search import Search, recorded
from helpers.learning.evaluation import feature_gap
from helpers.learning.learner import annealed
from helpers.learning.policy import LSTMPolicy
from helpers.plant.task import Trajectories
from helpers.runs.finished import State
from helpers.runs.study import Study
from helpers.settings.paper import load_published

RATE = (1e-2, 5e-4)  # Adam's step size, along half a cosine
LSTM = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
SOURCE = Path(__file__).read_text(encoding="utf-8")  # a sample of other code is drawn again
LONGEST = 1.0  # of a policy's gradient, cut beyond it


def sample(printed: Tensor, best: Tensor, n_anywhere: int, n_near: int, generator: torch.Generator) -> tuple[list[str], Tensor]:
    """Weights of unit norm, (1 + n + 2 m, d), and what each is: printed, anywhere on the sphere, near the printed, near the best.

    Near: a step of random direction, whose length is even between zero and that of the weights.
    """
    centres = functional.normalize(torch.stack([printed, best])).repeat_interleave(n_near, dim=0)
    anywhere, near = (torch.randn(n, len(printed), generator=generator, dtype=printed.dtype) for n in (n_anywhere, 2 * n_near))
    length = torch.rand(2 * n_near, 1, generator=generator, dtype=printed.dtype)
    kinds = ["printed", *["anywhere"] * n_anywhere, *["near printed"] * n_near, *["near best"] * n_near]
    return kinds, functional.normalize(torch.cat([printed[None], anywhere, centres + length * functional.normalize(near)]))


def linear(x: Tensor, matrices: Tensor, biases: Tensor) -> Tensor:
    """A layer of each of n policies on K rows of its own: (n, K, in), (n, out, in) and (n, out) to (n, K, out)."""
    return torch.baddbmm(biases[:, None], x, matrices.mT)


def closed_loops(
    policy: LSTMPolicy, parameters: Mapping[str, Tensor], study: Study, n_episodes: int, draws: torch.Generator
) -> Trajectories:
    """Episodes of n policies of one kind, all under the same draws and by their modes, differentiable in the parameters.

    Args:
        parameters: of the n policies by name, (n, ...) each.

    Returns:
        n * n_episodes trajectories, those of one policy after each other.
    """
    task, process, scaling = study.task, study.process, policy.scaling(study.task)
    n = len(parameters["output.bias"])

    def draw(n_times: int, n_variables: int) -> Tensor:
        return torch.randn(n_times, n_episodes, n_variables, generator=draws, dtype=study.dtype).repeat(1, n, 1)

    x = [task.initial_mean + task.initial_std * draw(1, process.n_states)[0]]
    disturbance, noise = draw(task.n_steps, process.n_disturbances), draw(task.n_steps + 1, process.n_outputs)
    y, u = [process.observe(x[0], noise[0])], []
    before = torch.zeros_like(x[0][:, : policy.n_manipulated])
    states = [(x[0].new_zeros(n, n_episodes, width),) * 2 for width in policy.params.hidden_cells]
    for t in range(task.n_steps):
        signal = scaling.inputs(y[t], before).unflatten(0, (n, n_episodes))
        for index, (h, before_c) in enumerate(states):
            of_x, of_h, bias_x, bias_h = (parameters[f"layers.{index}.{name}_l0"] for name in LSTM)
            i, f, g, o = (linear(signal, of_x, bias_x) + linear(h, of_h, bias_h)).chunk(4, dim=-1)  # as torch orders its gates
            c = f.sigmoid() * before_c + i.sigmoid() * g.tanh()
            states[index] = o.sigmoid() * c.tanh(), c
            signal = functional.leaky_relu(states[index][0], policy.params.leaky_slope)
        output = linear(signal, parameters["output.weight"], parameters["output.bias"])
        before = scaling.outputs(output)[0].flatten(0, 1)  # the mean lies between the bounds
        u.append(before)
        x.append(process.step(x[t], before, disturbance[t]))
        y.append(process.observe(x[t + 1], noise[t + 1]))
    return Trajectories(*(torch.stack(signal) for signal in (x, y, u, u)))


def relearnt(study: Study, weights: Tensor, n_steps: int, n_episodes: int) -> Tensor:
    """E[v] of the policy that is best under each alpha, (n, d), for weights (n, d): `n_steps` steps of `n_episodes` each."""
    policy, generator, n = study.fresh_policy(), study.stream("weights"), len(weights)
    stacked = {name: value.detach().repeat(n, *[1] * value.ndim).requires_grad_() for name, value in policy.named_parameters()}

    def features(number: int, draws: torch.Generator) -> Tensor:
        """E[v] of each policy, (n, d)."""
        return study.features.trajectory(closed_loops(policy, stacked, study, number, draws)).unflatten(0, (n, number)).mean(1)

    optimiser = torch.optim.Adam(stacked.values(), lr=RATE[0])
    for step in range(n_steps):
        for group in optimiser.param_groups:
            group["lr"] = annealed(*RATE, step / max(1, n_steps - 1))
        optimiser.zero_grad()
        (-(features(n_episodes, generator) * weights).sum()).backward()
        gradients = [value.grad.flatten(1) for value in stacked.values() if value.grad is not None]
        length = torch.cat(gradients, dim=1).norm(dim=1, keepdim=True)
        for gradient in gradients:
            gradient.mul_((LONGEST / length).clamp(max=1))
        optimiser.step()
    with torch.no_grad():
        return features(min(500, study.scale_params.evaluation), study.stream("evaluation"))


def sampled(search: Search, case: int, watch: Callable[[str], object] = print) -> pd.DataFrame:
    """The sample of a case: case, batch, kind, seconds, gap, and alpha and v of each feature.

    Each batch is learnt from a fresh policy of its own, begins with the weights that the paper prints, and has some near those
    whose gap is least so far.
    """
    size, frames, least = search.size, list[pd.DataFrame](), math.inf
    printed = best = torch.tensor(load_published(search.root)[case].alpha, dtype=search.study(case, 0).dtype)
    for batch in range(size.batches):
        study = search.study(case, batch)
        kinds, weights = sample(printed, best, size.anywhere, size.near, study.stream("sample"))

        def learn(study: Study = study, weights: Tensor = weights) -> State:
            began, truth = time.process_time(), recorded(study).true_features(study.feature_names)
            v = relearnt(study, weights, size.steps, size.episodes)
            return {"v": v, "gap": [feature_gap(of_one, truth) for of_one in v], "seconds": time.process_time() - began}

        found = search.once(learn, study, weights, size.steps, size.episodes, SOURCE)
        if min(found["gap"]) < least:
            least = min(found["gap"])
            best = weights[found["gap"].index(least)]
        columns = {
            f"{kind}:{name}": values[:, index].tolist()
            for kind, values in (("alpha", weights), ("v", found["v"]))
            for index, name in enumerate(study.feature_names)
        }
        given = {"case": case, "batch": batch, "kind": kinds, "seconds": found["seconds"] / len(weights), "gap": found["gap"]}
        frames.append(pd.DataFrame(given | columns))
        watch(f"case {case}, weights {batch + 1} of {size.batches}: least gap {100 * least:.1f} %")
    return pd.concat(frames, ignore_index=True)
