# The order of the stages for each case and seed. Every stage is one notebook, executed by helpers.runs.run.
# Settings (snakemake --config name=value): seeds (how many), scale (smoke or paper), results, reports (folders),
# evidence=1 for the runs beyond the paper's own (claims, limits, trials of offline learning, inferred settings), and
# missing=1 for a report of the seeds whose stages are all there.
#
# A result says in its record.json what it was made from. Where that is otherwise now, the file CHANGED is among the inputs of
# its rule, and newer than the result; so what is run again does not depend on the times of files that git or an editor touched.
import json
import shlex
import sys
import time
from collections import Counter
from functools import cache
from pathlib import Path

from helpers.runs.identity import changes, inputs
from helpers.settings.paper import load_trials

ROOT = Path(workflow.basedir)
SCALE = config.get("scale", "paper")
SEEDS = range(int(config.get("seeds", 1)))
EVIDENCE = bool(int(config.get("evidence", 0)))
MISSING = bool(int(config.get("missing", 0)))
RESULTS = config.get("results", "results")
REPORTS = config.get("reports", "reports/latest")
HEADLINE = "improved"
VARIANTS = [HEADLINE, "printed"]
TRIALS = sorted(load_trials(ROOT / "params"))
CASES = [1, 2, 3]
# Of make bench, which may not have been run: what the report shows of it.
BENCHMARKS = [ROOT / "reports/reference/benchmarks" / name for name in ("summary.md", "machine.md", "scaling.svg")]
# Ten trials of offline learning for every seed would be dear: five seeds must do there.
FEW = SEEDS[:5]
CASE = f"{RESULTS}/{SCALE}/seed_{{seed}}/case_{{case}}"
LOG = f"{RESULTS}/{SCALE}/seed_{{seed}}/case_{{case}}/notebooks"
RUN = f"{shlex.quote(sys.executable)} -m helpers run"
FOLDER = shlex.quote(str(Path(RESULTS).resolve()))
ROOTS = f"-p scale {SCALE} -p input_root {FOLDER} -p output_root {FOLDER}"

CHANGED = f"{RESULTS}/{SCALE}/.changed"
AGAIN = {}  # the results to be made again, and what they were made from that has changed
if Path(CHANGED).parent.is_dir():
    Path(CHANGED).touch()  # before Snakemake looks into the folder, which it does only once


@cache
def present(notebook, case, variant):
    """What a result would be made from now."""
    return inputs(notebook, ROOT / "params", SCALE, case, variant, ROOT)


def made_from(notebook, record):
    """An input function: the file CHANGED where the result with this record was made from something else than there is now."""

    def changed(wildcards):
        path = Path(record.format(**dict(wildcards.items())))
        case, variant = getattr(wildcards, "case", None), getattr(wildcards, "variant", "improved")
        case = int(case) if case else 3 if "/case_3/" in record else None
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return []
        except ValueError:
            before = {}  # damaged: made again
        if found := changes(before, present(notebook, case, variant)):
            if not AGAIN:
                Path(CHANGED).parent.mkdir(parents=True, exist_ok=True)  # the results may have been removed
                Path(CHANGED).write_text(f"{time.time_ns()}\n", encoding="utf-8")
            AGAIN[str(path)] = (notebook, ", ".join(found[:3]) + (f" and {len(found) - 3} more" if len(found) > 3 else ""))
        return [CHANGED] if found else []

    return changed


def failures():
    """What every stage that failed said, by the place of its executed copy."""
    folders = [Path(RESULTS) / SCALE / f"seed_{seed}" for seed in SEEDS]
    paths = [path for folder in folders for path in sorted(folder.glob("**/notebooks/*.failed"))]
    return {str(path): path.read_text(encoding="utf-8").strip() for path in [*paths, *Path(REPORTS).glob("notebooks/*.failed")]}


onstart:
    for (notebook, why), number in Counter(AGAIN.values()).items():
        print(f"again: {notebook}, {number} result(s); changed: {why}", file=sys.stderr)


onerror:
    found = failures()
    what = f"{len(found)} notebook(s) failed" if found else "No notebook failed, what went wrong stands above"
    print(f"\n{what}; what is finished is kept and not run again.", file=sys.stderr)
    for sentence in found.values():
        print(f"  {sentence}", file=sys.stderr)
    if found:
        print("A report of the seeds that are whole: the same command with missing=1 (make reports MISSING=1).", file=sys.stderr)


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
        made_from("01_demonstrations", f"{CASE}/demonstrations/record.json"),
    output:
        f"{CASE}/demonstrations/record.json",
    log:
        f"{LOG}/01_demonstrations.ipynb",
    shell:
        f"{RUN} 01_demonstrations {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} {ROOTS}"


