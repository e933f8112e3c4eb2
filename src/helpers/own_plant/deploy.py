"""A policy as a file that a plant can run: ONNX, one sample a call, engineering units in and out; and the same as C source.

The memory of the policy is inputs and outputs of the file, so that it keeps none itself; scaling and bounds are inside.
"""

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from emx_onnx_cgen.compiler import Compiler, CompilerOptions
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from helpers.learning.tracking_policy import SHARPNESS, TrackingPolicy
from helpers.settings.leaf import InputError

Array = NDArray[np.float64]
OPSET = 17
STATIC = "_static"  # ends the name of the file with batch 1 and fixed shapes


class PolicyStep(nn.Module):
    """One sample of a `TrackingPolicy` in operations that every runtime has: (y, y_sp, u_previous, memory) to (u, memory).

    Engineering units, double precision, rows are trajectories. The network runs in single precision, as it was trained; a
    deviation is taken before anything is rounded.
    """

    def __init__(self, policy: TrackingPolicy, steady_y: Tensor, steady_u: Tensor) -> None:
        super().__init__()
        self.cells = list(policy.params.hidden_cells)
        self.slope = policy.params.leaky_slope
        self.patient = policy.kept is not None
        kept = torch.ones_like(policy.low) if policy.kept is None else policy.kept
        doubles = {**vars(policy.gains), "kept": kept, "steady_y": steady_y, "steady_u": steady_u}
        doubles |= {name: getattr(policy, name) for name in ("unit", "centre", "reach", "low", "high")}
        for name, value in doubles.items():
            self.register_buffer(name, value.detach().double())
        singles = {"output_weight": policy.output.weight, "output_bias": policy.output.bias}
        for index, layer in enumerate(policy.lstms):
            below, before, bias_below, bias_before = layer.all_weights[0]
            singles |= {f"weight_{index}": torch.cat([below, before], dim=1), f"bias_{index}": bias_below + bias_before}
        for name, value in singles.items():
            self.register_buffer(name, value.detach().float())

    def forward(self, y: Tensor, set_point: Tensor, u_previous: Tensor, *memory: Tensor) -> tuple[Tensor, ...]:
        """The input to apply, (K, n_u), and the memory for the next sample, as in `memory_names`."""
        once, excess, quick, *states = memory
        of, error = dict(self.named_buffers()), set_point - y
        low, high = of["low"], of["high"]
        middle, half = (high + low) / 2, (high - low) / 2
        scaled = SHARPNESS * error / of["unit"]
        sharp = torch.sign(scaled) * torch.log(scaled.abs() + torch.sqrt(scaled**2 + 1))  # asinh, which not every runtime has
        last = u_previous - of["steady_u"]
        seen = [sharp, (set_point - of["steady_y"] - of["centre"]) / of["reach"], (last - middle) / half]
        signal = torch.cat(seen, dim=-1).float()
        after: list[Tensor] = []
        for index, width in enumerate(self.cells):
            hidden, cell = states[2 * index], states[2 * index + 1]
            gates = functional.linear(torch.cat([signal, hidden], dim=-1), of[f"weight_{index}"], of[f"bias_{index}"])
            entry, forget, candidate, exit_ = gates.split(width, dim=-1)
            cell = torch.sigmoid(forget) * cell + torch.sigmoid(entry) * torch.tanh(candidate)
            hidden = torch.sigmoid(exit_) * torch.tanh(cell)
            after += [hidden, cell]
            signal = functional.leaky_relu(hidden, self.slope)
        correction = functional.linear(signal, of["output_weight"], of["output_bias"]).double() * half
        integral = last + of["kept"] * excess - quick + error @ of["integral"].T
        if not self.patient:
            integral = torch.minimum(torch.maximum(integral, low), high)
        quick = error @ of["proportional"].T + (error - once) @ of["derivative"].T + correction
        u = torch.minimum(torch.maximum(integral + quick, low), high)
        return (u + of["steady_u"], error, integral + quick - u, quick, *after)


def memory_names(policy: TrackingPolicy) -> list[str]:
    """The error before, what a bound cut off, the quick part q before, and h and c of each layer, as the file calls them."""
    states = [f"{kind}_{index}" for index in range(len(policy.lstms)) for kind in "hc"]
    return ["error", "excess", "quick", *states]


