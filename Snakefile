# The order of the stages for each case and seed. Every stage is one notebook, executed by helpers.run.
# Settings (snakemake --config name=value): seeds (how many), scale (smoke or paper), results, reports (folders), and
# evidence=1 for the runs beyond the paper's own: the claims, the trials of offline learning and the inferred settings.
import shlex
import sys
from pathlib import Path

from helpers.params import load_trials
from helpers.sources import PROJECT, modules_behind, notebook_path

ROOT = Path(workflow.basedir)
SCALE = config.get("scale", "paper")
SEEDS = range(int(config.get("seeds", 1)))
EVIDENCE = bool(int(config.get("evidence", 0)))
RESULTS = config.get("results", "results")
REPORTS = config.get("reports", "reports/latest")
VARIANTS = ["improved", "printed"]
TRIALS = sorted(load_trials(ROOT / "params"))
TRIAL_SEEDS = SEEDS[:5]
CASES = [1, 2, 3]
CASE = f"{RESULTS}/{SCALE}/seed_{{seed}}/case_{{case}}"
LOG = f"{RESULTS}/{SCALE}/seed_{{seed}}/case_{{case}}/notebooks"
RUN = f"{shlex.quote(sys.executable)} -m helpers.run"
FOLDER = shlex.quote(str(Path(RESULTS).resolve()))
ROOTS = f"-p scale {SCALE} -p input_root {FOLDER} -p output_root {FOLDER}"

PARAMS = [str(ROOT / "params" / f"{name}.yaml") for name in ("process", "demonstrators", "features", "learning")]


def sources(notebook, *params):
    """What a result depends on beside earlier stages: its notebook, its parameter files and the modules behind it."""
    code = [str(ROOT / path.relative_to(PROJECT)) for path in (notebook_path(notebook), *modules_behind(notebook))]

    def inputs(wildcards):
        case, variant = getattr(wildcards, "case", 3), getattr(wildcards, "variant", "")
        named = [*params, f"case_{case}", *(["trials"] if variant in TRIALS else [])]
        return [*code, *PARAMS, *(str(ROOT / f"params/{name}.yaml") for name in named)]

    return inputs


wildcard_constraints:
    seed=r"\d+",
    case=r"\d+",
    variant="|".join([*VARIANTS, *TRIALS]),


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


rule inferred_settings:
    input:
        sources("00_inferred_settings", "identification", "published", *(f"case_{case}" for case in CASES)),
    output:
        f"{RESULTS}/{SCALE}/seed_0/inferred_settings/record.json",
    log:
        f"{RESULTS}/{SCALE}/seed_0/notebooks/00_inferred_settings.ipynb",
    shell:
        f"{RUN} 00_inferred_settings {{log:q}} -p seed 0 {ROOTS}"


rule claims:
    input:
        sources("08_claims", "experiments"),
        demonstrations=f"{CASE}/demonstrations/record.json",
        offline=f"{CASE}/offline_improved/record.json",
        transfer=lambda wildcards: [f"{CASE}/transfer_improved/record.json"] if wildcards.case == "3" else [],
        online=f"{CASE}/online_improved/record.json",
    output:
        f"{CASE}/experiments/record.json",
        f"{CASE}/online_budget/record.json",
    log:
        f"{LOG}/08_claims.ipynb",
    priority: -1
    shell:
        f"{RUN} 08_claims {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} {ROOTS}"


rule limits:
    input:
        sources("06_limits_and_alternatives", "experiments", "limits"),
        demonstrations=f"{CASE}/demonstrations/record.json",
        offline=f"{CASE}/offline_improved/record.json",
        transfer=lambda wildcards: [f"{CASE}/transfer_improved/record.json"] if wildcards.case == "3" else [],
        online=f"{CASE}/online_improved/record.json",
    output:
        [f"{CASE}/limits_{part}/record.json" for part in ("attainable", "budget", "quality", "robustness", "safety")],
    log:
        f"{LOG}/06_limits_and_alternatives.ipynb",
    priority: -2
    shell:
        f"{RUN} 06_limits_and_alternatives {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} {ROOTS}"


def evidence():
    """The runs beyond the paper's own."""
    folder = f"{RESULTS}/{SCALE}"
    stages = [f"{folder}/seed_0/inferred_settings/record.json"]
    stages += [f"{folder}/seed_{seed}/case_{case}/experiments/record.json" for seed in SEEDS for case in CASES]
    stages += [f"{folder}/seed_{seed}/case_{case}/limits_safety/record.json" for seed in SEEDS for case in CASES]
    for seed in TRIAL_SEEDS:
        for trial in TRIALS:
            stages += [f"{folder}/seed_{seed}/case_{case}/offline_{trial}/record.json" for case in (1, 2)]
            stages += [f"{folder}/seed_{seed}/case_3/transfer_{trial}/record.json"]
    return stages


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
    return stages + (evidence() if EVIDENCE else [])


rule report:
    input:
        sources("05_report", "published", "claims", "trials"),
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
