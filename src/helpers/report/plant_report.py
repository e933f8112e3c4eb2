"""From a historian file to a controller in one command: `python -m helpers plant plant.yaml --output folder`.

It reads, repairs, identifies, tunes the rivals, learns one policy for the range of the record, and judges all on models held out.
Only a policy that passes is exported. Nothing is applied to a plant.
"""

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import torch
from matplotlib.figure import Figure

from helpers.learning.learner import TrainingError
from helpers.learning.tracking_policy import TrackingPolicy
from helpers.own_plant.deploy import STATIC, DeployedPolicy, disagreement, export, export_c
from helpers.own_plant.gate import POLICY
from helpers.own_plant.learn import (
    OwnPlant,
    Workshop,
    candidates,
    identify_plant,
    learn_offline,
    learn_policy,
    open_plant,
    open_workshop,
    parameter_table,
    pass_gate,
    task_on,
    tune,
)
from helpers.own_plant.model import load_plant
from helpers.own_plant.online import improve_on_plant
from helpers.plant.tracking import track
from helpers.report.figures import DPI_FILE
from helpers.report.plant_figures import gate_figure, loops_figure, progress_figure, quality_figure, validation_figure
from helpers.report.tables import capital
from helpers.runs.request import check_place
from helpers.runs.scratch import beside, sweep
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import InputError
from helpers.settings.paper import load

AGREEMENT = 1e-5  # of the input range, between the exported policy and torch
MEANINGLESS = 10.0  # a relative feature gap beyond which a feature of the record is next to zero
NAMES = ("policy.onnx", f"policy{STATIC}.onnx", "policy.c", "report.md")  # what the command writes beside its figures


class Outcome(NamedTuple):
    """What the command found; tables and figures by name, and the sentences of the report, the verdict first."""

    tables: dict[str, pd.DataFrame]
    figures: dict[str, Figure]
    sentences: tuple[str, ...]


def notes(workshop: Workshop) -> dict[str, object]:
    """What a policy file tells about itself."""
    description, operation = workshop.plant.description, workshop.operation
    keys = {"name", "tag", "unit", "low", "high", "steady_state"}
    ends = torch.stack([operation.low, operation.high], dim=-1).double() + description.steady("controlled")[:, None]
    return {
        "title": description.title,
        "sampling_time": [description.sampling_time, description.time_unit],
        "controlled": [variable.model_dump(include=keys) for variable in description.controlled],
        "manipulated": [variable.model_dump(include=keys) for variable in description.manipulated],
        "set_point_range": [
            [float(low), float(high)] if index in operation.loops else [variable.low, variable.high]
            for index, ((low, high), variable) in enumerate(zip(ends, description.controlled, strict=True))
        ],
    }


def export_policy(workshop: Workshop, policy: TrackingPolicy, folder: Path) -> float:
    """Write policy.onnx, the same with batch 1 and fixed shapes, and as C source.

    Returns the greatest disagreement with torch over whole episodes, as a share of the input range; InputError if they disagree.
    """
    description = workshop.plant.description
    steady = description.steady("controlled"), description.steady("manipulated")
    paths = [folder / name for name in NAMES[:3]]
    export(policy, *steady, paths[0], notes(workshop))
    export_c(export(policy, *steady, paths[1], notes(workshop), static=True), paths[2])
    scenarios = workshop.draw(workshop.held_out, 20, workshop.plant.stream("export"))
    with torch.no_grad():
        run = track(policy, scenarios, workshop.operation.bounds)
    worst = disagreement(policy, DeployedPolicy(paths[0]), run.y[:-1], run.set_point, *steady)
    if not worst <= AGREEMENT:  # nan is not
        raise InputError(f"{paths[0]}: the exported policy differs from the learned one by {worst:.1g} of the input range")
    return worst


