"""The control task of a case study: Table 1 and the input bounds, as tensors."""

from dataclasses import dataclass

import torch
from torch import Tensor

from helpers.params import CaseParams, ProcessParams


@dataclass(frozen=True)
class ControlTask:
    """What a controller has to do: where the process starts, where it should go, and with which inputs.

    All are deviation variables. Attributes:
        set_point, error_scale: y_sp and y_sp - y_ss (Eq. 4.2.1), shape (n_y,).
        initial_mean, initial_std: of the normal distribution of x_0 (Table 1), shape (n_x,).
        input_low, input_high: bounds of the inputs, shape (n_u,).
        n_steps: T, the number of control steps of an episode.
    """

    set_point: Tensor
    error_scale: Tensor
    initial_mean: Tensor
    initial_std: Tensor
    input_low: Tensor
    input_high: Tensor
    n_steps: int

    @classmethod
    def from_params(cls, process: ProcessParams, case: CaseParams, dtype: torch.dtype) -> "ControlTask":
        """The task that the parameter files describe."""

        def tensor(values: tuple[float, ...]) -> Tensor:
            return torch.tensor(values, dtype=dtype)

        return cls(
            set_point=tensor(case.set_point),
            error_scale=tensor(case.scale_of_error),
            initial_mean=tensor(case.initial_mean),
            initial_std=tensor(case.initial_std),
            input_low=tensor(process.input_low),
            input_high=tensor(process.input_high),
            n_steps=process.horizon,
        )
