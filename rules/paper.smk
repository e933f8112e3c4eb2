# The paper's own chain: demonstrations, offline learning, online improvement, knowledge transfer (notebooks 01 to 04).
rule demonstrations:
    input:
        made_from("01_demonstrations", record("demonstrations")),
    output:
        record("demonstrations"),
    log:
        f"{LOG}/01_demonstrations.ipynb",
    shell:
        run("01_demonstrations", "case", "seed")


rule offline:
    input:
        made_from("02_offline_irl", record("offline_{variant}")),
        demonstrations=record("demonstrations"),
    output:
        record("offline_{variant}"),
    log:
        f"{LOG}/02_offline_irl_{{variant}}.ipynb",
    shell:
        run("02_offline_irl", "case", "seed", "variant")


rule online:
    input:
        made_from("03_online_improvement", record("online_{variant}")),
        demonstrations=record("demonstrations"),
        offline=record("offline_{variant}"),
    output:
        record("online_{variant}"),
    wildcard_constraints:
        case="[12]",
    log:
        f"{LOG}/03_online_improvement_{{variant}}.ipynb",
    shell:
        run("03_online_improvement", "case", "seed", "variant")


rule transfer:
    input:
        made_from("04_knowledge_transfer", record("transfer_{variant}")),
        demonstrations=record("demonstrations"),
        source=record("offline_{variant}", f"{SEED}/case_1"),
    output:
        record("transfer_{variant}"),
        record("online_{variant}"),
    wildcard_constraints:
        case="3",
        variant=HEADLINE,
    log:
        f"{LOG}/04_knowledge_transfer_{{variant}}.ipynb",
    shell:
        run("04_knowledge_transfer", "case", "seed", "variant")


# Nothing reads what other variants would learn online, so helpers.runs.run ends notebook 04 after the transfer.
use rule transfer as transfer_alone with:
    output:
        record("transfer_{variant}"),
    wildcard_constraints:
        case="3",
        variant="|".join([*VARIANTS[1:], *TRIALS]),
