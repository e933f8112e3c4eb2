"""The report: what the stages wrote set beside the paper, drawn and typeset. It computes no result."""

import io
import itertools
import json
import os
import re
import shutil
from base64 import b64decode, b64encode
from collections.abc import Mapping
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import pandas as pd
import pypandoc
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from helpers.evidence.readings import MAIN
from helpers.report import drawings, figures, limits_report, scorecard, statistics, tables
from helpers.report.collection import ONLINE, Results
from helpers.runs.artifacts import ArtifactError, code_revision
from helpers.runs.identity import digest, versions
from helpers.runs.opening import parameters_hash
from helpers.runs.pictures import smaller
from helpers.runs.scratch import beside, sweep
from helpers.runs.sources import PROJECT
from helpers.settings.paper import OnlineParams

RUNNERS = ("papermill", "snakemake", "pypandoc_binary")  # packages that shape no number
SHOWN_AS_PIXELS = ("figure_3",)  # in README, where a reader without a browser of its own meets it
PALETTE = 64  # colours of a picture inside a drawing, each with its own opacity
LONGEST_TWIN = 100  # rows of a table that is written as Markdown too, for reading
PROVENANCE = "provenance.json"
OWN_ERROR = "as in the parameter files, with each trajectory's own |e| before the first step"  # what notebook 00 calls its main one
TEMPLATE = PROJECT / "reports/template"
BENCHMARKS = PROJECT / "reports/reference/benchmarks"  # of make bench, a run of its own
OF_THE_PAPER = {"control_case_1": 3, "tracking_case_2": 4, "control_case_2": 5, "control_case_3": 6}  # numbers of its figures


def draw(results: Results) -> dict[str, Figure]:
    """All figures of the report by name, each over all seeds."""
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
        chosen = round(results.median(case, "offline", "chosen_epoch"))
        words = "policy taken from here" + (" (median)" if results.n_seeds > 1 else "")
        drawn[f"learning_curves_case_{case}"] = figures.learning_curves(
            results.table(case, offline, "history.csv"),
            marks={chosen: words},
            gap_levels={"the paper's own gap": results.published[case].feature_gap},
        )
        history = results.table(case, ONLINE, "history.csv")
        marks = _rounds(params.case.online, history["epochs"].nunique())
        drawn[f"online_curves_case_{case}"] = figures.learning_curves(history, marks=marks)
    if len(results.budget):
        stages = {tables.CONTROLLERS[name]: name for name in ("expert_paired", "offline", scorecard.MINIMUM_VARIANCE)}
        levels = {}
        for case in results.params:
            levels[case] = {label: results.median(case, stage, "objective_x") for label, stage in stages.items()}
        titles = {case: f"Case Study {tables.ROMAN[case - 1]}" for case in results.params}
        drawn["online_budget"] = figures.budget_figure(results.budget, levels, titles)
    drawn |= limits_report.draw(results)
    return {f"figure_{OF_THE_PAPER[name]}" if name in OF_THE_PAPER else name: figure for name, figure in drawn.items()}


def _rounds(online: OnlineParams, n_epochs: int) -> dict[int, str]:
    """The last epoch before each later round of online learning, and that round's beta, to mark on a curve.

    At smoke scale a run has fewer epochs than the parameters say; its rounds shrink alike.
    """
    ends = [round(n_epochs * end / sum(online.epochs)) for end in itertools.accumulate(online.epochs[:-1])]
    return {end: f"next round, β = {beta:g}" for end, beta in zip(ends, online.beta[1:], strict=True)}


