"""The verbs of notebook 09: one policy for every set point of the paper's process, by the gradient through the model. Ours."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial

import pandas as pd
import torch
from torch import Tensor

from helpers.evidence.robustness import mismatched
from helpers.learning.evaluation import objective
from helpers.learning.features import discounts
from helpers.learning.model_gradient import Descent, GradientRecord, model_gradient
from helpers.learning.tracking_policy import Gains, TrackingPID, TrackingPolicy
from helpers.plant.controllers import Controller
from helpers.plant.process import LinearProcess
from helpers.plant.task import Trajectories
from helpers.plant.tracking import AtSetPoint, Bounds, Scenarios, Tracked, Tracker, track
from helpers.runs.finished import State
from helpers.runs.progress import ProgressBar
from helpers.runs.session import Session
from helpers.runs.study import Study
from helpers.settings.limits import load_limits
from helpers.settings.one_policy import OnePolicyParams, OnePolicyScaleParams, load_one_policy
from helpers.settings.paper import GainParams, load, load_published

NONE = 1e-3  # share of the integral action of the PID that an untrained policy begins with, which must have a sign
Watch = Callable[[GradientRecord], object]


@dataclass(frozen=True)
class Ground:
    """What the policies are trained and judged on.

    Attributes:
        cases: a study for each case that the paper printed.
        state_factors, input_factors, set_point_factors: the grids of params/limits.yaml.
    """

    session: Session
    params: OnePolicyParams
    cases: Mapping[int, Study]
    state_factors: tuple[float, ...]
    input_factors: tuple[float, ...]
    set_point_factors: tuple[float, ...]

    @property
    def scale(self) -> OnePolicyScaleParams:
        """How much this scale computes."""
        return self.params.scales[self.session.scale]

    @property
    def beta(self) -> float:
        """The sharpness of the real objective."""
        return self.session.params.case.online.headline_beta

    @property
    def bounds(self) -> Bounds:
        """Those of the inputs; they may move at any rate."""
        task = self.session.task
        return Bounds(task.input_low, task.input_high, torch.full_like(task.input_low, torch.inf))

    @cached_property
    def set_points(self) -> Tensor:
        """Every set point of the robustness grid, case by case, (n, n_y)."""
        return torch.stack([study.task.set_point for _, _, study in self.grid()])

    def grid(self) -> list[tuple[int, tuple[float, float], Study]]:
        """Every case with its set point times the factors, the first loop and the others by themselves."""
        found = []
        for case, study in self.cases.items():
            for first in self.set_point_factors:
                for others in self.set_point_factors:
                    one, *more = study.params.case.set_point
                    target = (first * one, *(others * entry for entry in more))
                    found.append((case, (first, others), study.varied(case={"set_point": target})))
        return found

    def error_scale(self, set_point: Tensor) -> Tensor:
        """y_sp - y_ss of Eq. 4.2.1, in size no less than the smallest of the grid: near y_ss an error has no scale of its own."""
        least = self.set_points.abs().amin(0)
        return torch.where(set_point < 0, -1.0, 1.0) * set_point.abs().maximum(least)

    def policy(self, gains: Gains) -> TrackingPolicy:
        """A policy that begins as the PID with these gains."""
        # torch.nn draws the first weights from the global stream.
        torch.manual_seed(int(torch.randint(2**31, (1,), generator=self.session.stream("one_policy", "weights"))))
        low, high = self.set_points.amin(0), self.set_points.amax(0)
        unit = self.session.task.error_scale.abs()
        shape = (gains, unit, (low + high) / 2, (high - low) / 2, self.bounds)
        return TrackingPolicy(self.session.params.learning.policy, *shape, self.params.descent.kept)

    def draw(self, n_episodes: int, generator: torch.Generator, margin: float = 0.0, load: float = 0.0) -> Scenarios:
        """Episodes from u* = 0 with a set point each: a case's times factors within the grid's, or any in the range of the grid.

        Args:
            margin: A and B of each episode are scaled by factors within it. load: std of a load step, as a share of the inputs'
                ranges; it comes at any sample, and in half of the episodes.
        """
        session = self.session
        process, task = session.process, session.task
        normal = partial(torch.randn, generator=generator, dtype=session.dtype)
        even = partial(torch.rand, generator=generator, dtype=session.dtype)
        n_steps, n_x, n_u = task.n_steps, process.n_states, process.n_inputs
        low, high = self.set_points.amin(0), self.set_points.amax(0)
        anywhere = low + (high - low) * even((n_episodes, len(low)))
        least, most = min(self.set_point_factors), max(self.set_point_factors)
        targets = torch.stack([study.task.set_point for study in self.cases.values()])
        near = targets[torch.randint(len(targets), (n_episodes,), generator=generator)] * (
            least + (most - least) * even((n_episodes, len(low)))
        )
        set_point = torch.where(even((n_episodes, 1)) < self.params.episodes.near, near, anywhere)
        state, entry = 1 + margin * (2 * even((2, n_episodes)) - 1)
        begins = torch.randint(2 * n_steps, (n_episodes,), generator=generator)
        step = load * self.bounds.span * normal((n_episodes, n_u))
        return Scenarios(
            process.scaled(state, entry) if margin else process,
            set_point.expand(n_steps, -1, -1),
            step * (torch.arange(n_steps)[:, None] >= begins)[..., None],
            task.initial_mean + task.initial_std * normal((n_episodes, n_x)),
            torch.zeros(n_episodes, n_u, dtype=session.dtype),
            normal((n_steps, n_episodes, process.n_disturbances)),
            normal((n_steps + 1, n_episodes, process.n_outputs)),
        )

    def moved(self, u: Tensor) -> Tensor:
        """How far the inputs (T, K, n_u) move in an episode, in ranges of theirs, (K,)."""
        return (u.diff(dim=0).abs() / self.bounds.span).sum((0, 2))

    def lost(self, scenarios: Scenarios, run: Tracked, beta: float) -> Tensor:
        """1 - J / J_max of each episode, (K,), with the tracking objective J of Eq. 5.1.2.1 on the true state.

        Of each reward the expectation over the last disturbance before it is taken, as in notebook 06: with the mean m and the
        standard deviation s of the next normalised error it is exp(-(beta m)^2 / w) / sqrt(w), w = 1 + 2 (beta s)^2. That has the
        same mean as the reward, a smaller variance, and a gradient where the reward itself has none.
        """
        process, scale = scenarios.process, self.error_scale(scenarios.set_point)
        assert isinstance(process, LinearProcess)
        after, spread = process.before_last_kick(run.x[:-1], run.u + scenarios.load, scenarios.disturbance)
        mean = (run.set_point - after) / scale
        wide = 1 + 2 * (beta * spread / scale) ** 2
        reward = (torch.exp(-((beta * mean) ** 2) / wide) / wide.sqrt()).sum(-1)
        weights = discounts(len(reward), self.session.features.params.discount, reward)
        return 1 - weights @ reward / (weights.sum() * scale.shape[-1])

    @cached_property
    def record(self) -> Gains:
        """The gains of the demonstrating PID of Case Study I, per sample."""
        return self.gains(self.session.params.demonstrator)

    def gains(self, params: GainParams) -> Gains:
        """Gains of the parameter files as a matrix on the errors, per sample."""
        dt = self.session.params.process.sampling_time
        parts = ((params.proportional, 1.0), (params.integral, dt), (params.derivative, 1 / dt))
        return Gains(*(factor * torch.tensor(values, dtype=self.session.dtype).diag() for values, factor in parts))


def enter(session: Session) -> Ground:
    """What notebook 09 starts from: the parameters of all cases, limits.yaml and one_policy.yaml, and no earlier result."""
    root = session.params_root
    cases = {case: replace(session, case=case, params=load(root, case)) for case in sorted(load_published(root))}
    grids = load_limits(root, session.params).robustness
    params = load_one_policy(root, session.params)
    return Ground(session, params, cases, grids.state_factors, grids.input_factors, grids.set_point_factors)


# Training ------------------------------------------------------------------------------------------------------------


def trained(
    ground: Ground, policy: TrackingPolicy, purpose: str, steps: int, robust: bool = False, constrained: bool = False,
    first_beta: float | None = None, watch: Watch = lambda record: None,
) -> list[GradientRecord]:  # fmt: skip
    """Improve a policy in place by the gradient through the process, without an episode of the plant.

    Args:
        robust: A, B and loads are drawn too. constrained: the inputs move no more than the record's PID moves them in the same
            episodes.
        first_beta: where beta begins, if not at that of the objective; it rises evenly in its logarithm.
    """
    generator, params = ground.session.stream("one_policy", purpose), ground.params
    margin, load = (params.episodes.margin, params.episodes.load) if robust else (0.0, 0.0)
    done: list[GradientRecord] = []

    def measure(scenarios: Scenarios, run: Tracked) -> tuple[Tensor, Tensor]:
        beta = ground.beta
        if first_beta is not None:
            beta = first_beta * (beta / first_beta) ** min(1.0, len(done) / (params.hot_start.share * steps))
        with torch.no_grad():
            allowed = (
                params.descent.movement
                * ground.moved(track(TrackingPID(ground.record, ground.bounds), scenarios, ground.bounds).u).mean()
            )
        return ground.lost(scenarios, run, beta), ground.moved(run.u) / allowed

    def note(record: GradientRecord) -> None:
        done.append(record)
        watch(record)

    descent = Descent(steps, params.descent.rate_start, params.descent.rate_end)
    if not constrained:
        descent = replace(descent, price=0.0, price_step=0.0)
    draw = partial(ground.draw, params.descent.episodes, generator, margin, load)
    return model_gradient(policy, draw, measure, ground.bounds, descent, note)


def learn(ground: Ground, purpose: str, robust: bool = False, constrained: bool = False) -> tuple[TrackingPolicy, pd.DataFrame]:
    """A policy from the record's PID on, and its gradient steps as a table; an interrupted run does not repeat what has ended."""
    policy, steps = ground.policy(ground.record), ground.scale.steps

    def train() -> State:
        records = trained(ground, policy, purpose, steps, robust, constrained, watch=ProgressBar(steps, purpose))
        return {"policy": policy.state_dict(), "records": [asdict(record) for record in records]}

    kept = ground.session.once(train, ground.params, purpose, robust, constrained)
    policy.load_state_dict(kept["policy"])
    return policy, pd.DataFrame(kept["records"])


