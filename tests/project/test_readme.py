"""README and docs keep their word: their numbers are those of the reference run, their commands and links exist."""

import json
import re
import shlex

import nbformat
import pandas as pd
import pytest

from helpers.__main__ import COMMANDS
from helpers.runs.sources import PROJECT

PAGES = {
    path.relative_to(PROJECT).as_posix(): path.read_text(encoding="utf-8")
    for path in [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]
}
ALL = "\n".join(PAGES.values())
REFERENCE = PROJECT / "reports/reference"
LINK = re.compile(r"""(?:\]\(|src=")([^)"]+)""")
LINKS = sorted({(page, link) for page, text in PAGES.items() for link in LINK.findall(text) if "://" not in link})
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMAND_LINES = [line for language, code in FENCED.findall(ALL) if language == "sh" for line in code.splitlines()]
PERCENT = re.compile(r"(\d+(?:\.\d+)?) %")

published = pytest.mark.skipif(not REFERENCE.is_dir(), reason="no run was published yet")


def block(name):
    """The lines between the marks of a block that `make publish` writes."""
    (found,) = re.findall(rf"<!-- {name}:.*?-->\n(.*?)<!-- /{name} -->", ALL, re.DOTALL)
    return found


def test_readme_is_short_and_its_commands_stand_before_its_tables():
    readme = PAGES["README.md"]
    assert len(readme.splitlines()) <= 130
    assert readme.index("download.pytorch.org") < readme.index("make reports   #") < readme.index("<!-- glance")


def test_no_sentence_stands_twice():
    """Of eight words or more; a command may."""
    prose = re.sub(r"<!--.*?-->|\[([^]]*)\]\([^)]*\)", r"\1", FENCED.sub("", ALL))
    sentences = [" ".join(sentence.split()) for sentence in re.split(r"(?<=[.:])\s|\n\n|\|", prose)]
    long = [sentence for sentence in sentences if len(sentence.split()) >= 8]
    assert sorted(set(long)) == sorted(long)


@published
def test_the_comparison_at_a_glance_is_that_of_the_reference_run():
    """The paper's gap from comparison.csv; expert error, gaps and online share from seeds.csv: the median over the seeds."""
    compared = pd.read_csv(REFERENCE / "comparison.csv").set_index(["case", "row"])
    every = pd.read_csv(REFERENCE / "seeds.csv")
    gaps = every.query("metric == 'feature_gap'").groupby(["stage", "case"])["value"].median()
    reached = every.query("metric == 'objective_x'").pivot_table(index=["case", "seed"], columns="stage", values="value")
    shares = (100 * reached["online"] / reached["minimum_variance"]).groupby("case").median()
    experts = every.query("stage == 'expert'").pivot_table(index=["case", "seed"], columns="metric", values="value")
    rows = [line for line in block("glance").splitlines() if re.match(r"\| *I", line)]
    assert len(rows) == 3
    for case, row in enumerate(rows, start=1):
        expert, policy = compared.loc[(case, "expert")], compared.loc[(case, "policy")]
        printed = expert.set_index("feature")["published"].add_prefix("v:")
        error = (experts.loc[case, printed.index] / printed - 1).abs().mean(axis=1).median()
        paper = (policy["published"].to_numpy() / expert["published"].to_numpy() - 1).__abs__().mean()
        ours, as_printed = (100 * gaps[stage, case] for stage in ("offline", "offline_printed"))
        assert re.search(rf"\| *{'I' * case} *\|", row)
        found = [float(number) for number in PERCENT.findall(row)]
        assert found == pytest.approx([100 * error, 100 * paper, ours, as_printed, shares[case]], abs=0.051)
    n_seeds = compared["n_seeds"].unique().tolist()
    assert ("one seed" if n_seeds == [1] else f"{n_seeds[0]} seeds") in block("glance")


@published
def test_the_costs_are_those_of_the_reference_run():
    seconds = pd.read_csv(REFERENCE / "tables/time.csv")["seconds"].sum()
    provenance = json.loads((REFERENCE / "provenance.json").read_text(encoding="utf-8"))
    minutes, n_seeds, hours = map(float, re.findall(r"\d+(?:\.\d+)?", block("cost")))
    assert n_seeds == len(provenance["seeds"])
    assert (minutes, hours) == pytest.approx((seconds / 60, provenance["stage_seconds"] / 3600), abs=0.51)


