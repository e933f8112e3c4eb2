"""From a historian file to a controller in one command: `python -m helpers plant plant.yaml --output folder`.

It reads, repairs, identifies, learns, exports, and writes a report of all that. Nothing is applied to a plant.
"""

import argparse
import copy
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
from matplotlib.figure import Figure

from helpers.learning.evaluation import feature_gap
from helpers.learning.policy import LSTMPolicy
from helpers.own_plant.deploy import DeployedPolicy, disagreement, export
from helpers.own_plant.learn import (
    OwnPlant,
    as_measured,
    compare,
    history,
    identify_plant,
    improve_on,
    judge,
    learn_offline,
    open_plant,
    task_at_rest,
    task_on,
    transfer,
)
from helpers.own_plant.model import load_plant
from helpers.plant.process import Process
from helpers.plant.task import ControlTask, Trajectories
from helpers.report.figures import DPI_FILE, learning_curves
from helpers.report.plant_figures import quality_figure, response_figure, validation_figure
from helpers.runs.request import check_place
from helpers.runs.scratch import beside, sweep
from helpers.runs.sources import PROJECT
from helpers.runs.study import response_table
from helpers.settings.leaf import InputError
from helpers.settings.paper import load

AGREEMENT = 1e-5  # of the input range, between the exported policy and torch


@dataclass(frozen=True)
class Outcome:
    """What the command found; tables and figures by name, and the sentences of the report."""

    tables: dict[str, pd.DataFrame]
    figures: dict[str, Figure]
    sentences: tuple[str, ...]


def notes(plant: OwnPlant) -> dict[str, object]:
    """What a policy file tells about itself."""
    description = plant.description
    keys = {"name", "tag", "unit", "low", "high", "steady_state"}
    return {
        "title": description.title,
        "sampling_time": [description.sampling_time, description.time_unit],
        "controlled": [variable.model_dump(include=keys | {"set_point"}) for variable in description.controlled],
        "manipulated": [variable.model_dump(include=keys) for variable in description.manipulated],
    }


