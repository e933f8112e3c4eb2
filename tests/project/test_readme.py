"""README and docs keep their word: their numbers are those of the reference run, their commands and links exist."""

import json
import re
import shlex
from itertools import takewhile
from pathlib import Path

import pandas as pd
import pytest

from helpers.__main__ import COMMANDS
from helpers.report.publish import GLANCE
from helpers.runs.request import parameter_names
from helpers.runs.sources import PROJECT

PATHS = [PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))]
PAGES = {path.relative_to(PROJECT).as_posix(): path.read_text(encoding="utf-8") for path in PATHS}
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


def test_readme_is_short_its_commands_stand_before_its_tables_and_it_leads_to_every_page():
    readme = PAGES["README.md"]
    assert len(readme.splitlines()) <= 130
    assert readme.index("download.pytorch.org") < readme.index("make reports   #") < readme.index("<!-- glance")
    assert PAGES.keys() - {"README.md"} <= set(LINK.findall(readme))


def test_no_sentence_stands_twice():
    """Of eight words or more; a command may."""
    prose = re.sub(r"<!--.*?-->|\[([^]]*)\]\([^)]*\)", r"\1", FENCED.sub("", ALL))
    sentences = [" ".join(sentence.split()) for sentence in re.split(r"(?<=[.:])\s|\n\n|\|", prose)]
    long = [sentence for sentence in sentences if len(sentence.split()) >= 8]
    assert sorted(set(long)) == sorted(long)


@published
def test_the_numbers_are_those_of_the_reference_run():
    gaps, time, limits = (pd.read_csv(REFERENCE / f"tables/{name}.csv") for name in ("gaps", "time", "limits_gaps"))
    rows = [line for line in block("glance").splitlines() if re.match(r"\| *I", line)]
    for row, case in zip(rows, gaps.to_dict("records"), strict=True):
        assert [float(number) for number in PERCENT.findall(row)] == pytest.approx([100 * case[name] for name in GLANCE], abs=0.051)
    n_seeds = gaps["n_seeds"].min()
    assert ("one seed" if n_seeds == 1 else f"{n_seeds} seeds") in block("glance")
    provenance = json.loads((REFERENCE / "provenance.json").read_text(encoding="utf-8"))
    minutes, n_seeds, hours = map(float, re.findall(r"\d+(?:\.\d+)?", block("cost")))
    assert n_seeds == len(provenance["seeds"])
    assert (minutes, hours) == pytest.approx((time["seconds"].sum() / 60, provenance["stage_seconds"] / 3600), abs=0.051)
    rows = {line.split("|")[1].strip(): line for line in block("time").splitlines() if line.startswith("|")}
    for stage, times in time.groupby("stage")["seconds"]:
        assert re.findall(r"\b\d+\b", rows[stage].replace(stage, "")) == [f"{seconds:.0f}" for seconds in times]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in block("limits").splitlines()[2:]]
    assert len(cells) == 11
    every = limits.set_index("controller")
    assert [row for row in cells if row[1:] != every.loc[row[0]].tolist()] == []


@published
def test_what_follows_from_the_limits_is_what_the_reference_run_shows():
    """One policy nearest to the best; online at minimum variance, and ahead where it learns anew; only MPC never below the PID."""

    def medians(name, index):
        table = pd.read_csv(REFERENCE / f"tables/limits_{name}.csv").set_index(index)
        return table.map(lambda cell: float(str(cell).split(" ")[0]))

    gaps, one_policy = medians("gaps", "controller"), "one policy, through the model"
    others = gaps.drop([one_policy, "minimum variance on x", "programme, filtered y", "programme on x"])
    assert (gaps.loc[one_policy] <= others).all(axis=None)
    assert (gaps.loc["online policy"] - gaps.loc["minimum variance on y"]).max() < 1
    there = medians("improved", ["controller", "case"])
    for name in ("minimum variance on y", "offset-free MPC"):
        assert (there.loc["improved on that plant"] > there.loc[name]).all(axis=None)
    shares = medians("robustness", ["controller", "case"])
    elsewhere = shares.loc["online policy", "set points"]
    assert f"{elsewhere.min():.0f} to {elsewhere.max():.0f} % of the PID's objective" in PAGES["README.md"]
    kept = shares.groupby("controller").min().min(axis=1).drop("PID (demonstrator)")
    assert kept[kept >= 100].index.tolist() == ["offset-free MPC"]


@published
def test_what_is_said_of_fit_and_search_is_what_the_reference_holds():
    page = " ".join(PAGES["docs/evidence.md"].split())
    losses = pd.read_csv(REFERENCE / "inferred_settings/hypotheses.csv").set_index("reading")["loss_2_4"]
    adopted = losses.iloc[0]  # four steps a sample
    assert f"leave a loss of {adopted:.1f} where one leaves {losses['1 step a sample']:.1f}" in page
    trials = pd.read_csv(REFERENCE / "search/trials.csv")
    assert set(trials.groupby("case")["setting"].nunique()) == {int(re.findall(r"`make search` tries (\d+) in", page)[0])}


def anchors(text):
    """The names of a page's headings, as GitHub makes them."""
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_links_lead_to_files_and_headings(page, link):
    path, _, anchor = link.partition("#")
    target = (PROJECT / page).parent / path if path else PROJECT / page
    if target.resolve().is_relative_to(REFERENCE) and not REFERENCE.is_dir():
        pytest.skip("no run was published yet")
    assert target.exists()
    if anchor:
        assert anchor in anchors(target.read_text(encoding="utf-8"))


def test_the_targets_and_settings_named_exist_and_every_parameter_file_is_listed():
    makefile = (PROJECT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^(\w+):", makefile, re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make (\w+)", ALL, re.MULTILINE))
    assert targets - {"help"} <= named <= targets
    assert all(f"$({name})" in makefile or f"({name})," in makefile for name in re.findall(r"`make[^`]* ([A-Z]+)=", ALL))
    listed = set(re.findall(r"params/(\w+\.yaml)\)", PAGES["docs/parameters.md"]))
    assert listed == {path.name for path in (PROJECT / "params").glob("*.yaml")}


@pytest.mark.parametrize("line", [line for line in COMMAND_LINES if " -m helpers " in line or " -m snakemake " in line])
def test_the_commands_of_helpers_and_snakemake_name_what_there_is(line):
    words = shlex.split(line, comments=True)
    if "helpers" in words:
        assert words[words.index("helpers") + 1] in COMMANDS
        assert (PROJECT / words[words.index("helpers") + 2]).is_file()
        return
    assert (PROJECT / words[words.index("--profile") + 1] / "config.yaml").is_file()
    snakefile = (PROJECT / "Snakefile").read_text(encoding="utf-8")
    settings = takewhile(lambda word: not word.startswith("--"), words[words.index("--config") + 1 :])
    assert all(f'config.get("{setting.split("=")[0]}"' in snakefile for setting in settings)


def test_the_papermill_commands_name_notebooks_and_their_parameters():
    commands = [shlex.split(line) for line in COMMAND_LINES if line.startswith("papermill ")]
    assert {command[1][10:12] for command in commands} >= {"01", "02", "03", "04"}
    for _, path, _, *options in commands:
        assert {*options[::3]} <= {"-p"}
        assert {*options[1::3]} <= {*parameter_names(Path(path).stem)}