def tabulate(results: Results) -> dict[str, pd.DataFrame]:
    """All tables of the report by name."""
    names, medians = results.feature_names, results.medians
    process = next(iter(results.params.values())).process
    scale = next(iter(results.params.values())).learning.scales[results.scale]
    trajectories = {"expert": scale.expert_evaluation, "policy": scale.evaluation}
    compared = scorecard.comparison(results.published, results.seeds, medians, names, trajectories)
    tabulated = {
        "table_1": tables.table_1({case: params.case for case, params in results.params.items()}, process),
        "gaps": scorecard.gaps(medians, results.published),
        "comparison": compared,
        "verdicts": scorecard.counts(compared),
        "summary": medians,
        "variants": tables.variants_table(medians),
    }
    for case, published in results.published.items():
        tabulated[f"table_{published.table}"] = tables.results_table(compared[compared["case"] == case], names)
    quality = {case: tables.quality_table(medians[medians["case"] == case], process) for case in results.params}
    tabulated["control_quality"] = pd.concat(quality, names=["case"]).reset_index("case").reset_index(drop=True)
    leaves = [leaf for params in results.params.values() for leaf in params.leaves]
    tabulated["parameters"] = tables.parameters_table(leaves)
    seconds = [
        {"case": case, "stage": folder, "seconds": stage.record["seconds"]} for (case, _, folder), stage in results.stages.items()
    ]
    tabulated["time"] = pd.DataFrame(seconds).groupby(["case", "stage"], as_index=False)["seconds"].median()
    if len(results.claims):
        tabulated |= {"claims": results.claims, "claims_seeds": results.claim_values.reset_index()}
    if len(results.trials):
        trials = tables.trials_table(results.trials)
        words = scorecard.against_headline(results.trials)
        tabulated["trials"] = trials.assign(against_improved=trials["trial"].map(words).fillna(tables.NOT_KNOWN))
    if results.inferred is not None:
        for name in ("settings", "hypotheses", "prediction"):
            tabulated[f"inferred_{name}"] = results.inferred.table(f"{name}.csv")
        tabulated["inferred_errors"] = scorecard.held_out(tabulated["inferred_prediction"])
        tabulated["inferred_hypotheses"] = tabulated["inferred_hypotheses"].replace({"reading": {MAIN.name: OWN_ERROR}})
        errors = scorecard.sampling_errors(tabulated["inferred_prediction"], results.published)
        wider = scorecard.comparison(results.published, results.seeds, medians, names, trajectories, errors)
        tabulated["comparison_initial_error"] = scorecard.changed(compared, wider)
    return tabulated | limits_report.tabulate(results)


def provenance(results: Results) -> dict[str, Any]:
    """Where the report comes from: code, versions, seeds, parameters and time; `identity` is that of all its stages."""
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
        "processor_threads": os.cpu_count(),
    }


def write(folder: Path, results: Results, tabulated: Mapping[str, pd.DataFrame] | None = None) -> Path:
    """Write report.html, figures/, tables/, comparison.csv, seeds.csv and provenance.json; returns the report's path.

    What an earlier report left in those places is replaced; other files of the folder stay.

    Args:
        tabulated: what `tabulate` gave for these results, if it was asked before.
    """
    partial = beside(folder / "report")
    try:
        sweep(folder / "report")
        shutil.rmtree(partial, ignore_errors=True)
        for name in ("figures", "tables"):
            (partial / name).mkdir(parents=True)
        drawn, origin = draw(results), provenance(results)
        tabulated = tabulate(results) if tabulated is None else tabulated
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
        if results.inferred is not None:
            shutil.copy2(results.inferred.path("profiles.svg"), partial / "figures/inferred_profiles.svg")
        if (BENCHMARKS / "scaling.svg").is_file():
            shutil.copy2(BENCHMARKS / "scaling.svg", partial / "figures/benchmarks.svg")
        text = render(results, tabulated, origin)
        (partial / "report.md").write_text(text, encoding="utf-8")
        typeset(text, partial)
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


def shortened(drawing: str) -> str:
    """An SVG drawing in half the bytes, without what no screen shows.

    Coordinates have two decimals, the font is named once, nothing is indented or turned by nought, and pictures of lines have a
    palette.
    """
    drawing = re.sub(r' (?:[dxy]="|transform="[rt])[^"]*"', lambda found: re.sub(r"(\.\d\d)\d+", r"\1", found[0]), drawing)
    drawing = re.sub(r' transform="rotate\(-?0 [^"]*"|(?<=\n) +', "", drawing)
    if fonts := re.search(r" font-family: ([^;\"]*);", drawing):
        drawing = drawing.replace(fonts[0], "").replace("<svg ", f'<svg font-family="{fonts[1]}" ', 1)
    return re.sub(r'(?<=;base64,)[^"]+', lambda found: b64encode(_with_palette(b64decode(found[0]))).decode(), drawing)


