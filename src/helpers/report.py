"""The report: collect what the stages wrote, set it beside the paper, draw and typeset. It computes no result."""

import itertools
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd
import pypandoc
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure

from helpers import drawings, figures, tables
from helpers.artifacts import ArtifactError, Stage, code_revision, load_stage, versions
from helpers.features import feature_names
from helpers.params import OnlineParams, Params, PublishedCase, load, load_published
from helpers.request import PROJECT
from helpers.session import parameters_hash

TEMPLATE = PROJECT / "reports/template"
BENCHMARKS = PROJECT / "reports/reference/benchmarks"  # of make bench, a run of its own
DEMONSTRATIONS, ONLINE = "demonstrations", "online_improved"
OFFLINE = {"offline": "improved", "offline_printed": "printed"}  # stage in seeds.csv and the variant behind it
SCRATCH = "offline_improved"  # of a case that starts from another: the same learning without the transfer
MADE_BY = {"demonstrations": "01", "offline": "02", "online": "03 (04 for the transfer case)", "transfer": "04"}
LEARNING = {"offline": "improved", "offline_printed": "printed", "offline_scratch": "improved, from scratch"}
CONTROLLERS = {
    "expert_paired": "PID",
    "offline": "offline policy",
    "online": "online policy",
    "online_y": "online policy, learned on y",
}


@dataclass(frozen=True)
class Results:
    """What the stages of all cases and seeds wrote.

    Attributes:
        params, published: by case.
        stages: by case, seed and folder name.
        seeds: columns case, seed, stage, metric, value. The stages: expert; offline, online and online_y of the headline
            variant (offline of a transfer case is after the transfer); offline_printed; offline_scratch (the transfer
            case learned from nothing).
    """

    scale: str
    params: dict[int, Params]
    published: dict[int, PublishedCase]
    stages: dict[tuple[int, int, str], Stage]
    seeds: pd.DataFrame

    @cached_property
    def feature_names(self) -> list[str]:
        """Names of the features in their order."""
        return feature_names(next(iter(self.params.values())).process.controlled)

    def offline_folder(self, case: int, variant: str = "improved") -> str:
        """The folder of a case's offline learning."""
        return _offline_folder(self.params[case], variant)

    def table(self, case: int, folder: str, name: str, seed: int = 0) -> pd.DataFrame:
        """One table of one stage."""
        return self.stages[case, seed, folder].table(name)

    def score(self, case: int, folder: str, stage: str, metric: str, seed: int = 0) -> float:
        """One figure of merit of one stage."""
        rows = self.table(case, folder, "scores.csv", seed).set_index(["stage", "metric"])
        return float(rows.loc[(stage, metric), "value"])

    def medians(self, stage: str) -> pd.DataFrame:
        """The median over seeds of every metric of a stage: a row for each metric, a column for each case."""
        rows = self.seeds[self.seeds["stage"] == stage]
        return rows.pivot_table(index="metric", columns="case", values="value", aggfunc="median")


def _offline_folder(params: Params, variant: str) -> str:
    return f"offline_{variant}" if params.case.offline.transfer_from is None else f"transfer_{variant}"


def collect(root: Path, params_root: Path, scale: str, cases: tuple[int, ...], n_seeds: int) -> Results:
    """Read every stage of every case and seed below `root`.

    Raises:
        ArtifactError: if a stage is missing, damaged or was made with other parameters than the files now hold.
    """
    params = {case: load(params_root, case) for case in cases}
    published = load_published(params_root)
    stages: dict[tuple[int, int, str], Stage] = {}
    frames = []
    for case, record in params.items():
        folders = {DEMONSTRATIONS: {"expert": "expert"}, ONLINE: {name: name for name in ("expert_paired", "online", "online_y")}}
        folders |= {_offline_folder(record, variant): {"offline": name} for name, variant in OFFLINE.items()}
        if record.case.offline.transfer_from is not None:
            folders[SCRATCH] = {"offline": "offline_scratch"}
        for seed in range(n_seeds):
            for folder, names in folders.items():
                notebook = MADE_BY[folder.split("_")[0]]
                path = root / scale / f"seed_{seed}" / f"case_{case}" / folder
                stage = load_stage(path, f"notebook {notebook} for case {case} and seed {seed}")
                if stage.record.get("parameters") != parameters_hash(record):
                    raise ArtifactError(
                        f"{path / 'record.json'}: made with other parameters than {params_root} holds now; run it again"
                    )
                stages[case, seed, folder] = stage
                scores = stage.table("scores.csv", ("stage", "metric", "value"))
                frames.append(scores.assign(case=case, seed=seed, stage=scores["stage"].map(names)))
    seeds = pd.concat(frames, ignore_index=True)[["case", "seed", "stage", "metric", "value"]]
    return Results(scale, params, {case: published[case] for case in cases}, stages, seeds)


