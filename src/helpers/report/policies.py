"""The trained policies of the first seed, to take along: safetensors, ONNX and C, with a card each. `publish` writes them."""

import copy
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional

from helpers.learning.policy import RELU6_TOP, LSTMPolicy
from helpers.learning.tracking_policy import TrackingPolicy
from helpers.own_plant.deploy import export, export_c, write
from helpers.plant.task import ControlTask
from helpers.report.tables import ROMAN
from helpers.runs.artifacts import RECORD, Stage, load_stage
from helpers.runs.policies import load_policy
from helpers.runs.sources import PROJECT
from helpers.settings.paper import HEADLINE, Params, load, load_published

Scores = dict[int, dict[str, float]]  # J by case and controller
ONE, STATE = "one_policy", "policy.safetensors"
TRAINED_ON = {
    "offline": "The records of the PID and the model of the process, by Algorithms 1 and 2 in our variant; not on the plant",
    "online": "The offline policy of its case and simulated episodes of the plant, for the tracking objective",
    ONE: "The model of the process, by the gradient through it, for set points drawn from the range below; not on the plant",
}
CARD = """\
# {name}

{title}.

- **Trained on:** {trained_on}. By `notebooks/{notebook}.ipynb`, seed {seed}, scale `{scale}`, at commit {revision}.
- **For set points:** {set_points}. **Inputs:** {inputs}. **Sampling time:** {sampling_time:g}. These are deviation variables, for
  which the paper prints no units.
- **Measured:** J of Eq. 5.1.2.1 with beta = {beta:g} on the true state, mean over fresh simulated episodes. {scores}.
- **Not for:** Other set points, bounds or sampling times, another process, or a real plant, which it has never met.

`helpers.runs.policies.load_policy("{name}")` reads `{name}.safetensors`. `{name}.onnx` and `{name}.c` compute one sample: from the
measurement, the set point, the input applied last and the memory, which is zero at first, to the input to apply and the memory.
"""


class ModeStep(nn.Module):
    """One sample of the mode of an `LSTMPolicy`, in deviation variables: double precision around a network in single precision."""

    def __init__(self, policy: LSTMPolicy, task: ControlTask) -> None:
        super().__init__()
        self.policy = copy.deepcopy(policy).float()
        self.low, self.span = task.input_low.double(), (task.input_high - task.input_low).double()

    @property
    def memory(self) -> dict[str, Tensor]:
        """Zeros for h and c of each layer, by name."""
        sizes = [layer.hidden_size for layer in self.policy.lstms]
        return {f"{kind}_{index}": torch.zeros(1, size) for index, size in enumerate(sizes) for kind in "hc"}

    def forward(self, y: Tensor, set_point: Tensor, u_previous: Tensor, *memory: Tensor) -> tuple[Tensor, ...]:
        """The input to apply, (K, n_u), and the memory for the next sample."""
        error, share = (set_point - y) / self.policy.error_unit.double(), (u_previous - self.low) / self.span
        signal = torch.cat([error, 2 * share - 1], dim=-1).float()
        after: list[Tensor] = []
        for layer, *states in zip(self.policy.lstms, memory[::2], memory[1::2], strict=True):
            output, found = layer(signal[None], tuple(state[None] for state in states))
            after += [state[0] for state in found]
            signal = functional.leaky_relu(output[0], self.policy.params.leaky_slope)
        top = functional.relu6(self.policy.output(signal)[:, : len(self.low)]).double()
        return (self.low + self.span * top / RELU6_TOP, *after)


def write_policies(first: Path, folder: Path, params_root: Path = PROJECT / "params") -> None:
    """Write every policy that the results of a seed in `first` hold, as safetensors, ONNX and C, and its card."""
    for name, kind, stage, params, scores in collect(first, params_root):
        state = load_file(stage.path(STATE))
        card = _card(kind, stage, params, scores, state)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.safetensors").write_bytes(save(state, {"card": json.dumps(card)}))
        trained = load_policy(name, folder)
        task = trained.study(params_root=params_root).task
        _write_onnx(trained.policy, task, folder / f"{name}.onnx", card)
        with tempfile.TemporaryDirectory() as scratch:
            static = _write_onnx(trained.policy, task, Path(scratch) / "static.onnx", {}, static=True)
            export_c(static, folder / f"{name}.c")
        (folder / f"{name}.md").write_text(_shown(name, card), encoding="utf-8")