def offline(plant: OwnPlant, workshop: Workshop) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """What the record's controller was after, by Algorithm 2: the table of its weights, and sentences."""
    model = workshop.nominal.to(plant.dtype)
    try:
        shown = plant.demonstrations
        study, found = learn_offline(plant, model, task_on(plant, model))
    except (InputError, TrainingError) as error:
        return {}, [f"the weights of the record's controller were not found: {error}"]
    total, horizon = shown.trajectories.n_trajectories, plant.description.horizon
    told = [f"{total} episodes of {horizon} samples show what the record's PID is after"]
    told += [f"left out: {number} episodes ({reason})" for reason, number in shown.left_out.items() if number]
    if (gap := min(record.feature_gap for record in found.records)) > MEANINGLESS:
        why = "a feature of the record is next to zero, its variable is far from its set point"
        return {}, [*told, f"Algorithm 2 has nothing to match: {why}"]
    weights = pd.DataFrame({"alpha*": found.weights.tolist()}, index=study.feature_names)
    return {"Reward weights": weights}, [*told, f"Algorithm 2 matches their features to {100 * gap:.1f} %"]


def work(path: Path, folder: Path, params_root: Path, scale: str, seed: int) -> tuple[str, Outcome]:
    """The whole chain for one description: its title and what was found; policy files go into `folder`.

    What cannot be used is refused by an InputError in one sentence; OSError if `folder` cannot be written.
    """
    params = load(params_root, 1)
    torch.set_num_threads(params.learning.scales[scale].threads)
    plant = open_plant(path, params_root, scale, seed, params)
    name = plant.description.plant
    given = load_plant(name, plant.description) if name else None
    identified, validation = identify_plant(plant)
    workshop = open_workshop(plant, identified)
    tuned, predictive = tune(workshop)
    policy, records = learn_policy(workshop, tuned)
    controllers = candidates(workshop, tuned, predictive, policy)
    verdict = pass_gate(workshop, controllers)
    sentences = [
        verdict.words,
        f"{len(plant.clean.table)} samples, {len(plant.clean.findings)} findings",
        f"the controller of the record: the PID {'of the description' if plant.description.pid else 'found in it'}; a PID that is "
        f"fitted to the record explains {100 * workshop.explained:.0f} % of the moves of the inputs",
        *(f"warning: {words}" for words in (*identified.warnings, *validation.warnings)),
    ]
    if verdict.released:
        if given is not None:
            improvement = improve_on_plant(workshop, identified, policy, given)
            controllers[POLICY] = policy = improvement.policy
            sentences.append(improvement.words)
        worst = export_policy(workshop, policy, folder)
        sentences.append(f"policy.onnx agrees with the learned policy to {worst:.1g} of the input range over whole episodes")
    tables, words = offline(plant, workshop)
    quality = plant.clean.section()
    fit = parameter_table(plant, identified).assign(**{"fit held out": validation.fit, "Ljung-Box p": validation.p_value})
    tables = {"Controllers on models held out": verdict.table, "Model": fit.T, **tables, "Data quality": quality}
    figures = {
        "gate": gate_figure(verdict),
        "loops": loops_figure(workshop, controllers, plant.description),
        "learning": progress_figure(records),
        "model": validation_figure(validation, plant.description),
        "quality": quality_figure(plant.clean, plant.description),
    }
    return plant.description.title, Outcome(tables, figures, (*sentences, *words))


def run(path: Path, output: Path, params_root: Path, scale: str, seed: int) -> Outcome:
    """`work`, and its report; `output` changes only when all is there, and holds a policy only beside the report on it."""
    output.parent.mkdir(parents=True, exist_ok=True)
    sweep(output)
    partial = beside(output)
    try:
        partial.mkdir()
        title, outcome = work(path, partial, params_root, scale, seed)
        write(outcome, title, partial)
        output.mkdir(exist_ok=True)
        for name in NAMES:
            (output / name).unlink(missing_ok=True)
        for file in sorted(partial.iterdir(), key=lambda file: NAMES.index(file.name) if file.name in NAMES else -1):
            file.replace(output / file.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return outcome


def write(outcome: Outcome, title: str, output: Path) -> None:
    """report.md with its figures beside it; the first line is the verdict."""
    verdict, *others = outcome.sentences
    parts = [f"**{capital(verdict)}.**", "", f"# {title}", "", *(f"- {sentence}" for sentence in others)]
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
    except (InputError, TrainingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error.filename or given.output}: {error.strerror or error}", file=sys.stderr)
        return 1
    print("\n".join(outcome.sentences))
    released = (given.output / NAMES[0]).is_file()
    print(f"written: {given.output / 'report.md'}, its figures{' and the policy' if released else ''} beside it")
    return 0