def export(
    policy: TrackingPolicy, steady_y: Tensor, steady_u: Tensor, path: Path, notes: dict[str, Any], static: bool = False
) -> Path:
    """Write a policy as ONNX; `notes` go into the file.

    Args:
        steady_y, steady_u: the steady state in engineering units, (n_y,) and (n_u,).
        static: for one trajectory with fixed shapes, which controllers without dynamic shapes need; otherwise for any number.
    """
    module = PolicyStep(policy, steady_y, steady_u).train(False)
    names = memory_names(policy)
    memory = [entry.double() if place < 3 else entry.float() for place, entry in enumerate(policy.start(1))]
    example = (steady_y.double()[None], steady_y.double()[None], steady_u.double()[None], *memory)
    return write(module, example, names, path, notes, static)


def write(
    module: nn.Module, example: tuple[Tensor, ...], names: list[str], path: Path, notes: dict[str, Any], static: bool = False
) -> Path:
    """`export` of a module that maps (y, set_point, u_previous, memory..), as in the example, to (u, memory..).

    Args:
        names: of the memory.
    """
    outputs = ["u", *(f"{name}_next" for name in names)]
    axes = {name: {0: "K"} for name in ("y", "set_point", "u_previous", *names, *outputs)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns that its successor needs two more packages
        torch.onnx.export(
            module,
            example,
            path,
            input_names=["y", "set_point", "u_previous", *names],
            output_names=outputs,
            dynamic_axes=None if static else axes,
            opset_version=OPSET,
            dynamo=False,
        )
    file = onnx.load(path)
    onnx.helper.set_model_props(file, {key: json.dumps(value) for key, value in notes.items()})
    onnx.checker.check_model(file)
    onnx.save(file, path)
    return path


def export_c(static: Path, path: Path) -> Path:
    """The static file as one C source without dependencies: `policy(y, set_point, u_previous, memory.., u, memory_next..)`."""
    to_c = Compiler(CompilerOptions(model_name="policy"))
    path.write_text(to_c.compile(onnx.load(static)), encoding="utf-8")
    return path


@dataclass
class DeployedPolicy:
    """A policy file in onnxruntime, one thread: call it once a sample.

    Raises:
        InputError: if the file is no policy, or its notes cannot be read.
    """

    path: Path

    def __post_init__(self) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own errors have no common kind
            raise InputError(f"{self.path}: not a policy that can be run: {' '.join(str(error).split())[:200]}") from error
        inputs = self.session.get_inputs()[3:]
        self.names = [entry.name for entry in inputs]
        self.shapes = [entry.shape for entry in inputs]
        self.types = [np.float64 if "double" in entry.type else np.float32 for entry in inputs]
        self.notes: dict[str, Any] = {}
        for key, value in self.session.get_modelmeta().custom_metadata_map.items():
            try:
                self.notes[key] = json.loads(value)
            except ValueError as error:
                raise InputError(f"{self.path}: the note '{key}' of the policy cannot be read: {error}") from error
        self.reset()

    def reset(self, n_trajectories: int = 1) -> None:
        """Nothing remembered, as before the first sample of an episode."""
        sizes = zip(self.shapes, self.types, strict=True)
        self.memory = [np.zeros((n_trajectories, *shape[1:]), dtype=kind) for shape, kind in sizes]

    def step(self, y: Array, set_point: Array, u_previous: Array) -> Array:
        """The input for this sample, (K, n_u), from measurement, set point and the input applied last; engineering units."""
        feed = dict(zip(self.names, self.memory, strict=True))
        u, *self.memory = self.session.run(None, {"y": y, "set_point": set_point, "u_previous": u_previous, **feed})
        return np.asarray(u)


def disagreement(
    policy: TrackingPolicy, deployed: DeployedPolicy, y: Tensor, set_point: Tensor, steady_y: Tensor, steady_u: Tensor
) -> float:
    """The greatest difference between file and torch along episodes, as a share of the input range.

    Args:
        y, set_point: in deviation variables, (T, K, n_y).
    """
    n_trajectories, dtype = y.shape[1], policy.unit.dtype
    memory, u = policy.start(n_trajectories), torch.zeros(n_trajectories, len(steady_u), dtype=dtype)
    span = (policy.high - policy.low).double().numpy()
    deployed.reset(n_trajectories)
    worst = 0.0
    with torch.no_grad():
        for measured, aim in zip(y.to(dtype), set_point.to(dtype), strict=True):
            command, memory = policy.act(measured, aim, u, memory)
            applied = (u.double() + steady_u).numpy()
            u = torch.clamp(command, policy.low, policy.high)
            found = deployed.step((measured.double() + steady_y).numpy(), (aim.double() + steady_y).numpy(), applied)
            expected = (u.double() + steady_u).numpy()
            worst = float(np.maximum(worst, np.abs((found - expected) / span).max()))  # nan stays, which max() would drop
    return worst