def draw(results: Results) -> dict[str, Figure]:
    """All figures of the report by name, from the first seed."""
    first = next(iter(results.params.values()))
    policy, process = first.learning.policy, first.process
    descriptions = dict(zip(process.controlled, process.controlled_description, strict=True))
    descriptions |= dict(zip(process.manipulated, process.manipulated_description, strict=True))
    drawn = {
        "figure_1": drawings.mdp_figure(),
        "figure_2": drawings.framework_figure(),
        "network": drawings.network_figure(
            policy.hidden_cells, len(process.controlled), len(process.manipulated), policy.leaky_slope
        ),
    }
    for case, params in results.params.items():
        target = params.case.set_point
        offline = results.offline_folder(case)
        response = results.table(case, ONLINE, "response.csv")
        drawn[f"control_case_{case}"] = figures.control_figure(
            response, process.controlled, process.manipulated, target, descriptions
        )
        response = results.table(case, offline, "response.csv")
        drawn[f"tracking_case_{case}"] = figures.tracking_figure(response, process.controlled, target, descriptions)
        chosen = int(results.score(case, offline, "offline", "chosen_epoch"))
        drawn[f"learning_curves_case_{case}"] = figures.learning_curves(
            results.table(case, offline, "history.csv"),
            marks={chosen: "policy taken from here"},
            gap_levels={"the paper's own gap": results.published[case].feature_gap},
        )
        history = results.table(case, ONLINE, "history.csv")
        drawn[f"online_curves_case_{case}"] = figures.learning_curves(history, marks=_rounds(params.case.online, len(history)))
    for number, name in (("3", "control_case_1"), ("4", "tracking_case_2"), ("5", "control_case_2"), ("6", "control_case_3")):
        if name in drawn:
            drawn[f"figure_{number}"] = drawn.pop(name)
    return drawn


def _rounds(online: OnlineParams, n_epochs: int) -> dict[int, str]:
    """The last epoch before each later round of online learning, and that round's beta, to mark on a curve.

    At smoke scale a run has fewer epochs than the parameters say; its rounds shrink alike.
    """
    ends = [round(n_epochs * end / sum(online.epochs)) for end in itertools.accumulate(online.epochs[:-1])]
    return {end: f"next round, β = {beta:g}" for end, beta in zip(ends, online.beta[1:], strict=True)}


def tabulate(results: Results) -> dict[str, pd.DataFrame]:
    """All tables of the report by name."""
    names = results.feature_names
    process = next(iter(results.params.values())).process
    expert, offline = results.medians("expert"), results.medians("offline")
    tabulated = {"table_1": tables.table_1({case: params.case for case, params in results.params.items()}, process)}
    for case, published in results.published.items():
        ours = {
            row: {name: frame.loc[f"{kind}:{name}", case] for name in names}
            for row, frame, kind in (("expert", expert, "v"), ("policy", offline, "v"), ("alpha", offline, "alpha"))
        }
        tabulated[f"table_{published.table}"] = tables.results_table(published, **ours, feature_names=names)
    gaps = tables.gaps(results.seeds, results.published, names)
    tabulated["gaps"] = gaps
    tabulated["comparison"] = tables.comparison(results.published, results.seeds, names)
    costs = []
    for stage, label in LEARNING.items():
        medians = results.medians(stage)
        for case in medians.columns:
            column = medians[case]
            costs.append({"case": case, "learning": label, "feature gap, %": 100 * column["feature_gap"]})
            costs[-1] |= {
                name.replace("_", " "): int(column[name]) for name in ("epochs", "chosen_epoch", "episodes", "gradient_steps")
            }
    tabulated["variants"] = pd.DataFrame(costs).sort_values(["case", "learning"], ignore_index=True)
    rows = []
    for case in results.params:
        for stage, label in CONTROLLERS.items():
            column = results.medians(stage)[case]
            row = {
                "case": case,
                "controller": label,
                "J on x": column["objective_x"],
                "J on y": column["objective_y"],
            }
            row |= {f"overshoot {tables.symbol(name)}, %": 100 * column[f"overshoot:{name}"] for name in process.controlled}
            row |= {f"offset {tables.symbol(name)}, %": 100 * column[f"offset:{name}"] for name in process.controlled}
            row |= {f"movement {tables.symbol(name)}": column[f"movement:{name}"] for name in process.manipulated}
            rows.append(row | {"episodes": column.get("episodes")})
    tabulated["control_quality"] = pd.DataFrame(rows)
    leaves = [leaf for params in results.params.values() for leaf in params.leaves]
    tabulated["parameters"] = tables.parameters_table(leaves)
    seconds = [
        {"case": case, "stage": folder, "seconds": stage.record["seconds"]} for (case, _, folder), stage in results.stages.items()
    ]
    tabulated["time"] = pd.DataFrame(seconds).groupby(["case", "stage"], as_index=False)["seconds"].median()
    return tabulated