@published
def test_the_times_are_those_of_the_reference_run():
    table = pd.read_csv(REFERENCE / "tables/time.csv")
    rows = {line.split("|")[1].strip(): line for line in block("time").splitlines() if line.startswith("|")}
    for stage, times in table.groupby("stage")["seconds"]:
        assert re.findall(r"\b\d+\b", rows[stage].replace(stage, "")) == [f"{seconds:.0f}" for seconds in times]


@published
def test_the_gaps_to_the_optimum_are_those_of_the_reference_run():
    every = pd.read_csv(REFERENCE / "tables/limits_gaps.csv").set_index("controller")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block("limits").splitlines()[2:]]
    assert len(rows) == 11
    for controller, *cells in rows:
        assert cells == every.loc[controller].filter(like="= 30").tolist()


@published
def test_what_follows_from_the_limits_is_what_the_reference_run_shows():
    """Minimum variance ahead of all learners; improving elsewhere ahead of it, mostly of MPC too; only MPC never below the PID."""

    def medians(name, index):
        table = pd.read_csv(REFERENCE / f"tables/limits_{name}.csv").set_index(index)
        return table.map(lambda cell: float(str(cell).split(" ")[0]))

    gaps = medians("gaps", "controller").filter(like="= 30")
    learners = gaps.loc[[name for name in gaps.index if "REINFORCE" in name or "PPO" in name or name == "PID, tuned"]]
    assert len(learners) == 6
    assert (learners > gaps.loc["minimum variance on y"]).all(axis=None)
    there = medians("improved", ["controller", "case"])
    ahead = {name: there.loc["improved on that plant"] > there.loc[name] for name in ("minimum variance on y", "offset-free MPC")}
    assert ahead["minimum variance on y"].all(axis=None)
    assert ahead["offset-free MPC"].sum(axis=None) > 3  # of six
    kept = medians("robustness", ["controller", "case"]).groupby("controller").min().min(axis=1).drop("PID (demonstrator)")
    assert kept[kept >= 100].index.tolist() == ["offset-free MPC"]


def anchors(text):
    """The names of a page's headings, as GitHub makes them."""
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_links_lead_to_files_and_headings(page, link):
    path, _, anchor = link.partition("#")
    target = (PROJECT / page).parent / path
    if target.resolve().is_relative_to(REFERENCE) and not REFERENCE.is_dir():
        pytest.skip("no run was published yet")
    assert target.exists()
    if anchor:
        assert anchor in anchors(target.read_text(encoding="utf-8"))


def test_every_page_can_be_reached_from_readme():
    assert {path for path in PAGES if path != "README.md"} <= set(LINK.findall(PAGES["README.md"]))


def test_the_targets_and_settings_named_exist():
    makefile = (PROJECT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^(\w+):", makefile, re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make (\w+)", ALL, re.MULTILINE))
    assert targets - {"help"} <= named <= targets
    assert all(f"$({name})" in makefile or f"({name})," in makefile for name in re.findall(r"`make[^`]* ([A-Z]+)=", ALL))


@pytest.mark.parametrize("line", [line for line in COMMAND_LINES if " -m helpers " in line or " -m snakemake " in line])
def test_the_commands_of_helpers_and_snakemake_name_what_there_is(line):
    words = shlex.split(line, comments=True)
    if "helpers" in words:
        assert words[words.index("helpers") + 1] in COMMANDS
        assert (PROJECT / words[words.index("helpers") + 2]).is_file()
        return
    assert (PROJECT / words[words.index("--profile") + 1] / "config.yaml").is_file()
    snakefile = (PROJECT / "Snakefile").read_text(encoding="utf-8")
    for setting in words[words.index("--config") + 1 :]:
        if setting.startswith("--"):
            break
        assert f'config.get("{setting.split("=")[0]}"' in snakefile


def test_every_parameter_file_is_listed():
    assert {path.name for path in (PROJECT / "params").glob("*.yaml")} == set(
        re.findall(r"params/(\w+\.yaml)\)", PAGES["docs/parameters.md"])
    )


def test_the_papermill_commands_name_notebooks_and_their_parameters():
    commands = [shlex.split(line) for line in COMMAND_LINES if line.startswith("papermill ")]
    assert {command[1][10:12] for command in commands} >= {"01", "02", "03", "04"}
    for _, path, _, *options in commands:
        cells = nbformat.read(PROJECT / path, as_version=4).cells
        (parameters,) = [cell.source for cell in cells if "parameters" in cell.metadata.get("tags", [])]
        for flag, name, _ in zip(*[iter(options)] * 3, strict=True):
            assert flag == "-p"
            assert re.search(rf"^{name} = ", parameters, re.MULTILINE)
