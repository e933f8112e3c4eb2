"""The report: what the stages wrote set beside the paper, drawn and typeset. It computes no result."""

import io
import itertools
import json
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from helpers.evidence.readings import MAIN
from helpers.learning.features import feature_names
from helpers.report import drawings, figures, limits_findings, limits_report, scorecard, search_report, tables, verdict_figures
from helpers.report.collection import ONLINE, Results, offline_folder
from helpers.report.limits_figures import GRIDS, LABELS, RIVALS
from helpers.report.statistics import FEWEST, LEVEL
from helpers.report.typesetting import render, shortened, to_html, to_pdf
from helpers.runs.artifacts import ArtifactError, code_revision
from helpers.runs.identity import digest, versions
from helpers.runs.opening import parameters_hash
from helpers.runs.pictures import smaller
from helpers.runs.scratch import beside, sweep
from helpers.runs.sources import PROJECT
from helpers.settings.paper import Params

RUNNERS = ("papermill", "snakemake", "pypandoc_binary", "typst")  # packages that shape no number
SHOWN_AS_PIXELS = ("figure_3", "comparison")  # in README and report.md, where a reader without a browser of its own meets them
LONGEST_TWIN = 100  # rows of a table that is written as Markdown too, for reading
PROVENANCE = "provenance.json"
OWN_ERROR = "as in the parameter files, with each trajectory's own |e| before the first step"  # what notebook 00 calls its main one
BENCHMARKS = PROJECT / "reports/reference/benchmarks"  # of make bench, a run of its own
OF_THE_PAPER = {"control_case_1": 3, "tracking_case_2": 4, "control_case_2": 5, "control_case_3": 6}  # numbers of its figures
LEVELS = ("expert_paired", "offline", scorecard.MINIMUM_VARIANCE)  # what online learning is measured by


def draw(results: Results, compared: pd.DataFrame) -> dict[str, Figure]:
    """All figures of the report by name, each over all seeds; `compared` is the comparison with the paper."""
    first = next(iter(results.params.values()))
    policy, process = first.learning.policy, first.process
    outputs, inputs = process.controlled, process.manipulated
    words = (*process.controlled_description, *process.manipulated_description)
    descriptions = dict(zip((*outputs, *inputs), words, strict=True))
    drawn = {
        "comparison": verdict_figures.comparison_figure(compared),
        "figure_1": drawings.mdp_figure(),
        "figure_2": drawings.framework_figure(),
        "network": drawings.network_figure(policy.hidden_cells, len(outputs), len(inputs), policy.leaky_slope),
    }
    levels = {}
    for case, params in results.params.items():
        levels[case] = {tables.CONTROLLERS[stage]: results.median(case, stage, "objective_x") for stage in LEVELS}
        target, offline = params.case.set_point, offline_folder(params)
        response = results.table(case, ONLINE, "response.csv")
        drawn[f"control_case_{case}"] = figures.control_figure(response, outputs, inputs, target, descriptions)
        if params is first:
            look: dict[str, Any] = {"zoom_from": None, "size": (verdict_figures.NARROW, 3.9), "agent_label": "online policy"}
            keys = ["controller", "kind", "variable", "time_index"]
            middle = response.groupby(keys, sort=False, as_index=False)[["mean", "std"]].median()
            drawn["page_one"] = figures.control_figure(middle, outputs, inputs, target, **look)
        response = results.table(case, offline, "response.csv")
        drawn[f"tracking_case_{case}"] = figures.tracking_figure(response, outputs, target, descriptions)
        history = results.table(case, offline, "history.csv")
        chosen = round(results.median(case, "offline", "chosen_epoch"))
        marks = {chosen: "policy taken from here" + (" (median)" if results.n_seeds > 1 else "")}
        papers, unweighted = {"the paper's own gap": results.published[case].feature_gap}, history.filter(regex="^(?!alpha:)")
        drawn[f"learning_curves_case_{case}"] = figures.learning_curves(unweighted, marks=marks, gap_levels=papers)
        drawn[f"weights_{case}"] = verdict_figures.weights_figure(history, compared[compared["case"] == case])
        history, online = results.table(case, ONLINE, "history.csv"), params.case.online
        n_epochs = history["epochs"].nunique()  # at smoke scale fewer than the parameters say; the rounds shrink alike
        ends = [round(n_epochs * end / sum(online.epochs)) for end in itertools.accumulate(online.epochs[:-1])]
        marks = {end: f"next round, β = {beta:g}" for end, beta in zip(ends, online.beta[1:], strict=True)}
        drawn[f"online_curves_case_{case}"] = figures.learning_curves(history, marks=marks, return_levels=levels[case])
    if len(results.budget):
        drawn["online_budget"] = figures.budget_figure(results.budget, levels)
    if len(results.claims):
        drawn["claims"] = verdict_figures.claims_figure(scorecard.claims_by_case(results.claims))
    if results.search is not None:
        weights = results.seeds[(results.seeds["stage"] == "offline") & results.seeds["metric"].str.startswith("alpha:")]
        weights = weights.pivot_table(index=["case", "seed"], columns="metric", values="value").reset_index()
        drawn |= search_report.draw(results.search, results.published, weights)
    if results.inferred is not None:
        found = (results.inferred.table(f"{name}.csv") for name in ("profiles", "settings"))
        drawn["inferred_profiles"] = verdict_figures.profiles_figure(*found)
    drawn |= limits_report.draw(results)
    return {f"figure_{OF_THE_PAPER[name]}" if name in OF_THE_PAPER else name: figure for name, figure in drawn.items()}


