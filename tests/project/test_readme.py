"""README keeps its word: its numbers are those of the reference run, its commands and links exist."""

import re
import shlex

import nbformat
import pandas as pd
import pytest

from helpers.runs.sources import PROJECT

README = (PROJECT / "README.md").read_text(encoding="utf-8")
REFERENCE = PROJECT / "reports/reference"
LINKS = sorted(set(re.findall(r"\]\(([^)#]+?)\)", README)))
PERCENT = re.compile(r"(\d+(?:\.\d+)?) %")

published = pytest.mark.skipif(not REFERENCE.is_dir(), reason="no run was published yet")


def block(name):
    """The lines between the marks of a block that `make publish` writes."""
    (found,) = re.findall(rf"<!-- {name}:.*?-->\n(.*?)<!-- /{name} -->", README, re.DOTALL)
    return found


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


@pytest.mark.parametrize("link", [link for link in LINKS if "://" not in link])
def test_links_lead_to_files(link):
    if link.startswith("reports/reference") and not REFERENCE.is_dir():
        pytest.skip("no run was published yet")
    assert (PROJECT / link).exists()


def test_the_targets_named_exist():
    targets = set(re.findall(r"^(\w+):", (PROJECT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make (\w+)", README, re.MULTILINE))
    assert {"reports", "test", "smoke", "lab", "publish"} <= named <= targets


def test_the_papermill_commands_name_notebooks_and_their_parameters():
    commands = [shlex.split(line) for line in README.splitlines() if line.startswith("papermill ")]
    assert {command[1][10:12] for command in commands} >= {"01", "02", "03", "04"}
    for _, path, _, *options in commands:
        cells = nbformat.read(PROJECT / path, as_version=4).cells
        (parameters,) = [cell.source for cell in cells if "parameters" in cell.metadata.get("tags", [])]
        for flag, name, _ in zip(*[iter(options)] * 3, strict=True):
            assert flag == "-p"
            assert re.search(rf"^{name} = ", parameters, re.MULTILINE)
