# The order of the stages for each case and seed. Every stage is one notebook, executed by helpers.runs.run.
# Settings (snakemake --config name=value): seeds (how many), scale (smoke or paper), results, reports (folders),
# evidence=1 for the runs beyond the paper's own (notebooks 00 and 06 to 09, and trials of offline learning),
# missing=1 for a report of the seeds whose stages are all there, and only, the seed of the rule one_seed.
import shlex
import sys
from pathlib import Path

from helpers.settings.leaf import read_yaml
from helpers.settings.paper import HEADLINE, load_trials

ROOT = Path(workflow.basedir)
SCALE = config.get("scale", "paper")
SEEDS = range(int(config.get("seeds", 1)))
FEW = SEEDS[: read_yaml(ROOT / "params/limits.yaml")["seeds"]["value"]]  # of notebook 06 and of the trials
EVIDENCE = bool(int(config.get("evidence", 0)))
MISSING = bool(int(config.get("missing", 0)))
RESULTS = config.get("results", "results")
REPORTS = config.get("reports", "reports/latest")
VARIANTS = [HEADLINE, "printed"]
TRIALS = load_trials(ROOT / "params")
CASES = [1, 2, 3]
SEED = f"{RESULTS}/{SCALE}/seed_{{seed}}"
CASE = f"{SEED}/case_{{case}}"
LOG = f"{CASE}/notebooks"


def record(stage, place=CASE):
    """The file of a stage that is written last."""
    return f"{place}/{stage}/record.json"


def run(notebook, *given, input_root=RESULTS, output_root=RESULTS):
    """The command of a stage; `given`: the wildcards, or names and values, that its notebook gets."""
    words = [f"-p {word} {{wildcards.{word}}}" if word.isalpha() else f"-p {word}" for word in given]
    places = {"input_root": input_root, "output_root": output_root}
    roots = [f"-p {name} {shlex.quote(str(Path(place).resolve()))}" for name, place in places.items()]
    return " ".join([shlex.quote(sys.executable), "-m helpers run", notebook, "{log:q}", *words, f"-p scale {SCALE}", *roots])


wildcard_constraints:
    seed=r"\d+",
    case=r"\d+",
    variant="|".join([*VARIANTS, *TRIALS]),


localrules:
    all,
    one_seed,


rule all:
    input:
        f"{REPORTS}/report.html",


include: "rules/again.smk"
include: "rules/paper.smk"
include: "rules/evidence.smk"
include: "rules/report.smk"