def tabulate(results: Results) -> dict[str, pd.DataFrame]:
    """All tables of the report by name."""
    medians, first = results.medians, next(iter(results.params.values()))
    process, scale, names = first.process, first.learning.scales[results.scale], feature_names(first.process.controlled)
    trajectories = {"expert": scale.expert_evaluation, "policy": scale.evaluation}
    compared = scorecard.comparison(results.published, results.seeds, medians, names, trajectories)
    tabulated = {
        "table_1": tables.table_1({case: params.case for case, params in results.params.items()}, process),
        "gaps": scorecard.gaps(medians, results.published),
        "comparison": compared,
        "verdicts": scorecard.counts(compared),
        "summary": medians,
        "variants": tables.variants_table(medians),
        "time": _seconds(results),
    }
    for case, published in results.published.items():
        tabulated[f"table_{published.table}"] = tables.results_table(compared[compared["case"] == case], names)
    quality = {case: tables.quality_table(medians[medians["case"] == case], process) for case in results.params}
    tabulated["control_quality"] = pd.concat(quality, names=["case"]).reset_index("case").reset_index(drop=True)
    leaves = [leaf for params in results.params.values() for leaf in params.leaves]
    tabulated["parameters"] = tables.parameters_table(leaves)
    if len(results.claims):
        tabulated |= {"claims": results.claims, "claims_seeds": results.claim_values.reset_index()}
        tabulated["claims_by_case"] = scorecard.claims_by_case(results.claims)
    if len(results.trials):
        trials = tables.trials_table(results.trials)
        words = scorecard.against_headline(results.trials)
        tabulated["trials"] = trials.assign(against_improved=trials["trial"].map(words).fillna(tables.NOT_KNOWN))
    if results.search is not None:
        tabulated["search"] = search_report.tabulate(results.search, results.published)
    if results.inferred is not None:
        for name in ("settings", "hypotheses", "prediction"):
            tabulated[f"inferred_{name}"] = results.inferred.table(f"{name}.csv")
        tabulated["inferred_settings"] = tables.inferred_settings(tabulated["inferred_settings"])
        tabulated["inferred_errors"] = scorecard.held_out(tabulated["inferred_prediction"])
        tabulated["inferred_hypotheses"] = tabulated["inferred_hypotheses"].replace({"reading": {MAIN.name: OWN_ERROR}})
        errors = scorecard.sampling_errors(tabulated["inferred_prediction"], results.published)
        wider = scorecard.comparison(results.published, results.seeds, medians, names, trajectories, errors)
        tabulated["comparison_initial_error"] = scorecard.changed(compared, wider)
    return tabulated | limits_report.without_the_plant(results) | limits_report.tabulate(results)


def provenance(results: Results) -> dict[str, Any]:
    """Where the report comes from and what it cost: code, versions, seeds, parameters, time; `identity` is that of all its stages.

    Every cost that the project names is taken from here: `stage_seconds` of all stages together, and `seconds_by_stage`, medians
    over the seeds of the paper's own stages.
    """
    records = [stage.record for stage in (*results.stages.values(), *results.beyond)]
    return {
        "scale": results.scale,
        "seeds": sorted({seed for _, seed, _ in results.stages}),
        "revision": code_revision(PROJECT),
        "revisions_of_stages": sorted({record["revision"] for record in records}),
        "identity": digest(sorted(record.get("identity", "") for record in records)),
        "inputs": dict(results.made_from),
        "missing_seeds": list(results.missing),
        "versions": versions() | {name: metadata.version(name) for name in RUNNERS},
        "parameters": {str(case): parameters_hash(params) for case, params in results.params.items()},
        "stage_seconds": sum(record["seconds"] for record in records),
        "seconds_by_stage": _seconds(results).to_dict("records"),
        "processor_threads": os.cpu_count(),
    }