def stored(session: Session) -> TrackingPolicy:
    """The policy that notebook 09 trained for the same seed."""
    ground = enter(session)
    policy = ground.policy(ground.record)
    session.load("one_policy", "09_one_policy", case=1).into(policy)
    return policy


def starts(ground: Ground) -> tuple[pd.DataFrame, pd.DataFrame]:
    """What the hot start brings: the same training from the demonstrating PID and from nothing.

    Returns:
        The curves (start, steps, share: of minimum variance, mean over the cases), and a row a start: share at the start, the
        lowest (the dip), at the end, and the gradient steps until the level of the parameter file was reached, nan if never.
    """
    params, scale = ground.params.hot_start, ground.scale
    nothing = Gains(0 * ground.record.proportional, NONE * ground.record.integral, 0 * ground.record.derivative)
    rows: list[tuple[str, int, float]] = []
    best = [returns(ground, study, study.minimum_variance, scale.grid)[0] for study in ground.cases.values()]

    def share(policy: TrackingPolicy) -> float:
        found = [returns(ground, study, AtSetPoint(policy, study.task), scale.grid)[0] for study in ground.cases.values()]
        return sum(value / most for value, most in zip(found, best, strict=True)) / len(best)

    for name, gains, first_beta in (
        ("PID of the demonstrations", ground.record, None),
        ("nothing", nothing, None),
        ("nothing, beta rising", nothing, params.first_beta),
    ):
        policy = ground.policy(gains)
        if gains is nothing:
            policy.output.reset_parameters()
        rows.append((name, 0, share(policy)))

        def watch(record: GradientRecord, name: str = name, policy: TrackingPolicy = policy) -> None:
            if record.epochs % scale.every == 0:
                rows.append((name, record.epochs, share(policy)))

        trained(ground, policy, name, scale.start_steps, first_beta=first_beta, watch=watch)
    curves = pd.DataFrame(rows, columns=["start", "steps", "share"])
    table = {}
    for name, curve in curves.groupby("start", sort=False):
        reached = curve.loc[curve["share"] >= params.level, "steps"]
        first, last, least = curve["share"].iloc[0], curve["share"].iloc[-1], curve["share"].min()
        table[name] = {"at the start": first, "lowest": least, "at the end": last, "steps to the level": reached.min()}
    return curves, pd.DataFrame(table).T