def _with_palette(png: bytes) -> bytes:
    """The PNG of see-through lines with a palette; one without transparency is a map whose every colour is a value, and stays."""
    picture, found = Image.open(io.BytesIO(png)).convert("RGBA"), io.BytesIO()
    if picture.getchannel("A").getextrema() == (255, 255):
        return png
    picture.quantize(PALETTE).save(found, format="PNG", optimize=True)
    return min(png, found.getvalue(), key=len)


def render(results: Results, tabulated: Mapping[str, pd.DataFrame], origin: Mapping[str, Any]) -> str:
    """The report as Markdown, from its template; every number in its prose comes from the results."""
    environment = Environment(loader=FileSystemLoader(TEMPLATE), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["percent"] = lambda share: f"{100 * share:.1f} %"
    environment.filters["numeral"] = lambda case: tables.ROMAN[case - 1]
    environment.filters["table"] = tables.to_markdown
    environment.filters["claims_table"] = tables.claims_table
    environment.filters["stacked"] = stacked
    numbers = results.medians.set_index(scorecard.KEYS)[["median", "ci_low", "ci_high"]]

    def number(case: int, stage: str, metric: str, factor: float = 1, **style: Any) -> str:
        """A median with its interval."""
        return tables.spread(factor * numbers.reindex([(case, stage, metric)]).iloc[0], **style)

    parts = {part: BENCHMARKS / f"{part}.md" for part in ("summary", "machine")}
    benchmarks = {part: path.read_text(encoding="utf-8") for part, path in parts.items() if all(map(Path.is_file, parts.values()))}
    return environment.get_template("report.md.jinja").render(
        results=results,
        tables=tabulated,
        compared=tabulated["comparison"],
        origin=origin,
        number=number,
        gaps=tabulated["gaps"].set_index("case").to_dict("index"),
        cases=results.params,
        published=results.published,
        benchmarks=benchmarks,
        claims=scorecard.verdicts_of_claims(results.claims),
        limits=limits_report.find(results),
        listing=partial(scorecard.listing, tabulated["comparison"]),
        better=_better(results),
        nearer=scorecard.nearer_to_expert(tabulated["comparison"]),
        outside=scorecard.outside(tabulated["comparison"]),
        settings=partial(_settings, tabulated["parameters"]),
        level=statistics.LEVEL,
        fewest=statistics.FEWEST,
        trajectories=scorecard.PUBLISHED_TRAJECTORIES,
        widest=scorecard.WIDEST,
    )


def stacked(table: str) -> str:
    """A Markdown table in which an interval is not broken, so that in narrow columns it stands below its median."""
    return re.sub(r"\[(\S+), (\S+)\]", "[\\1,\N{NO-BREAK SPACE}\\2]", table)


def _settings(parameters: pd.DataFrame, status: str, part: int) -> str:
    """The settings of a status by file, each by one part of its key; those of the cases together."""
    found = parameters[parameters["status"] == status]
    files = found["file"].str.removesuffix(".yaml").str.replace(r"case_\d+", "cases", regex=True)
    keys = found["key"].str.split(".").str[part].str.replace("_", " ")
    return "; ".join(f"*{file}* ({', '.join(of_file.unique())})" for file, of_file in keys.groupby(files))


def _better(results: Results) -> dict[str, list[int]]:
    """The cases in which ours is better beyond its interval: the gap below the paper's, online J above the PID's.

    worse_as_printed: those in which the gap of the algorithms as printed lies above the paper's.
    """
    numbers = results.medians.set_index(scorecard.KEYS)
    low, high = (numbers[end].fillna(numbers["median"]) for end in ("ci_low", "ci_high"))
    papers = {case: record.feature_gap for case, record in results.published.items()}
    gap = [case for case in papers if high[case, "offline", "feature_gap"] < papers[case]]
    worse = [case for case in papers if low[case, "offline_printed", "feature_gap"] > papers[case]]
    online = [case for case in results.params if low[case, "online", "objective_x"] > high[case, "expert_paired", "objective_x"]]
    return {"gap": gap, "worse_as_printed": worse, "online": online}


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
            "--toc-depth=1",
            "--columns=10000",  # otherwise a long line in the source of a table fixes the widths of its columns
            f"--resource-path={folder}",
            f"--css={TEMPLATE / 'report.css'}",
        ],
    )