def export_policy(plant: OwnPlant, policy: LSTMPolicy, process: Process, task: ControlTask, path: Path) -> float:
    """Write the policy as ONNX and check it over whole episodes; the greatest disagreement, as a share of the input range.

    Raises:
        InputError: if file and policy disagree; what was at `path` before stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep(path)
    partial = beside(path)
    steady = plant.description.steady("controlled"), plant.description.steady("manipulated")
    batch = compare(plant, process, task, {"policy": policy})["policy"]
    try:
        export(policy, task, *steady, partial, notes(plant))
        worst = disagreement(policy, DeployedPolicy(partial), task, batch.y, batch.u, *steady)
        if not worst <= AGREEMENT:  # nan is not
            raise InputError(f"{path}: the exported policy differs from the learned one by {worst:.1g} of the input range")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return worst


def exported(plant: OwnPlant, policy: LSTMPolicy, process: Process, task: ControlTask, path: Path) -> str:
    """`export_policy` as a sentence of the report."""
    worst = export_policy(plant, policy, process, task, path)
    return f"{path.name} agrees with the learned policy to {worst:.1g} of the input range over whole episodes"


def beside_the_record(plant: OwnPlant, batch: Trajectories) -> Figure:
    """The response under a policy beside the recorded one."""
    recorded = plant.demonstrations.trajectories
    response = response_table(as_measured(batch), as_measured(recorded), plant.controlled, plant.manipulated)
    return response_figure(response, plant.description)


def run(path: Path, output: Path, params_root: Path, scale: str, seed: int) -> Outcome:
    """The whole chain for one description; writes into `output`.

    What the plant, the transfer or the folder may lack is found before anything is learned.

    Raises:
        InputError: in one sentence, if something that was given cannot be used. OSError: if `output` cannot be written.
    """
    params = load(params_root, 1)
    torch.set_num_threads(params.learning.scales[scale].threads)
    plant = open_plant(path, params_root, scale, seed, params)
    name = plant.description.plant
    given = load_plant(name, plant.description) if name else None
    if plant.description.transfer:
        plant.with_set_points(plant.description.transfer)  # for its refusals alone
    output.mkdir(parents=True, exist_ok=True)
    found = plant.demonstrations
    sentences = [
        f"{len(plant.clean.table)} samples, {len(plant.clean.findings)} findings, {found.trajectories.n_trajectories} episodes of "
        f"{plant.description.horizon} samples",
        *(f"left out: {number} episodes ({reason})" for reason, number in found.left_out.items() if number),
    ]
    identified, validation = identify_plant(plant)
    sentences += [f"warning: {words}" for words in (*identified.warnings, *validation.warnings)]
    model = identified.model.to(plant.dtype)
    task = task_on(plant, model)
    offline = learn_offline(plant, model, task)
    process: Process = model if given is None else given
    sentences.append(f"online learning ran on {name}" if name else "online learning ran on the identified model: no plant is named")
    plant_task = task_at_rest(plant, process) if name else task
    online, _ = improve_on(plant, copy.deepcopy(offline.policy), process, plant_task)
    batches = compare(plant, process, plant_task, {"offline": offline.policy, "online": online})
    features = plant.features(plant_task)
    recorded = judge(plant, plant_task, {"record": found.trajectories, **batches})
    gap = feature_gap(features.trajectory(batches["offline"]).mean(0), features.trajectory(found.trajectories).mean(0))
    sentences.append(f"feature gap between the offline policy and the record: {100 * gap:.1f} %")
    sentences.append(exported(plant, online, process, plant_task, output / "policy.onnx"))
    fit = pd.DataFrame({"fit": validation.fit, "Ljung-Box p": validation.p_value}, index=list(plant.controlled))
    weights = pd.DataFrame({"alpha*": offline.weights.tolist()}, index=plant.feature_names)
    tables = {
        "Data quality": plant.clean.section(),
        "Model on held-out records": fit,
        "Reward weights": weights,
        "Controllers": recorded,
    }
    learned = history(offline.records, plant.feature_names)
    figures = {
        "quality": quality_figure(plant.clean, plant.description),
        "model": validation_figure(validation, plant.description),
        "learning": learning_curves(learned),
        "response": beside_the_record(plant, batches["online"]),
    }
    if plant.description.transfer:
        moved = transfer(plant, offline, model, process, plant.description.transfer)
        policies = {"before": offline.policy, "transferred": moved.offline.policy, "online": moved.online}
        batches = compare(moved.plant, process, moved.task, policies)
        batches = {"record": moved.plant.demonstrations.trajectories, **batches}
        tables["Controllers after the transfer"] = judge(moved.plant, moved.task, batches)
        figures["response_transfer"] = beside_the_record(moved.plant, batches["online"])
        sentences.append(exported(moved.plant, moved.online, process, moved.task, output / "policy_transfer.onnx"))
    outcome = Outcome(tables, figures, tuple(sentences))
    write(outcome, plant.description.title, output)
    return outcome


def write(outcome: Outcome, title: str, output: Path) -> None:
    """report.md with its figures beside it."""
    parts = [f"# {title}", *(f"- {sentence}" for sentence in outcome.sentences)]
    for name, table in outcome.tables.items():
        parts += ["", f"## {name}", "", table.to_markdown(floatfmt=".4g", index=name != "Data quality")]
    for name, figure in outcome.figures.items():
        figure.savefig(output / f"{name}.png", dpi=DPI_FILE)
        parts += ["", f"![{name}]({name}.png)"]
    (output / "report.md").write_text("\n".join(parts) + "\n", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m helpers plant", description="From a historian file to a controller.")
    parser.add_argument("description", type=Path, help="the YAML file that describes the plant and its historian file")
    parser.add_argument("--output", type=Path, default=Path("results/own_plant"), help="where report.md and policy.onnx go")
    parser.add_argument("--scale", choices=("smoke", "paper"), default="paper", help="smoke: seconds, to see that it runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--params", type=Path, default=PROJECT / "params", help="the folder of parameter files")
    given = parser.parse_args(arguments)
    try:
        check_place("output", given.output)
        outcome = run(given.description, given.output, given.params, given.scale, given.seed)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error.filename or given.output}: {error.strerror or error}", file=sys.stderr)
        return 1
    print("\n".join(outcome.sentences))
    print(f"written: {given.output / 'report.md'}, its figures and policies beside it")
    return 0
