"""The trained policies of the first seed, to take along: safetensors, ONNX and C, with a card each. `publish` writes them."""

import copy
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

from helpers.learning.policy import RELU6_TOP, LSTMPolicy
from helpers.learning.tracking_policy import TrackingPolicy
from helpers.own_plant.deploy import export, export_c, write
from helpers.plant.task import ControlTask
from helpers.report.collection import ONE_POLICY, ONLINE, offline_folder
from helpers.report.tables import ROMAN
from helpers.runs.artifacts import RECORD, load_stage
from helpers.runs.policies import TrainedPolicy, rebuilt
from helpers.runs.sources import PROJECT
from helpers.settings.paper import Params, load, load_published

LEARNT = "records of the PID and the model of the process, by Algorithms 1 and 2 in our improved variant; not on the plant"
TRAINED_ON = {
    "offline": f"the {LEARNT}",
    "transfer": f"the weights and the offline policy of Case Study I, then the {LEARNT}",
    "online": "the offline policy of its case and simulated episodes of the plant, for the tracking objective",
    ONE_POLICY: "the model of the process, by the gradient through it, for set points drawn from the range below; not on the plant",
}
CARD = """\
# {name}

{title}

- **Trained on** {trained_on} (`notebooks/{notebook}.ipynb`, seed {seed}, scale `{scale}`, commit {revision}).
- **For set points** {set_points}; **inputs** {inputs}; **sampling time** {sampling_time:g}; deviation variables, for which the
  paper prints no units.
- **Measured** by J of Eq. 5.1.2.1 with beta = {beta:g} on the true state, mean over {episodes} fresh simulated episodes: {scores}.
- **Not for** other set points, bounds or sampling times, another process, or a real plant, which it has never met.

`helpers.runs.policies.load_policy("{name}")` reads `{name}.safetensors`. `{name}.onnx` and `{name}.c` compute one sample: from the
measurement, the set point, the input applied last and the memory, which is zero at first, to the input to apply and the memory.
"""


class ModeStep(nn.Module):
    """One sample of the mode of an `LSTMPolicy`, in deviation variables: double precision around a network in single precision."""

    def __init__(self, policy: LSTMPolicy, task: ControlTask) -> None:
        super().__init__()
        self.policy = copy.deepcopy(policy).float()
        self.low, self.span = task.input_low.double(), (task.input_high - task.input_low).double()
        sizes = [layer.hidden_size for layer in policy.lstms]
        self.memory = {f"{kind}_{index}": torch.zeros(1, size) for index, size in enumerate(sizes) for kind in "hc"}

    def forward(self, y: Tensor, set_point: Tensor, u_previous: Tensor, *memory: Tensor) -> tuple[Tensor, ...]:
        """The input to apply, (K, n_u), and the memory for the next sample."""
        error, share = (set_point - y) / self.policy.error_unit.double(), (u_previous - self.low) / self.span
        signal = torch.cat([error, 2 * share - 1], dim=-1).float()
        after: list[Tensor] = []
        for layer, *states in zip(self.policy.lstms, memory[::2], memory[1::2], strict=True):
            output, found = layer(signal[None], tuple(state[None] for state in states))
            after += [state[0] for state in found]
            signal = nn.functional.leaky_relu(output[0], self.policy.params.leaky_slope)
        top = nn.functional.relu6(self.policy.output(signal)[:, : len(self.low)]).double()
        return (self.low + self.span * top / RELU6_TOP, *after)


def write_policies(first: Path, folder: Path, params_root: Path = PROJECT / "params") -> None:
    """Write every policy that the results of a seed in `first` hold, as safetensors, ONNX and C, and its card."""
    cases = {case: load(params_root, case) for case in load_published(params_root)}
    places = {ONE_POLICY: (ONE_POLICY, list(cases), f"case_1/{ONE_POLICY}")}
    for case, params in cases.items():
        for kind, stage in (("offline", offline_folder(params)), ("online", ONLINE)):
            places[f"case_{case}_{kind}"] = (kind, [case], f"case_{case}/{stage}")
    for name, (kind, of_cases, place) in places.items():
        if (first / place / RECORD).is_file():
            found = load_stage(first / place, "make evidence")
            state, params = load_file(found.path("policy.safetensors")), cases[of_cases[0]]
            card = _card(kind, found.record, params, state) | {"cases": of_cases, "scores": {}}
            trained = TrainedPolicy(rebuilt(params.learning.policy, state), card)
            for case in of_cases:  # on the episodes on which the published run has judged them
                study = trained.study(case, params_root)
                rivals = {"policy": trained.policy, "PID": study.expert, "minimum variance": study.minimum_variance}
                card["scores"][str(case)] = {who: study.judge(study.fresh(rival))["objective_x"] for who, rival in rivals.items()}
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}.safetensors").write_bytes(save(state, {"card": json.dumps(card)}))
            (folder / f"{name}.md").write_text(_shown(name, card), encoding="utf-8")
            task = trained.study(params_root=params_root).task
            _write_onnx(trained.policy, task, folder / f"{name}.onnx", card)
            with tempfile.TemporaryDirectory() as scratch:
                export_c(_write_onnx(trained.policy, task, Path(scratch) / "static.onnx", {}, static=True), folder / f"{name}.c")


def _card(kind: str, record: Mapping[str, Any], params: Params, state: Mapping[str, Tensor]) -> dict[str, Any]:
    """What a policy file tells about itself, but for its scores."""
    process, target = params.process, torch.tensor(params.case.set_point)
    low, high = (state.get("centre", target) + sign * state.get("reach", 0 * target) for sign in (-1, 1))
    return {
        "title": "One policy for all case studies." if kind == ONE_POLICY else f"{params.case.title}; after {kind} learning.",
        "trained_on": TRAINED_ON["transfer" if kind == "offline" and params.case.offline.transfer_from else kind],
        **{key: record[key] for key in ("notebook", "seed", "scale", "revision")},
        "set_point_range": dict(zip(process.controlled, torch.stack([low, high], dim=1).tolist(), strict=True)),
        "input_range": {
            name: list(ends) for name, *ends in zip(process.manipulated, process.input_low, process.input_high, strict=True)
        },
        "sampling_time": process.sampling_time,
        "beta": params.case.online.headline_beta,
        "episodes": params.learning.scales[record["scale"]].evaluation,
        "policy": params.learning.policy.model_dump(mode="json"),
    }


def _shown(name: str, card: Mapping[str, Any]) -> str:
    """The card as Markdown."""
    words = {
        key: ", ".join(f"{variable} {low:g}" + (f" to {high:g}" if high > low else "") for variable, (low, high) in found.items())
        for key, found in (("set_points", card["set_point_range"]), ("inputs", card["input_range"]))
    }
    scores = {case: ", ".join(f"{who} {value:.2f}" for who, value in found.items()) for case, found in card["scores"].items()}
    words["scores"] = "; ".join(f"Case {ROMAN[int(case) - 1]}, {said}" for case, said in scores.items())
    return CARD.format(**dict(card) | words, name=name)


def _write_onnx(
    policy: LSTMPolicy | TrackingPolicy, task: ControlTask, path: Path, card: dict[str, Any], static: bool = False
) -> Path:
    y, u = (torch.zeros(1, len(values), dtype=torch.float64) for values in (task.set_point, task.input_low))
    if isinstance(policy, TrackingPolicy):
        return export(policy, y[0], u[0], path, card, static)
    step = ModeStep(policy, task)
    return write(step, (y, y, u, *step.memory.values()), list(step.memory), path, card, static)
