# The order of the stages for each case and seed. Every stage is one notebook, executed by helpers.run.
# Settings (snakemake --config name=value): seeds (how many), scale (smoke or paper), variants, results, reports.
import shlex
import sys
from pathlib import Path

ROOT = Path(workflow.basedir)
SCALE = config.get("scale", "paper")
SEEDS = range(int(config.get("seeds", 1)))
RESULTS = config.get("results", "results")
REPORTS = config.get("reports", "reports/latest")
VARIANTS = ["improved", "printed"]
CASES = [1, 2, 3]
CASE = f"{RESULTS}/{SCALE}/seed_{{seed}}/case_{{case}}"
LOG = f"{RESULTS}/{SCALE}/seed_{{seed}}/case_{{case}}/notebooks"
RUN = f"{shlex.quote(sys.executable)} -m helpers.run"
FOLDER = shlex.quote(str(Path(RESULTS).resolve()))
ROOTS = f"-p scale {SCALE} -p input_root {FOLDER} -p output_root {FOLDER}"

# What a stage's result depends on beside earlier stages: its notebook, its parameter files and the modules behind it.
UNRELATED = ("tables", "report", "run", "publish", "refresh")
MODULES = [str(path) for path in sorted((ROOT / "src/helpers").glob("*.py")) if path.stem not in UNRELATED]
PARAMS = [str(ROOT / "params" / f"{name}.yaml") for name in ("process", "demonstrators", "features", "learning")]


def sources(notebook):
    def inputs(wildcards):
        case = getattr(wildcards, "case", 3)
        return [str(ROOT / "notebooks" / f"{notebook}.ipynb"), str(ROOT / f"params/case_{case}.yaml"), *PARAMS, *MODULES]

    return inputs


wildcard_constraints:
    seed=r"\d+",
    case=r"\d+",
    variant="|".join(VARIANTS),


localrules:
    all,


rule all:
    input:
        f"{REPORTS}/report.html",


rule demonstrations:
    input:
        sources("01_demonstrations"),
    output:
        f"{CASE}/demonstrations/record.json",
    log:
        f"{LOG}/01_demonstrations.ipynb",
    shell:
        f"{RUN} 01_demonstrations {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} {ROOTS}"


rule offline:
    input:
        sources("02_offline_irl"),
        demonstrations=f"{CASE}/demonstrations/record.json",
    output:
        f"{CASE}/offline_{{variant}}/record.json",
    log:
        f"{LOG}/02_offline_irl_{{variant}}.ipynb",
    shell:
        f"{RUN} 02_offline_irl {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} -p variant {{wildcards.variant}} {ROOTS}"


rule online:
    input:
        sources("03_online_improvement"),
        demonstrations=f"{CASE}/demonstrations/record.json",
        offline=f"{CASE}/offline_{{variant}}/record.json",
    output:
        f"{CASE}/online_{{variant}}/record.json",
    wildcard_constraints:
        case="[12]",
    log:
        f"{LOG}/03_online_improvement_{{variant}}.ipynb",
    shell:
        f"{RUN} 03_online_improvement {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} -p variant {{wildcards.variant}} {ROOTS}"


rule transfer:
    input:
        sources("04_knowledge_transfer"),
        demonstrations=f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/demonstrations/record.json",
        source=f"{RESULTS}/{SCALE}/seed_{{seed}}/case_1/offline_{{variant}}/record.json",
    output:
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/transfer_{{variant}}/record.json",
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/online_{{variant}}/record.json",
    log:
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/notebooks/04_knowledge_transfer_{{variant}}.ipynb",
    shell:
        f"{RUN} 04_knowledge_transfer {{log:q}} -p case 3 -p seed {{wildcards.seed}} -p variant {{wildcards.variant}} {ROOTS}"


def finished(wildcards):
    """Every result that the report reads, for every seed."""
    stages = []
    for seed in SEEDS:
        folder = f"{RESULTS}/{SCALE}/seed_{seed}"
        stages += [f"{folder}/case_{case}/demonstrations/record.json" for case in CASES]
        stages += [f"{folder}/case_{case}/offline_{variant}/record.json" for case in (1, 2) for variant in VARIANTS]
        stages += [f"{folder}/case_3/offline_improved/record.json"]
        stages += [f"{folder}/case_3/transfer_{variant}/record.json" for variant in VARIANTS]
        stages += [f"{folder}/case_{case}/online_improved/record.json" for case in CASES]
    return stages


rule report:
    input:
        sources("05_report"),
        published=str(ROOT / "params/published.yaml"),
        modules=[str(ROOT / f"src/helpers/{name}.py") for name in ("tables", "report")],
        template=[str(path) for path in sorted((ROOT / "reports/template").iterdir())],
        stages=finished,
    output:
        f"{REPORTS}/report.html",
        f"{REPORTS}/provenance.json",
    log:
        f"{REPORTS}/notebooks/05_report.ipynb",
    params:
        seeds=len(SEEDS),
    shell:
        f"{RUN} 05_report {{log:q}} -p seeds {{params.seeds}} -p scale {SCALE} -p input_root {FOLDER}"
        f" -p output_root {shlex.quote(str(Path(REPORTS).resolve()))}"
