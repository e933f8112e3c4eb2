"""What a historian file holds: one YAML file that names its columns, units, bounds, set points and steady state.

Unlike the parameter files it has no sources and statuses: its author knows the plant.
"""

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, Strict, model_validator
from torch import Tensor

from helpers.plant.task import ControlTask
from helpers.settings.leaf import Count, NotZero, Positive, Real, Record, Text, read_yaml, refusal, validate

Kind = Literal["controlled", "manipulated"]
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}
RESERVED = ("row", "clock", "run", "automatic", "segment")  # columns that the table of a record has beside those of the tags


def _free(tag: str) -> str:
    if tag in RESERVED:
        raise refusal(f"expected a tag other than the program's own columns ({', '.join(RESERVED)})")
    return tag


def _encoding(name: str) -> str:
    try:
        "".encode(name)
    except (LookupError, ValueError) as error:
        raise refusal("expected an encoding such as utf-8, latin-1 or cp1252") from error
    return name


Tag = Annotated[Text, AfterValidator(_free)]
LONGEST_SAMPLING_TIME, LONGEST_HORIZON = 1e6, 100_000  # time units, samples: what a plant may need, and memory holds


class Variable(Record):
    """A column of numbers; engineering units. `low` and `high` bound what is possible; `steady_state` is where the plant rests."""

    name: Text
    description: Annotated[str, Strict()] = ""
    tag: Tag
    unit: Text
    low: Real
    high: Real
    steady_state: Real

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        if not self.low < self.high:
            raise refusal("'low' must lie below 'high'")
        if not self.low <= self.steady_state <= self.high:
            raise refusal("'steady_state' lies outside 'low' to 'high'")
        return self


class ControlledVariable(Variable):
    """A measured variable. `set_point` is y_sp of the task to be learned and `steady_state` y_ss, before the set point moves.

    `error_scale`, y_sp - y_ss otherwise, is needed where the set point does not move.
    """

    set_point_tag: Tag | None = None
    set_point: Real
    error_scale: NotZero | None = None

    @model_validator(mode="after")
    def _scaled(self) -> Self:
        if self.error_scale is None and self.set_point == self.steady_state:
            raise refusal("'set_point' equals 'steady_state', so the error has no scale: give 'error_scale'")
        return self

    @property
    def scale(self) -> float:
        """The denominator of the normalised error, Eq. 4.2.1."""
        return self.set_point - self.steady_state if self.error_scale is None else self.error_scale


class ManipulatedVariable(Variable):
    """An input between its bounds. `rate` is the greatest move from one sample to the next, if there is one."""

    rate: Positive | None = None

    @property
    def fastest(self) -> float:
        """The rate, infinite where there is none."""
        return np.inf if self.rate is None else self.rate


class LoopGains(Record):
    """One PI or PID loop of the plant, parallel form on the error: the fall-back of the guard; time in the file's unit."""

    controlled: Text
    manipulated: Text
    proportional: Real
    integral: Real
    derivative: Real = 0.0


