"""A policy as a file that a plant can run: ONNX, one sample a call, engineering units in and out.

The hidden states of the network are inputs and outputs of the file, so that it keeps no memory; scaling and bounds are inside.
"""

import copy
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from helpers.learning.policy import LSTMPolicy
from helpers.plant.task import ControlTask
from helpers.settings.leaf import InputError

Array = NDArray[np.float64]
OPSET = 17


class PolicyStep(nn.Module):
    """One sample of a policy's mode: (y, y_sp, u_previous, h, c of each layer) to (u, h, c), rows are trajectories.

    y, y_sp and u are in engineering units and in double precision: a deviation is taken before anything is rounded.
    """

    def __init__(self, policy: LSTMPolicy, task: ControlTask, steady_y: Tensor, steady_u: Tensor) -> None:
        super().__init__()
        single = copy.deepcopy(policy).float()  # onnxruntime has no LSTM in double precision
        self.layers, self.output, self.slope = single.layers, single.output, policy.params.leaky_slope
        self.n_inputs = policy.n_manipulated
        self.error_unit = nn.Buffer(policy.error_unit.double())
        self.low = nn.Buffer(task.input_low.double() + steady_u)
        self.high = nn.Buffer(task.input_high.double() + steady_u)

    def forward(self, y: Tensor, set_point: Tensor, u_previous: Tensor, *states: Tensor) -> tuple[Tensor, ...]:
        """The input to apply, (K, n_u), and the states for the next sample, h and c of each layer, (1, K, cells)."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        signal = torch.cat([(set_point - y) / self.error_unit, (u_previous - middle) / half], dim=-1).float()[None]
        after: list[Tensor] = []
        for index, layer in enumerate(self.layers):
            hidden, state = layer(signal, (states[2 * index], states[2 * index + 1]))
            after += state
            signal = functional.leaky_relu(hidden, self.slope)
        share = functional.hardtanh(self.output(signal[0])[:, : self.n_inputs], 0.0, 6.0).double() / 6.0  # ReLU6, Eq. 3.2.5
        return (self.low + (self.high - self.low) * share, *after)


def state_names(policy: LSTMPolicy) -> list[str]:
    """h and c of each layer, as the file calls them."""
    return [f"{kind}_{index}" for index in range(len(policy.lstms)) for kind in ("h", "c")]


def export(policy: LSTMPolicy, task: ControlTask, steady_y: Tensor, steady_u: Tensor, path: Path, notes: dict[str, Any]) -> Path:
    """Write a policy as ONNX; `notes` go into the file, and with them a name and a unit for every variable.

    Args:
        steady_y, steady_u: the steady state in engineering units, (n_y,) and (n_u,).
    """
    module = PolicyStep(policy, task, steady_y, steady_u).train(False)
    names = state_names(policy)
    states = [torch.zeros(1, 1, layer.hidden_size) for layer in policy.lstms for _ in ("h", "c")]
    example = (steady_y.double()[None], steady_y.double()[None], steady_u.double()[None], *states)
    axes = {name: {0: "K"} for name in ("y", "set_point", "u_previous", "u")}
    axes |= {f"{name}{suffix}": {1: "K"} for name in names for suffix in ("", "_next")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns that its successor needs two more packages
        torch.onnx.export(
            module,
            example,
            path,
            input_names=["y", "set_point", "u_previous", *names],
            output_names=["u", *(f"{name}_next" for name in names)],
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
    file = onnx.load(path)
    onnx.helper.set_model_props(file, {key: json.dumps(value) for key, value in notes.items()})
    onnx.checker.check_model(file)
    onnx.save(file, path)
    return path


@dataclass
class DeployedPolicy:
    """A policy file in onnxruntime, one thread: call it once a sample."""

    path: Path

    def __post_init__(self) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own errors have no common kind
            raise InputError(f"{self.path}: not a policy that can be run: {' '.join(str(error).split())[:200]}") from error
        self.names = [entry.name for entry in self.session.get_inputs()][3:]
        self.shapes = [entry.shape for entry in self.session.get_inputs()][3:]
        self.notes = {key: json.loads(value) for key, value in self.session.get_modelmeta().custom_metadata_map.items()}
        self.reset()

    def reset(self, n_trajectories: int = 1) -> None:
        """Zero hidden states, as before the first sample of an episode."""
        self.states = [np.zeros((shape[0], n_trajectories, shape[2]), dtype=np.float32) for shape in self.shapes]

    def step(self, y: Array, set_point: Array, u_previous: Array) -> Array:
        """The input for this sample, (K, n_u), from measurement, set point and the input applied last; engineering units."""
        feed = dict(zip(self.names, self.states, strict=True))
        u, *self.states = self.session.run(None, {"y": y, "set_point": set_point, "u_previous": u_previous, **feed})
        return np.asarray(u)


def disagreement(
    policy: LSTMPolicy, deployed: DeployedPolicy, task: ControlTask, y: Tensor, u: Tensor, steady_y: Tensor, steady_u: Tensor
) -> float:
    """The greatest difference between file and torch along episodes, as a share of the input range.

    Args:
        y, u: recorded episodes in deviation variables, (T or T + 1, K, n_y) and (T, K, n_u).
    """
    with torch.no_grad():
        mean, _ = policy(y, u, task)
    expected = (mean.double() + steady_u).numpy()
    measured, inputs = (y.double() + steady_y).numpy(), (u.double() + steady_u).numpy()
    set_point = np.broadcast_to((task.set_point.double() + steady_y).numpy(), measured[0].shape).copy()
    span = (task.input_high - task.input_low).double().numpy()
    deployed.reset(y.shape[1])
    u_previous = np.broadcast_to(steady_u.double().numpy(), inputs[0].shape).copy()
    worst = 0.0
    for t in range(len(u)):
        found = deployed.step(measured[t], set_point, u_previous)
        worst = float(np.maximum(worst, np.abs((found - expected[t]) / span).max()))  # nan stays, which max() would drop
        u_previous = inputs[t]
    return worst