def _write_onnx(
    policy: LSTMPolicy | TrackingPolicy, task: ControlTask, path: Path, card: dict[str, Any], static: bool = False
) -> Path:
    y, u = (torch.zeros(1, len(values), dtype=torch.float64) for values in (task.set_point, task.input_low))
    if isinstance(policy, TrackingPolicy):
        return export(policy, y[0], u[0], path, card, static)
    step = ModeStep(policy, task)
    return write(step, (y, y, u, *step.memory.values()), list(step.memory), path, card, static)


def collect(first: Path, params_root: Path) -> Iterator[tuple[str, str, Stage, Params, Scores]]:
    """Name, kind, stage and parameters of every policy, and J of it and its rivals a case."""
    cases = {case: load(params_root, case) for case in load_published(params_root)}
    for case, params in cases.items():
        names = {"offline": "offline" if params.case.offline.transfer_from is None else "transfer", "online": "online"}
        places = {kind: first / f"case_{case}/{name}_{HEADLINE}" for kind, name in names.items()}
        if all((place / RECORD).is_file() for place in places.values()):
            stages = {kind: load_stage(place, "make reports") for kind, place in places.items()}
            rows = pd.concat([stage.table("scores.csv") for stage in stages.values()])
            found = rows[rows["metric"] == "objective_x"].set_index("stage")["value"]
            for kind, stage in stages.items():
                yield f"case_{case}_{kind}", kind, stage, params, {case: _scores(found, kind, "expert_paired")}
    place = first / "case_1" / ONE
    if (place / RECORD).is_file():
        stage = load_stage(place, "make evidence")
        rows = stage.table("judged.csv").query("group == 'case'")
        judged = {case: part.set_index("controller")["objective"] for case, part in rows.groupby("case")}
        yield ONE, ONE, stage, cases[1], {case: _scores(found, ONE, "expert") for case, found in judged.items()}


def _scores(found: pd.Series, policy: str, expert: str) -> dict[str, float]:
    names = {"the policy": policy, "the PID": expert, "minimum variance": "minimum_variance"}
    return {name: float(found[row]) for name, row in names.items()}


def _card(kind: str, stage: Stage, params: Params, scores: Scores, state: Mapping[str, Tensor]) -> dict[str, Any]:
    """What a policy file tells about itself."""
    process, target = params.process, torch.tensor(params.case.set_point)
    low, high = (state.get("centre", target) + sign * state.get("reach", 0 * target) for sign in (-1, 1))
    return {
        "title": "One policy for all case studies" if kind == ONE else f"{params.case.title}; after {kind} learning",
        "trained_on": TRAINED_ON[kind],
        **{key: stage.record[key] for key in ("notebook", "seed", "scale", "revision")},
        "set_point_range": dict(zip(process.controlled, zip(low.tolist(), high.tolist(), strict=True), strict=True)),
        "input_range": dict(zip(process.manipulated, zip(process.input_low, process.input_high, strict=True), strict=True)),
        "sampling_time": process.sampling_time,
        "beta": params.case.online.headline_beta,
        "scores": scores,
        "policy": params.learning.policy.model_dump(),
    }


def _shown(name: str, card: Mapping[str, Any]) -> str:
    """The card as Markdown."""

    def ranges(found: Mapping[str, tuple[float, float]]) -> str:
        return ", ".join(f"{key} {low:g}" + (f" to {high:g}" if high > low else "") for key, (low, high) in found.items())

    scores = "; ".join(
        f"Case {ROMAN[case - 1]}: {', '.join(f'{value:.2f} for {who}' for who, value in found.items())}"
        for case, found in card["scores"].items()
    )
    words = {"set_points": ranges(card["set_point_range"]), "inputs": ranges(card["input_range"]), "scores": scores}
    return CARD.format(**dict(card) | words, name=name)