# Judging -------------------------------------------------------------------------------------------------------------


def returns(ground: Ground, study: Study, controller: Controller, n_trajectories: int) -> tuple[float, Trajectories]:
    """The real objective on x of a controller, mean over fresh trajectories, and these."""
    batch = study.fresh(controller, n_trajectories)
    return objective(batch, study.features.on("x"), ground.beta).double().mean().item(), batch


def holdable(study: Study) -> bool:
    """Whether the set point of a study can be held at rest within the bounds of the inputs."""
    process, task = study.process, study.task
    u = -torch.linalg.solve(process.drift_input, process.drift_state @ task.set_point)
    return bool(((u > task.input_low) & (u < task.input_high)).all())


def judged(ground: Ground, trackers: Mapping[str, Tracker]) -> pd.DataFrame:
    """Every policy in every case, at every set point of the grid and on the plants at the corners of the grid of models.

    Columns: group (case, set_point, model), case, row, column (factors), controller, objective, share (of the minimum variance that
    knows the plant), movement (of the inputs, as a share of that of the case's PID), held (whether the set point can be).
    """
    places = [("case", case, (1.0, 1.0), study) for case, study in ground.cases.items()]
    places += [("set_point", *place) for place in ground.grid()]
    for case, study in ground.cases.items():
        for state in (ground.state_factors[0], ground.state_factors[-1]):
            for entry in (ground.input_factors[0], ground.input_factors[-1]):
                places.append(("model", case, (state, entry), mismatched(study, state, entry)))
    rows = []
    for group, case, (row, column), study in places:
        number, held = ground.scale.judged if group == "case" else ground.scale.grid, holdable(study)
        best, _ = returns(ground, study, study.minimum_variance, number)
        pid, record = returns(ground, study, study.expert, number)
        found = {"minimum_variance": (best, None), "expert": (pid, record)}
        found |= {name: returns(ground, study, AtSetPoint(tracker, study.task), number) for name, tracker in trackers.items()}
        for name, (value, batch) in found.items():
            moved = torch.nan if batch is None else (ground.moved(batch.u).mean() / ground.moved(record.u).mean()).item()
            rows.append((group, case, f"{row:g}", f"{column:g}", name, value, value / best, moved, held))
    columns = ["group", "case", "row", "column", "controller", "objective", "share", "movement", "held"]
    return pd.DataFrame(rows, columns=columns)


def goals(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """The figures of merit of `judged` a case and a controller, as shares of minimum variance."""
    table = table[table["controller"].isin(names)]
    by = ["controller", "case"]
    at = {group: rows.groupby(by, sort=False) for group, rows in table.groupby("group")}
    corners = table[(table["group"] == "model") & table["held"]].groupby(by, sort=False)["share"]
    return pd.DataFrame(
        {
            "J(30)": at["case"]["objective"].mean(),
            "share": at["case"]["share"].mean(),
            "movement": at["case"]["movement"].mean(),
            "set points, mean": at["set_point"]["share"].mean(),
            "set points, least": at["set_point"]["share"].min(),
            "corners held": corners.count(),
            "corners, least": corners.min(),
        }
    )