def provenance(results: Results) -> dict[str, Any]:
    """Where the report comes from: code, versions, seeds, parameters and time."""
    records = [stage.record for stage in results.stages.values()]
    return {
        "scale": results.scale,
        "seeds": sorted({seed for _, seed, _ in results.stages}),
        "revision": code_revision(PROJECT),
        "revisions_of_stages": sorted({record["revision"] for record in records}),
        "versions": versions(),
        "parameters": {str(case): parameters_hash(params) for case, params in results.params.items()},
        "stage_seconds": sum(record["seconds"] for record in records),
        "processor_threads": os.cpu_count(),
    }


def write(folder: Path, results: Results) -> Path:
    """Write report.html, figures/, tables/, comparison.csv, seeds.csv and provenance.json; returns the report's path.

    What an earlier report left in those places is replaced; other files of the folder stay.
    """
    partial = folder / f".partial.{os.getpid()}"
    shutil.rmtree(partial, ignore_errors=True)
    try:
        for name in ("figures", "tables"):
            (partial / name).mkdir(parents=True)
        drawn, tabulated, origin = draw(results), tabulate(results), provenance(results)
        for name, figure in drawn.items():
            figure.savefig(partial / "figures" / f"{name}.svg", metadata={"Date": None})
            figure.savefig(partial / "figures" / f"{name}.png")
        for name, frame in tabulated.items():
            frame.to_csv(partial / "tables" / f"{name}.csv", index=False, float_format="%.10g")
            (partial / "tables" / f"{name}.md").write_text(tables.to_markdown(frame) + "\n", encoding="utf-8")
        tabulated["comparison"].to_csv(partial / "comparison.csv", index=False, float_format="%.10g")
        results.seeds.to_csv(partial / "seeds.csv", index=False, float_format="%.10g")
        (partial / "provenance.json").write_text(json.dumps(origin, indent=1) + "\n", encoding="utf-8")
        if (BENCHMARKS / "scaling.svg").is_file():
            shutil.copy2(BENCHMARKS / "scaling.svg", partial / "figures/benchmarks.svg")
        text = render(results, tabulated, origin)
        (partial / "report.md").write_text(text, encoding="utf-8")
        typeset(text, partial)
        for path in partial.iterdir():
            target = folder / path.name
            if target.is_dir():
                shutil.rmtree(target)
            path.replace(target)
    except OSError as error:
        raise ArtifactError(f"{folder}: the report could not be written: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder / "report.html"


def render(results: Results, tabulated: Mapping[str, pd.DataFrame], origin: Mapping[str, Any]) -> str:
    """The report as Markdown, from its template; every number in its prose comes from the results."""
    environment = Environment(loader=FileSystemLoader(TEMPLATE), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["percent"] = lambda share: f"{100 * share:.1f} %"
    environment.filters["table"] = tables.to_markdown
    environment.filters["rounded_table"] = partial(tables.to_markdown, digits=3)
    environment.filters["results_table"] = partial(tables.to_markdown, decimals=tables.RESULT_DECIMALS)
    medians = {stage: results.medians(stage).to_dict() for stage in results.seeds["stage"].unique()}
    parts = ("summary", "machine")
    benchmarks = {part: (BENCHMARKS / f"{part}.md").read_text(encoding="utf-8") for part in parts if BENCHMARKS.is_dir()}
    gaps = tabulated["gaps"].set_index("case").to_dict("index")
    return environment.get_template("report.md.jinja").render(
        results=results,
        tables=tabulated,
        origin=origin,
        medians=medians,
        gaps=gaps,
        cases=results.params,
        published=results.published,
        benchmarks=benchmarks,
    )


def typeset(text: str, folder: Path) -> None:
    """Markdown to one HTML file that needs no network: figures inside, maths as MathML."""
    pypandoc.convert_text(
        text,
        "html5",
        format="markdown",
        outputfile=str(folder / "report.html"),
        extra_args=[
            "--standalone",
            "--mathml",
            "--embed-resources",
            "--toc",
            "--toc-depth=2",
            f"--resource-path={folder}",
            f"--css={TEMPLATE / 'report.css'}",
        ],
    )