rule offline:
    input:
        made_from("02_offline_irl", f"{CASE}/offline_{{variant}}/record.json"),
        demonstrations=f"{CASE}/demonstrations/record.json",
    output:
        f"{CASE}/offline_{{variant}}/record.json",
    log:
        f"{LOG}/02_offline_irl_{{variant}}.ipynb",
    shell:
        f"{RUN} 02_offline_irl {{log:q}} -p case {{wildcards.case}} -p seed {{wildcards.seed}} -p variant {{wildcards.variant}} {ROOTS}"


rule online:
    input:
        made_from("03_online_improvement", f"{CASE}/online_{{variant}}/record.json"),
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
        made_from("04_knowledge_transfer", f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/transfer_{{variant}}/record.json"),
        demonstrations=f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/demonstrations/record.json",
        source=f"{RESULTS}/{SCALE}/seed_{{seed}}/case_1/offline_{{variant}}/record.json",
    output:
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/transfer_{{variant}}/record.json",
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/online_{{variant}}/record.json",
    wildcard_constraints:
        variant=HEADLINE,
    log:
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/notebooks/04_knowledge_transfer_{{variant}}.ipynb",
    shell:
        f"{RUN} 04_knowledge_transfer {{log:q}} -p case 3 -p seed {{wildcards.seed}} -p variant {{wildcards.variant}} {ROOTS}"


# Nothing reads what other variants would learn online, so helpers.runs.run ends notebook 04 after the transfer.
use rule transfer as transfer_alone with:
    output:
        f"{RESULTS}/{SCALE}/seed_{{seed}}/case_3/transfer_{{variant}}/record.json",
    wildcard_constraints:
        variant="|".join([*VARIANTS[1:], *TRIALS]),


rule inferred_settings:
    input:
        made_from("00_inferred_settings", f"{RESULTS}/{SCALE}/seed_0/inferred_settings/record.json"),
    output:
        f"{RESULTS}/{SCALE}/seed_0/inferred_settings/record.json",
    log:
        f"{RESULTS}/{SCALE}/seed_0/notebooks/00_inferred_settings.ipynb",
    shell:
        f"{RUN} 00_inferred_settings {{log:q}} -p seed 0 {ROOTS}"


rule claims:
    input:
        made_from("08_claims", f"{CASE}/experiments/record.json"),
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
        made_from("06_limits_and_alternatives", f"{CASE}/limits_safety/record.json"),
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
    for stage in ("experiments", "limits_safety"):
        stages += [f"{folder}/seed_{seed}/case_{case}/{stage}/record.json" for seed in SEEDS for case in CASES]
    for seed in FEW:
        for trial in TRIALS:
            stages += [f"{folder}/seed_{seed}/case_{case}/offline_{trial}/record.json" for case in (1, 2)]
            stages += [f"{folder}/seed_{seed}/case_3/transfer_{trial}/record.json"]
    return stages


def of_seed(seed):
    """Every result of a seed that the report reads, whatever was asked for."""
    folder = f"{RESULTS}/{SCALE}/seed_{seed}"
    stages = [f"{folder}/case_{case}/demonstrations/record.json" for case in CASES]
    stages += [f"{folder}/case_{case}/offline_{variant}/record.json" for case in (1, 2) for variant in VARIANTS]
    stages += [f"{folder}/case_3/offline_improved/record.json"]
    stages += [f"{folder}/case_3/transfer_{variant}/record.json" for variant in VARIANTS]
    stages += [f"{folder}/case_{case}/online_improved/record.json" for case in CASES]
    return stages


def finished(wildcards):
    """Every result that the report reads; those that are there, if some may be missing."""
    stages = [stage for seed in SEEDS for stage in of_seed(seed)] + (evidence() if EVIDENCE else [])
    return [stage for stage in stages if Path(stage).is_file()] if MISSING else stages


rule report:
    input:
        made_from("05_report", f"{REPORTS}/provenance.json"),
        template=[str(path) for path in sorted((ROOT / "reports/template").iterdir())],
        benchmarks=[str(path) for path in BENCHMARKS if path.is_file()],
        stages=finished,
    output:
        f"{REPORTS}/report.html",
        f"{REPORTS}/provenance.json",
    log:
        f"{REPORTS}/notebooks/05_report.ipynb",
    params:
        seeds=len(SEEDS),
        missing=int(MISSING),
    shell:
        f"{RUN} 05_report {{log:q}} -p seeds {{params.seeds}} -p missing {{params.missing}} -p scale {SCALE} -p input_root {FOLDER}"
        f" -p output_root {shlex.quote(str(Path(REPORTS).resolve()))}"
