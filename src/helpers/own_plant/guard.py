"""What stands between a deployed policy and a plant: limits, bad measurements, the fall-back PID and the switch from manual."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import isclose
from typing import Any

import numpy as np
from numpy.typing import NDArray
from simple_pid import PID

from helpers.own_plant.deploy import DeployedPolicy
from helpers.own_plant.description import SECONDS, PlantDescription, Variable
from helpers.settings.leaf import InputError

Array = NDArray[np.float64]
NOTED = ("name", "tag", "unit", "low", "high", "steady_state")  # of each variable in the notes of a policy file
LAST_DIGIT = 1e-6  # of the range of a variable: by so much a set point may miss the range of the policy


class Mode(StrEnum):
    """Who sets the inputs."""

    MANUAL = "manual"
    POLICY = "policy"
    HOLD = "hold"
    PID = "PID"


@dataclass(frozen=True)
class GuardLimits:
    """When the guard acts, in samples.

    Attributes:
        stale: after so many equal measurements of a variable its sensor counts as dead.
        hold: so long the inputs are held when a measurement is bad; then the PID takes over.
        healthy: so many good measurements in a row give control back to the policy.
        fade: in so many samples the offset fades that makes a switch bumpless, to a third.
    """

    stale: int = 10
    hold: int = 3
    healthy: int = 5
    fade: int = 5


@dataclass
class Guard:
    """A policy under guard, one sample a call, engineering units.

    In manual it follows what the operator does, so that the policy's memory is warm and the switch is bumpless: the first input is
    where the operator left it, and the difference to what the policy asks for fades. A measurement that is not a number, lies
    outside its range or does not change is bad, and so is a set point that is no number; the last one that was a number counts on.
    While anything is bad the policy's memory stands still and the inputs are held; then the PID loops whose measurement is good
    take over from where the inputs are, and the others stay held. They also do, at once, while a set point lies outside the range
    that the policy was trained for, which its file notes as `set_point_range`. A policy that raises counts as bad. The inputs
    never leave their bounds nor move faster than their rate.

    Raises:
        InputError: if the policy was made for another plant than the described one, or two loops set the same input.
    """

    policy: DeployedPolicy
    description: PlantDescription
    limits: GuardLimits = field(default_factory=GuardLimits)

    def __post_init__(self) -> None:
        title, values, n_y = self.description.title, self.description.values, len(self.description.controlled)
        notes = getattr(self.policy, "notes", {})
        if differences := _differences(notes, self.description):
            raise InputError(f"{title}: the policy was made for another description: {'; '.join(differences)}")
        if len({index for _, index, _ in self.description.loops}) < len(self.description.pid):
            raise InputError(f"{title}: key 'pid': two loops set the same manipulated variable")
        self.possible = values("controlled", "low"), values("controlled", "high")
        slack = LAST_DIGIT * (self.possible[1] - self.possible[0])
        least, greatest = np.array(notes.get("set_point_range", [(-np.inf, np.inf)] * n_y), dtype=float).T
        self.trained = least - slack, greatest + slack
        self.low, self.high, self.rate = (values("manipulated", key) for key in ("low", "high", "fastest"))
        self.running: dict[int, PID] = {}
        self.mode = Mode.MANUAL
        self.u = values("manipulated", "steady_state")
        self.offset = np.zeros(len(self.u))
        self.set_point, self.last = np.full((2, n_y), np.nan)  # the last that was a number; the last measurement
        self.repeats = np.zeros(n_y, dtype=int)
        self.n_bad = self.n_good = 0
        self.policy.reset()

    def follow(self, y: Array, set_point: Array, u: Array) -> None:
        """A sample in manual: the operator has set `u`; of an input that is no number the last one counts on."""
        self.mode = Mode.MANUAL
        self.n_bad = self.n_good = 0
        good = self._look(y) & self._aim(set_point)
        if not self._beyond():
            self._ask(y, good)
        self.u = np.where(np.isfinite(u), u, self.u).astype(float)

    def step(self, y: Array, set_point: Array) -> Array:
        """A sample in automatic: the inputs to apply, (n_u,)."""
        good = self._look(y)
        sound = good & self._aim(set_point)
        beyond = self._beyond()
        wanted = np.full(len(self.u), np.nan) if beyond else self._ask(y, sound)
        healthy = bool(sound.all() if beyond else np.isfinite(wanted).all())
        self.n_bad, self.n_good = (self.n_bad, self.n_good + 1) if healthy else (self.n_bad + 1, 0)
        before, self.mode = self.mode, Mode.PID if beyond else self._next_mode(healthy)
        if self.mode == Mode.POLICY:
            self.n_bad = 0  # not before: a sensor that comes and goes would have the inputs held for ever
            command, fresh = wanted, np.full(len(self.u), before != Mode.POLICY)
        elif self.mode == Mode.PID:
            command, fresh = self._pid(y, good & np.isfinite(self.set_point), begins=before != Mode.PID)
        else:
            command, fresh = self.u, np.ones(len(self.u), dtype=bool)
        command = np.where(np.isfinite(command), command, self.u)  # an input that is no number would never become one again
        # Whoever takes over begins where the inputs are; the difference to what it asks for fades.
        self.offset = np.where(fresh, self.u - command, self.offset * np.exp(-1 / self.limits.fade))
        moved = np.clip(command + self.offset, self.u - self.rate, self.u + self.rate)
        self.u = np.clip(moved, self.low, self.high)
        return self.u.copy()

    def _next_mode(self, healthy: bool) -> Mode:
        if healthy:
            returning = self.mode in (Mode.HOLD, Mode.PID) and self.n_good < self.limits.healthy
            return self.mode if returning else Mode.POLICY
        return Mode.HOLD if self.n_bad <= self.limits.hold and self.mode != Mode.PID else Mode.PID

    def _look(self, y: Array) -> NDArray[np.bool_]:
        """Which measurements are good."""
        self.repeats = np.where(y == self.last, self.repeats + 1, 0)
        self.last = np.asarray(y, dtype=float).copy()
        inside = (y >= self.possible[0]) & (y <= self.possible[1])  # nan is not
        return inside & (self.repeats < self.limits.stale)

    def _aim(self, set_point: Array) -> NDArray[np.bool_]:
        """Which set points are numbers; of the others the last one counts on."""
        given = np.isfinite(set_point)
        self.set_point = np.where(given, set_point, self.set_point)
        return given

    def _beyond(self) -> bool:
        """Whether a set point lies where the policy was never trained."""
        return bool(((self.set_point < self.trained[0]) | (self.set_point > self.trained[1])).any())  # nan does not

    def _ask(self, y: Array, good: NDArray[np.bool_]) -> Array:
        """What the policy would do, (n_u,), nan if anything is bad: its memory does not advance on that."""
        nothing = np.full(len(self.u), np.nan)
        if not good.all():
            return nothing
        try:
            asked = self.policy.step(np.atleast_2d(y).astype(float), self.set_point[None].astype(float), self.u[None])
        except Exception:  # onnxruntime's own errors have no common kind, and none may stop the control of a plant
            return nothing
        return asked[0] if np.shape(asked) == (1, len(self.u)) else nothing

    def _pid(self, y: Array, good: NDArray[np.bool_], begins: bool) -> tuple[Array, NDArray[np.bool_]]:
        """The fall-back: loops with a good measurement, every other input stays where it is; and which loops begin now."""
        if begins:
            self.running.clear()
        command, fresh = self.u.copy(), np.ones(len(self.u), dtype=bool)
        for output, index, loop in self.description.loops:
            if not good[output]:
                self.running.pop(index, None)
                continue
            fresh[index] = index not in self.running
            if fresh[index]:
                limits = (self.low[index], self.high[index])
                gains = (loop.proportional, loop.integral, loop.derivative)
                self.running[index] = PID(*gains, sample_time=None, output_limits=limits, auto_mode=False)
                left = self.u[index] - loop.proportional * (self.set_point[output] - y[output])
                self.running[index].set_auto_mode(True, last_output=left)
            pid = self.running[index]
            pid.setpoint = self.set_point[output]
            command[index] = pid(y[output], dt=self.description.sampling_time)
        return command, fresh


def _differences(notes: Mapping[str, Any], description: PlantDescription) -> list[str]:
    """In what a plant differs from the one that a policy was made for, as its file notes it; in words."""
    found = []

    def compare(what: str, noted: Any, own: Any) -> None:
        numbers = all(isinstance(value, int | float) for value in (noted, own))
        if not (isclose(noted, own, rel_tol=1e-9) if numbers else noted == own):
            found.append(f"{what} is {noted} in the policy and {own} in the description")

    if "title" in notes:
        compare("'title'", notes["title"], description.title)
    if "sampling_time" in notes:
        time, unit = notes["sampling_time"]
        compare("'sampling_time' in s", time * SECONDS[unit], description.sampling_time * SECONDS[description.time_unit])
    for kind in [kind for kind in ("controlled", "manipulated") if kind in notes]:
        variables: tuple[Variable, ...] = getattr(description, kind)
        compare(f"the number of '{kind}' variables", len(notes[kind]), len(variables))
        for entry, variable in zip(notes[kind], variables, strict=False):
            for key in [key for key in NOTED if key in entry]:
                compare(f"'{key}' of '{variable.name}'", entry[key], getattr(variable, key))
    if "set_point_range" in notes:
        compare("the shape of 'set_point_range'", np.shape(notes["set_point_range"]), (len(description.controlled), 2))
    return found