class PlantDescription(Record):
    """A plant and its historian file; all values in engineering units.

    Attributes:
        data: CSV or Parquet file, relative to the description. time: its column of time stamps or numbers.
        time_format: of its stamps, as in strptime. separator, decimal, encoding: of a CSV file. Without them all is found.
        sampling_time: in `time_unit`. horizon: T, samples of an episode. episode: a column that changes with every run.
        mode: a column; only rows where it holds one of `automatic` show the controller at work.
        plant: what stands for the plant online, `package.module:Class` or `gymnasium:Id`; without it the identified model does.
        transfer: further set points by name of the controlled variable, which widen the range of those in the file.
    """

    title: Text
    data: Text
    time: Text
    time_unit: Literal["s", "min", "h"]
    time_format: Text | None = None
    separator: Literal[",", ";", "\t", "tab", "|"] | None = None
    decimal: Literal[".", ","] | None = None
    encoding: Annotated[Text, AfterValidator(_encoding)] | None = None
    sampling_time: Annotated[Positive, Field(gt=1e-6, le=LONGEST_SAMPLING_TIME)]
    horizon: Annotated[Count, Field(le=LONGEST_HORIZON)]
    episode: Text | None = None
    mode: Text | None = None
    automatic: tuple[Text, ...] = ("AUTO",)
    controlled: Annotated[tuple[ControlledVariable, ...], Field(min_length=1)]
    manipulated: Annotated[tuple[ManipulatedVariable, ...], Field(min_length=1)]
    pid: tuple[LoopGains, ...] = ()
    plant: Text | None = None
    transfer: dict[Text, Real] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        outputs, inputs = self.names("controlled"), self.names("manipulated")
        for kind, words in (("name", outputs + inputs), ("tag", self.columns)):
            if doubled := [word for word in words if words.count(word) > 1]:
                raise refusal(f"the {kind} '{doubled[0]}' occurs twice")
        for loop in self.pid:
            for key, name, known in (("controlled", loop.controlled, outputs), ("manipulated", loop.manipulated, inputs)):
                if name not in known:
                    raise refusal(f"'pid' names the {key} variable '{name}', which is not described")
        for name, value in self.transfer.items():
            if name not in outputs:
                raise refusal(f"'transfer' names '{name}', which is no controlled variable")
            aimed = self.controlled[outputs.index(name)]
            if not aimed.low <= value <= aimed.high:
                raise refusal(f"'transfer' takes '{name}' outside 'low' to 'high'")
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """Every column of the file that is used."""
        names = (self.time, self.episode, self.mode)
        return (*(name for name in names if name is not None), *self.tags)

    @property
    def tags(self) -> tuple[str, ...]:
        """Those that hold numbers."""
        return (*(variable.tag for variable in (*self.controlled, *self.manipulated)), *self.set_point_tags)

    @property
    def set_point_tags(self) -> tuple[str, ...]:
        """The columns of the set points, of those loops that have one."""
        return tuple(variable.set_point_tag for variable in self.controlled if variable.set_point_tag is not None)

    @property
    def loops(self) -> list[tuple[int, int, LoopGains]]:
        """The PID loops with the places of the variables that they measure and move."""
        outputs, inputs = self.names("controlled"), self.names("manipulated")
        return [(outputs.index(loop.controlled), inputs.index(loop.manipulated), loop) for loop in self.pid]

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Of all variables of a kind."""
        return tuple(variable.name for variable in getattr(self, kind))

    def values(self, kind: Kind, key: str) -> NDArray[np.float64]:
        """One number of every variable of a kind, (n_y,) or (n_u,)."""
        return np.array([getattr(variable, key) for variable in getattr(self, kind)])

    def steady(self, kind: Kind, dtype: torch.dtype = torch.float64) -> Tensor:
        """y_ss or u_ss in engineering units, shape (n_y,) or (n_u,)."""
        return torch.tensor(self.values(kind, "steady_state"), dtype=dtype)

    def task(self, initial_mean: Tensor, initial_std: Tensor, dtype: torch.dtype) -> ControlTask:
        """The control task in deviation variables from the steady state; the initial state is that of the model."""

        def deviation(kind: Kind, key: str) -> Tensor:
            return torch.tensor(self.values(kind, key) - self.values(kind, "steady_state"), dtype=dtype)

        return ControlTask(
            set_point=deviation("controlled", "set_point"),
            error_scale=torch.tensor(self.values("controlled", "scale"), dtype=dtype),
            initial_mean=initial_mean.to(dtype),
            initial_std=initial_std.to(dtype),
            input_low=deviation("manipulated", "low"),
            input_high=deviation("manipulated", "high"),
            n_steps=self.horizon,
        )


def load_description(path: Path) -> PlantDescription:
    """The description of a plant from its YAML file.

    Raises:
        ParameterError: in one sentence that names the file and the key.
    """
    return validate(PlantDescription, read_yaml(path), path)