def _seconds(results: Results) -> pd.DataFrame:
    """Columns case, stage, seconds: medians over the seeds."""
    rows = [(case, folder, stage.record["seconds"]) for (case, _, folder), stage in results.stages.items()]
    return pd.DataFrame(rows, columns=["case", "stage", "seconds"]).groupby(["case", "stage"], as_index=False).median()


def write(folder: Path, results: Results, tabulated: Mapping[str, pd.DataFrame] | None = None) -> Path:
    """Write report.html, .pdf and .md, figures/, tables/, comparison.csv, seeds.csv and provenance.json; returns the first's path.

    What an earlier report left in those places is replaced; other files of the folder stay. `tabulated` is what `tabulate` gave for
    these results, if it was asked before.
    """
    partial = beside(folder / "report")
    try:
        sweep(folder / "report")
        shutil.rmtree(partial, ignore_errors=True)
        for name in ("figures", "tables"):
            (partial / name).mkdir(parents=True)
        tabulated = tabulate(results) if tabulated is None else tabulated
        drawn, origin = draw(results, tabulated["comparison"]), provenance(results)
        for name, figure in drawn.items():
            figures.lay_out(figure)
            drawing = io.StringIO()
            figure.savefig(drawing, format="svg", metadata={"Date": None})
            (partial / "figures" / f"{name}.svg").write_text(shortened(drawing.getvalue()), encoding="utf-8")
            if name in SHOWN_AS_PIXELS:
                pixels = io.BytesIO()
                figure.savefig(pixels, format="png")
                (partial / "figures" / f"{name}.png").write_bytes(smaller(pixels.getvalue()))
        for name, frame in tabulated.items():
            frame.to_csv(partial / "tables" / f"{name}.csv", index=False, float_format="%.10g")
            if len(frame) <= LONGEST_TWIN:
                (partial / "tables" / f"{name}.md").write_text(tables.to_markdown(frame) + "\n", encoding="utf-8")
        tabulated["comparison"].to_csv(partial / "comparison.csv", index=False, float_format="%.10g")
        results.seeds.to_csv(partial / "seeds.csv", index=False, float_format="%.10g")
        (partial / PROVENANCE).write_text(json.dumps(origin, indent=1) + "\n", encoding="utf-8")
        if (BENCHMARKS / "scaling.svg").is_file():
            shutil.copy2(BENCHMARKS / "scaling.svg", partial / "figures/benchmarks.svg")
        values = said(results, tabulated, origin)
        with ThreadPoolExecutor() as pool:  # both wait for other programs
            html = pool.submit(to_html, render("report.md.jinja", folder, appendix=None, **values), partial)
            pdf = pool.submit(to_pdf, render("report.md.jinja", folder, appendix=[], **values), partial)
        html.result()
        pdf.result()
        (partial / "report.md").write_text(render("summary.md.jinja", folder, appendix=None, **values), encoding="utf-8")
        for path in sorted(partial.iterdir(), key=lambda path: path.name == PROVENANCE):  # last: it vouches for the others
            target = folder / path.name
            if target.is_dir():
                shutil.rmtree(target)
            path.replace(target)
    except OSError as error:
        raise ArtifactError(f"{folder}: the report could not be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder / "report.html"


def said(results: Results, tabulated: Mapping[str, pd.DataFrame], origin: Mapping[str, Any]) -> dict[str, Any]:
    """What the templates say, by name; every number in their prose comes from the results."""
    numbers = results.numbers[["median", "ci_low", "ci_high"]]
    compared = tabulated["comparison"]

    def number(case: int, stage: str, metric: str, factor: float = 1, **style: Any) -> str:
        """A median with its interval."""
        return tables.spread(factor * numbers.reindex([(case, stage, metric)]).iloc[0], **style)

    def plain(case: int, stage: str, metric: str, factor: float, decimals: int) -> str:
        """A median alone."""
        found = factor * results.median(case, stage, metric)
        return tables.NOT_KNOWN if np.isnan(found) else f"{found + 0.0:,.{decimals}f}"

    parts = {part: BENCHMARKS / f"{part}.md" for part in ("summary", "machine")}
    benchmarks = {part: path.read_text(encoding="utf-8") for part, path in parts.items() if all(map(Path.is_file, parts.values()))}
    weights = compared[compared["row"] == "alpha"]
    alike = np.sign(weights["published"]) == np.sign(weights["reproduced"])
    return {
        "results": results,
        "tables": tabulated,
        "time": tables.time_table(tabulated["time"]),
        "origin": origin,
        "number": number,
        "plain": plain,
        "gaps": tabulated["gaps"].set_index("case").to_dict("index"),
        "cases": results.params,
        "of_the_paper": {case: OF_THE_PAPER[f"control_case_{case}"] for case in results.params},
        "benchmarks": benchmarks,
        "claims": tabulated.get("claims_by_case"),
        "changed_claims": results.claims.loc[results.claims["changed"].fillna("") != "", "id"].nunique(),
        "search": tabulated["search"].set_index("case").to_dict("index") if "search" in tabulated else {},
        "frozen": _frozen(results),
        "limits": limits_findings.find(results),
        "rivals": {name: LABELS[name] for name in RIVALS},
        "grids": {group: title for group, (title, _, _) in GRIDS.items()},
        "heat_maps": [name.removeprefix("limits_") for name in limits_report.heat_map_names(results)],
        "verdicts": compared["verdict"].value_counts().reindex(scorecard.VERDICTS, fill_value=0).to_dict(),
        "weights": {"total": len(weights), "open": int((weights["verdict"] == "cannot tell").sum()), "alike": int(alike.sum())},
        "offset": {stage: abs(results.median(3, stage, "offset:C_A")) for stage in tables.CONTROLLERS},
        "holding": {case: _holding(params) for case, params in results.params.items()},
        "better": _better(results),
        "nearer": scorecard.nearer_to_expert(compared),
        "outside": scorecard.outside(compared),
        "settings": partial(_settings, tabulated["parameters"]),
        "level": LEVEL,
        "fewest": FEWEST,
        "trajectories": scorecard.PUBLISHED_TRAJECTORIES,
        "widest": scorecard.WIDEST,
    }


def _frozen(results: Results) -> dict[str, list[float]] | None:
    """The gaps, in per cent and by case, of policies that learned from scratch under weights held fixed, ours and the printed."""
    found = results.claims[results.claims["id"] == "weights_explain_the_expert"].sort_values("case")
    whose = found["quantity"].str.contains("our weights").map({True: "ours", False: "printed"})
    gaps = (100 * found["median"]).groupby(whose).agg(list).to_dict()
    return gaps if len(found) and found["median"].notna().all() else None


def _holding(params: Params) -> float:
    """The greatest share of its bound at which an input must stand to hold the set point: A x + B u = 0 (Eq. 4.1.3b)."""
    process = params.process
    inputs = -np.linalg.solve(np.array(process.drift_input), np.array(process.drift_state) @ np.array(params.case.set_point))
    return float(np.max(inputs / np.where(inputs > 0, process.input_high, process.input_low)))


def _settings(parameters: pd.DataFrame, status: str, part: int) -> str:
    """The settings of a status by file, each by one part of its key; those of the cases together."""
    found = parameters[parameters["status"] == status]
    files = found["file"].str.removesuffix(".yaml").str.replace(r"case_\d+", "cases", regex=True)
    keys = found["key"].str.split(".").str[part].str.replace("_", " ")
    return "; ".join(f"*{file}* ({', '.join(of_file.unique())})" for file, of_file in keys.groupby(files))


def _better(results: Results) -> dict[str, list[int]]:
    """The cases in which ours is better beyond its interval: the gap below the paper's, online J above the PID's.

    worse: those in which the gap lies above the paper's; printed and worse_as_printed: the same of the algorithms as printed.
    """
    low, high = (results.numbers[end].fillna(results.numbers["median"]) for end in ("ci_low", "ci_high"))
    papers = {case: record.feature_gap for case, record in results.published.items()}
    return {
        "gap": [case for case in papers if high[case, "offline", "feature_gap"] < papers[case]],
        "worse": [case for case in papers if low[case, "offline", "feature_gap"] > papers[case]],
        "printed": [case for case in papers if high[case, "offline_printed", "feature_gap"] < papers[case]],
        "worse_as_printed": [case for case in papers if low[case, "offline_printed", "feature_gap"] > papers[case]],
        "online": [case for case in papers if low[case, "online", "objective_x"] > high[case, "expert_paired", "objective_x"]],
    }
