# The report, and what it reads.

# Of make bench and make search, which may not have been run: what the report shows of them.
APART = [*(f"benchmarks/{name}" for name in ("summary.md", "machine.md", "scaling.svg")), "search/record.json"]
APART = [ROOT / "reports/reference" / name for name in APART]


def read_of_seed(seed):
    """Every result of a seed that the report reads, by place below its folder."""
    stages = [f"case_{case}/{stage}" for case in CASES for stage in ("demonstrations", f"offline_{HEADLINE}", f"online_{HEADLINE}")]
    stages += [f"case_{case}/offline_{variant}" for case in (1, 2) for variant in VARIANTS[1:]]
    stages += [f"case_3/transfer_{variant}" for variant in VARIANTS]
    if EVIDENCE:
        stages += ["inferred_settings"] if seed == 0 else []
        stages += [f"case_{case}/{stage}" for case in CASES for stage in ("experiments", *(["limits_safety"] if seed in FEW else []))]
        stages += ["case_1/one_policy", "case_1/own_process"] if seed in FEW else []
        for name, trial in TRIALS.items() if seed in FEW else ():
            stages += [f"case_{case}/{'transfer' if case == 3 else 'offline'}_{name}" for case in trial.cases]
    return stages


def records_of_seed(seed):
    """What Snakemake waits for of a seed."""
    return [record(stage, SEED.format(seed=seed)) for stage in read_of_seed(seed)]


def finished(wildcards):
    """Every result that the report reads; those that are there, if some may be missing."""
    stages = [stage for seed in SEEDS for stage in records_of_seed(seed)]
    return [stage for stage in stages if Path(stage).is_file()] if MISSING else stages


# Seed by seed, because with hundreds of jobs waiting Snakemake itself takes a quarter of a processor.
rule one_seed:
    input:
        records_of_seed(int(config.get("only", 0))),


rule report:
    input:
        made_from("05_report", f"{REPORTS}/provenance.json"),
        template=[str(path) for path in sorted((ROOT / "reports/template").iterdir())],
        apart=[str(path) for path in APART if path.is_file()],
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
        run("05_report", "seeds {params.seeds}", "missing {params.missing}", output_root=REPORTS)
