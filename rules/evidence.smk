# The runs beyond the paper's own: inferred settings, claims, limits and alternatives, one policy for all cases, a plant of one's own
# (notebooks 00, 08, 06, 09 and 07).
def learned(wildcards):
    """The results of notebooks 01 to 04 for a case."""
    kinds = ("offline", "transfer", "online") if wildcards.case == "3" else ("offline", "online")
    return [record("demonstrations"), *(record(f"{kind}_{HEADLINE}") for kind in kinds)]


rule inferred_settings:
    input:
        made_from("00_inferred_settings", record("inferred_settings", SEED)),
    output:
        record("inferred_settings", SEED),
    log:
        f"{SEED}/notebooks/00_inferred_settings.ipynb",
    shell:
        run("00_inferred_settings", "seed")


rule claims:
    input:
        made_from("08_claims", record("experiments")),
        learned,
    output:
        record("experiments"),
        record("online_budget"),
    log:
        f"{LOG}/08_claims.ipynb",
    priority: -1
    shell:
        run("08_claims", "case", "seed")


rule limits:
    input:
        made_from("06_limits_and_alternatives", record("limits_safety")),
        learned,
        record("one_policy", f"{SEED}/case_1"),
    output:
        [record(f"limits_{part}") for part in ("attainable", "budget", "quality", "robustness", "safety")],
    log:
        f"{LOG}/06_limits_and_alternatives.ipynb",
    priority: -2
    shell:
        run("06_limits_and_alternatives", "case", "seed")


rule one_policy:
    input:
        made_from("09_one_policy", record("one_policy", f"{SEED}/case_1")),
    output:
        record("one_policy", f"{SEED}/case_1"),
    log:
        f"{SEED}/notebooks/09_one_policy.ipynb",
    priority: -1
    shell:
        run("09_one_policy", "seed")


rule own_plant:
    input:
        made_from("07_your_own_process", record("own_process", f"{SEED}/case_1"), case=1),
    output:
        record("own_process", f"{SEED}/case_1"),
    log:
        f"{SEED}/notebooks/07_your_own_process.ipynb",
    priority: -1
    shell:
        run("07_your_own_process", "seed", input_root=ROOT / "notebooks/plant")
