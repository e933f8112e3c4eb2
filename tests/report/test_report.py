"""The report on the committed smoke results: complete, self-contained, readable, and refused when its input does not fit."""

import copy
import json
import re
import shutil
from functools import cache
from itertools import product

import pandas as pd
import pytest
from bs4 import BeautifulSoup

from helpers.report import collection, report, search_report, typesetting
from helpers.runs import freshness, identity
from helpers.runs.artifacts import ArtifactError, load_stage, save_stage
from helpers.runs.sources import PROJECT

CASES = (1, 2, 3)
FEATURES = ["C_A-I", "T-I", "C_A-II", "T-II", "C_A-III", "T-III"]
INPUTS, PARAMS = PROJECT / "notebooks/inputs", PROJECT / "params"
RESOURCES = {"src", "data", "srcset", "poster", "background"}
MISSING = {2: {"demonstrations": "01"}, 1: {"offline_printed": "02"}}
MISSING |= {3: {"transfer_improved": "04", "online_improved": "03 (04 for the transfer case)"}}
MIXTURES = {("inputs", name): name for name in ("src/helpers/learning/lstm.py", "torch")}
MIXTURES |= {("upstream", "case_2/demonstrations"): "seed_0/case_2/demonstrations", ("seed",): "the record itself"}
inputs_now = cache(identity.inputs)


def collect(root=INPUTS, params_root=PARAMS, n_seeds=1):
    return collection.collect(root, params_root, "smoke", CASES, n_seeds)


@pytest.fixture(scope="module")
def results():
    return collect()


@pytest.fixture(scope="module")
def written(results, tmp_path_factory):
    """The folder of a report, written where an older one and files of the user were."""
    folder = tmp_path_factory.mktemp("report") / "latest"
    for old in ("notebooks/05_report.ipynb", "notes.txt", "figures/figure_9.png", "tables/table_9.csv"):
        (folder / old).parent.mkdir(parents=True, exist_ok=True)
        (folder / old).write_text("old")
    assert report.write(folder, results) == folder / "report.html"
    return folder


@pytest.fixture(scope="module")
def page(written):
    """report.html without its style sheet and the TeX behind its maths."""
    found = BeautifulSoup((written / "report.html").read_text(encoding="utf-8"), "html.parser")
    for hidden in found(["style", "annotation"]):
        hidden.decompose()
    return found


@pytest.fixture(scope="module")
def text(page):
    """What a reader of the page reads, with a space for every white space."""
    return " ".join(page.body.get_text().split())


def n_words(element):
    return len(re.findall(r"\w[^\s]*", element.get_text(" ")))


def test_the_report_opens_without_a_network_and_no_markup_shows_through(page):
    assert page(["script", "iframe", "link"]) == []
    attributes = [element.attrs for element in page(True)]
    assert {found[name][:5] for found in attributes for name in RESOURCES & found.keys()} == {"data:"}
    assert re.search(r"@import|url\(http", str(attributes)) is None
    assert len(page("math")) > 20
    assert re.search(r".*(\$|\\|\*\*|\|--|{{|{%|!\[|\bnan\b|\bNone\b|undefined).*", page.body.get_text()) is None


@pytest.fixture(scope="module")
def targets(page):
    return {element["href"] for element in page("a", href=True)}


def test_links_lead_somewhere_inside_the_report_to_its_tables_and_to_the_code(page, targets, written):
    inside = {target[1:] for target in targets if target.startswith("#")}
    assert len(inside) > 60
    assert inside <= {element["id"] for element in page(id=True)}
    assert "https://doi.org/10.1002/aic.17306" in targets
    beside = {target for target in targets if not target.startswith(("#", "https://"))}
    assert {"tables/gaps.csv", "provenance.json"} <= beside
    assert any(target.endswith("notebooks/02_offline_irl.ipynb") for target in beside)
    assert [target for target in beside if not (written / target).resolve().exists()] == []


def test_figures_tables_and_equations_have_captions_and_numbers_and_are_linked_both_ways(page, targets, text):
    """Whatever has a number is led to from the text, and its number leads back; only what page one shows needs no lead."""
    images = page("img")  # those of make bench and make search where they were run
    benchmarks, searched = (report.BENCHMARKS / "scaling.svg").is_file(), (search_report.FOUND / "trials.csv").is_file()
    assert len(images) == 2 + 3 + 5 * len(CASES) + benchmarks + 2 * searched
    assert all(len(image.get("alt", "").split()) > 5 and image.find_parent("figure") for image in images)
    assert len({image["alt"] for image in images}) == len(images)
    assert len(page("thead")) == len(page("table")) >= 8
    assert all(row.find_parent("table") for row in page("tr"))
    numbered = {element["id"] for element in page(id=re.compile("^(fig|tab|eq)-"))}
    of_figures = [place for place in numbered if place.startswith("fig-")]
    assert len(page("figcaption")) == len(page("figure")) == len(images) == len(of_figures)
    assert all(table.find_parent("div", id=re.compile("^tab-")) for table in page("table"))
    assert {place for place in numbered if f"#{place}" not in targets} <= {"fig-page_one"}
    assert {f"#to-{place}" for place in numbered if place[:2] != "eq" and f"#{place}" in targets} <= targets
    assert all(f"{words}{number}." in text for words, number in product(("Figure ", "Table ", "Figure A", "Table A"), (1, 2)))
    assert all(f"The paper’s Table {number}" in text for number in (1, 2, 3, 4))


def test_numbers_follow_the_order_and_a_link_to_nothing_is_refused():
    text = "See @fig:b, @fig:a and @fig:a. #fig:a# #A:fig:c# #fig:b# $#eq:d#$ @fig:c"
    numbered = "See [Figure 2](#fig-b){#to-fig-b}, [Figure 1](#fig-a){#to-fig-a} and [Figure 1](#fig-a). "
    numbered += "[Figure 1.](#to-fig-a) [Figure A1.](#to-fig-c) [Figure 2.](#to-fig-b) $(1)$ [Figure A1](#fig-c){#to-fig-c}"
    assert typesetting.numbered(text).replace("\N{NO-BREAK SPACE}", " ") == numbered
    with pytest.raises(KeyError, match="fig-x"):
        typesetting.numbered("@fig:x")


def test_the_report_opens_with_one_page_to_stop_after_and_what_is_long_is_folded(page, text, written):
    """Claim and verdict, of the algorithms as printed first; two pictures; three doors."""
    order = "The paper claims|With the algorithms as printed|With algorithms that we changed|published numbers"
    start = text.index("The paper claims")
    places = [text.index(words, start) for words in f"{order}|The reproduction|Beyond it|How it was done".split("|")]
    assert places == sorted(places)
    assert n_words(page.find(id="verdict")) <= 120
    assert len(page.find(id="page-one")("img")) == 2
    assert len(page("details")) == len(page("summary")) > 5
    opened = copy.copy(page.body)
    for fold in opened("details"):
        fold.decompose()
    assert n_words(opened) <= 7000
    assert max(len(body("tr")) for body in opened("tbody")) <= 15
    assert (written / "report.html").stat().st_size < 6e6
    assert (written / "report.pdf").read_bytes().startswith(b"%PDF")  # the same, with the folds behind it


def test_page_one_of_the_published_report_can_be_read_in_a_minute():
    if not (published := PROJECT / "reports/reference/report.html").is_file():
        pytest.skip("no run was published yet")
    page = BeautifulSoup(published.read_text(encoding="utf-8"), "html.parser")
    assert n_words(page.find(id="verdict")) <= 120


def test_every_parameter_stands_in_the_report_with_unit_source_and_status(results, written, text):
    leaves = {(leaf["file"], leaf["key"]) for params in results.params.values() for leaf in params.leaves}
    table = pd.read_csv(written / "tables/parameters.csv", dtype=str, keep_default_na=False)
    assert set(zip(table["file"], table["key"], strict=True)) == leaves
    assert (table[["value", "unit", "source", "status"]] != "").all(axis=None)
    assert all(key in text for _, key in leaves)


def test_the_report_says_where_it_comes_from_and_that_smoke_means_nothing(results, written, text):
    origin = json.loads((written / "provenance.json").read_text())
    assert "revisions_of_stages" in origin
    assert (origin["scale"], origin["seeds"], sorted(origin["parameters"])) == ("smoke", [0], ["1", "2", "3"])
    seconds = sum(stage.record["seconds"] for stage in results.stages.values())
    assert sum(row["seconds"] for row in origin["seconds_by_stage"]) == pytest.approx(seconds)
    assert seconds <= origin["stage_seconds"]
    parts = (origin["revision"], f"torch {origin['versions']['torch']}", "Its numbers mean nothing", "Errata", "Deviations")
    assert [part for part in parts if part not in text] == []


def test_every_figure_and_table_of_the_paper_has_its_files_in_place_of_older_ones(written):
    figures = [f"figure_{number}" for number in range(1, 7)]
    figures += ["network", "comparison", "page_one", *(f"weights_{case}" for case in CASES)]
    figures += [f"{curves}_curves_case_{case}" for curves in ("learning", "online") for case in CASES]
    assert all((written / "figures" / f"{name}.svg").stat().st_size > 1000 for name in figures)
    assert [path.name for path in sorted((written / "figures").glob("*.png"))] == ["comparison.png", "figure_3.png"]
    assert not (written / "tables/table_9.csv").exists()  # of an older report, of which only what is not its own stays
    assert (written / "notes.txt").read_text() == (written / "notebooks/05_report.ipynb").read_text() == "old"
    assert [path.name for path in written.iterdir() if path.name.startswith(".")] == []
    tables = [written / f"tables/table_{number}.{ending}" for number, ending in product((1, 2, 3, 4), ("csv", "md"))]
    assert all(path.stat().st_size > 100 for path in tables)
    for number in (2, 3, 4):
        table = pd.read_csv(written / f"tables/table_{number}.csv")
        assert table["source"].tolist() == ["published", "reproduced", "verdict"] * 3
        assert table[FEATURES].notna().all(axis=None)


def test_a_drawing_is_shortened_by_what_no_screen_shows():
    text = '<text style="font-size: 9px; font-family: A, B; fill: #333" x="1.23456" transform="rotate(-0 1.2 3.4)">0.12345</text>'
    line = '<g id="line"><path id="m1" d="M 1.234 2 \nL 3 -4.567 \nz\n"/><use xlink:href="#m1"/></g>'
    drawing = f'<svg width="9.123">\n<metadata>\n who\n</metadata>\n<!-- what -->\n  {text}\n{line}</svg>'
    short = '<text style="font-size:9px;fill:#333" x="1.23">0.12345</text>'
    path = '<g><path id="m1" d="M1.23 2L3 -4.56z"/><use xlink:href="#m1"/></g>'
    assert typesetting.shortened(drawing) == f'<svg font-family="A, B" width="9.123">\n{short}\n{path}</svg>'


def test_comparison_has_one_row_for_each_published_number(written):
    table = pd.read_csv(written / "comparison.csv")
    keys = [[case + 1, case, row, name, 1] for case, row, name in product(CASES, ("expert", "policy", "alpha"), FEATURES)]
    assert table[["table", "case", "row", "feature", "n_seeds"]].to_numpy().tolist() == keys
    assert table[["published", "reproduced"]].notna().all(axis=None)
    assert table[["ci_low", "ci_high", "pred_low", "pred_high"]].isna().all(axis=None)
    assert set(table["reason"]) == {"one seed", "settings inferred from it"}
    found = table.set_index(["case", "row", "feature"])
    assert found.loc[(1, "expert", "C_A-I"), "published"] == 21.63  # Table 2, first and last number of the paper
    assert found.loc[(3, "alpha", "T-III"), "published"] == -0.541
    for row, stage in (("expert", "demonstrations"), ("policy", "transfer_improved"), ("alpha", "transfer_improved")):
        scores = pd.read_csv(INPUTS / "smoke/seed_0/case_3" / stage / "scores.csv").set_index("metric")["value"]
        metric = "alpha:T-II" if row == "alpha" else "v:T-II"
        assert found.loc[(3, row, "T-II"), "reproduced"] == pytest.approx(scores[metric], rel=1e-9)


def test_seeds_hold_the_metrics_of_every_stage(written):
    table = pd.read_csv(written / "seeds.csv")
    assert list(table) == ["case", "seed", "stage", "metric", "value"]
    assert table["metric"][table["value"].isna()].str.startswith("rise_time:").all()  # a loop may never arrive
    assert not table.duplicated(["case", "seed", "stage", "metric"]).any()
    v, alpha = ({f"{kind}:{name}" for name in FEATURES} for kind in ("v", "alpha"))
    learnt = v | {"epochs", "episodes", "gradient_steps"}
    expected = {"expert": v, "offline": learnt | alpha | {"feature_gap"}, "online": learnt | {"share"}, "minimum_variance": v}
    for case, (stage, metrics) in product(CASES, expected.items()):
        assert metrics | {"objective"} <= set(table.query("case == @case and stage == @stage")["metric"]), (case, stage)
    assert table.query("metric == 'episodes'")["value"].gt(0).all()


@pytest.fixture
def inputs(tmp_path, monkeypatch):
    """A copy of the committed results, for which the same holds: another commit made them, on another machine."""
    monkeypatch.setattr(freshness, "COMMITTED", tmp_path / "inputs")
    return shutil.copytree(INPUTS, tmp_path / "inputs")


def origin(notebook, case, seed, variant="improved", upstream=None):
    """The part of a record that says where a result comes from, as if it had been made now."""
    run = {"notebook": notebook, "case": case, "seed": seed, "scale": "smoke", "variant": variant}
    made_from, upstream = inputs_now(notebook, PARAMS, "smoke", case, variant), upstream or {}
    return run | {"inputs": made_from, "upstream": upstream, "identity": identity.identity(run, made_from, upstream)}


@pytest.fixture
def own(tmp_path):
    """The same results, as if the present code had made them on this machine."""
    folder = shutil.copytree(INPUTS, tmp_path / "own")
    for path in folder.rglob("record.json"):
        record = json.loads(path.read_text())
        now = origin(*(record[name] for name in ("notebook", "case", "seed", "variant", "upstream")))
        path.write_text(json.dumps(record | now))
    return folder


def refusal(*arguments):
    with pytest.raises(ArtifactError) as caught:
        collect(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_missing_stage_or_seed_names_its_file_and_what_to_run(inputs):
    assert "seed_1/case_1/demonstrations/record.json" in refusal(inputs, PARAMS, 2)
    for case, stage, notebook in ((case, *stage) for case, stages in MISSING.items() for stage in stages.items()):
        path = inputs / f"smoke/seed_0/case_{case}" / stage / "record.json"
        record = path.read_text()
        path.unlink()
        assert refusal(inputs) == f"{path}: this result is missing; run notebook {notebook} for case {case} and seed 0 first"
        path.write_text(record)


@pytest.fixture
def several(inputs):
    """Six seeds that differ by their number in one feature of the offline policy, and are alike otherwise."""
    for seed in range(1, 6):
        shutil.copytree(inputs / "smoke/seed_0", inputs / f"smoke/seed_{seed}")
    return inputs


def test_several_seeds_are_compared_by_median_and_intervals(several):
    results = collect(several, PARAMS, 6)
    rows = results.seeds.query("case == 1 and stage == 'offline' and metric == 'v:T-I'")
    assert rows["seed"].tolist() == [*range(6)]
    results.seeds.loc[rows.index, "value"] = [9.0, 1.0, 2.0, 4.0, 3.0, 5.0]
    table = report.tabulate(results)["comparison"]
    assert set(table["n_seeds"]) == {6}
    assert table[["ci_low", "ci_high", "pred_low", "pred_high"]].notna().all(axis=None)
    row = table.set_index(["case", "row", "feature"]).loc[(1, "policy", "T-I")]
    assert 1.0 <= row["ci_low"] < row["reproduced"] == 3.5 < row["ci_high"] <= 9.0
    reach = 2.570582 * (8 * 7 / 6) ** 0.5  # mean 4, s^2 = 8, t of five degrees; 100 trajectories carry more than the error of 500
    assert row[["pred_low", "pred_high"]].tolist() == pytest.approx([4 - reach, 4 + reach], rel=1e-6)


def rendered(results):
    values = report.said(results, report.tabulate(results), report.provenance(results))
    return typesetting.render("report.md.jinja", PROJECT / "reports/latest", appendix=None, **values)


def test_what_went_well_is_said(results, monkeypatch):
    """The smoke run reaches nothing, so the words for better results are asked for."""
    found = {"gap": [1, 2], "worse": [], "printed": [3], "worse_as_printed": [2], "online": [1]}
    monkeypatch.setattr(report, "_better", lambda _: found)
    text, said = rendered(results), ["online they beat the PID in Case Study I."]
    said += ["the match holds in Case Study III and fails in II; in I we cannot tell (mean feature error"]
    said += ["the match holds in Case Studies I and II; in III we cannot tell ("]
    assert [words for words in said if words not in text] == []
    assert "With a model**, minimum" not in text


@pytest.mark.torture
def test_claims_trials_and_budget_appear_where_they_were_run(results, several):
    trial = next(iter(results.params[1].trials))
    assert not {"claims", "trials"} & report.tabulate(results).keys()
    for seed, case in product(range(6), CASES):
        folder = several / f"smoke/seed_{seed}/case_{case}"
        made = origin("08_claims", case, seed) | {"revision": "abc", "seconds": 1.0}
        save_stage(folder / "experiments", made, {"scores.csv": pd.DataFrame({"stage": ["x"], "metric": ["y"], "value": [1.0]})})
        budget = pd.DataFrame({"episodes_per_epoch": [20, 500], "objective": [9.0 + seed, 12.0 + seed]})
        save_stage(folder / "online_budget", made, {"scores.csv": budget})
        scores = pd.DataFrame({"stage": ["offline"], "metric": ["feature_gap"], "value": [0.1 + seed / 100]})
        made |= origin("04_knowledge_transfer" if case == 3 else "02_offline_irl", case, seed, trial)
        save_stage(folder / f"{'transfer' if case == 3 else 'offline'}_{trial}", made, {"scores.csv": scores})
    results = collect(several, PARAMS, 6)
    tabulated = report.tabulate(results)
    drawn = report.draw(results, tabulated["comparison"])
    assert {"online_budget", "claims"} <= drawn.keys()
    assert tabulated["table_3"]["source"].tolist() == ["published", "reproduced", "interval of one run", "verdict"] * 3
    of_trials = tabulated["trials"].set_index("trial")["case II, %"]
    assert (list(of_trials.index), of_trials[trial]) == (["improved", "printed", trial], "12.5 (10.0 to 15.0; 6 seeds)")
    assert {"id", "statement", "verdict", "reason"} <= set(tabulated["claims"])
    text = rendered(results)
    parts = ("with 6 seeds", "95 % bootstrap interval", "What was tried offline", "# The paper's claims", "# Plant episodes")
    assert [part for part in parts if part not in text] == []
    assert re.search(r"\bnan\b|\{\{|\{%", text) is None
    for link in re.findall(r"\]\((figures/[^)]+)\)", text):
        assert link.removeprefix("figures/").removesuffix(".svg") in {*drawn, "benchmarks"}


def test_stages_made_with_other_parameters_are_refused_by_name(inputs, tmp_path):
    params = shutil.copytree(PARAMS, tmp_path / "params")
    case = params / "case_2.yaml"
    case.write_text(case.read_text().replace("value: 250", "value: 249"))
    sentence = refusal(inputs, params)
    assert "case_2/demonstrations/record.json" in sentence
    assert "(changed: params/case_2.yaml)" in sentence
    assert "case_1/demonstrations" not in sentence


def test_a_record_without_its_origin_is_refused(inputs):
    path = inputs / "smoke/seed_0/case_1/demonstrations/record.json"
    record = json.loads(path.read_text())
    for left in ({}, {"notebook": "01_demonstrations", "case": 1}):
        path.write_text(json.dumps({"files": record["files"]} | left))
        assert str(path) in refusal(inputs)


@pytest.mark.parametrize(("entry", "says"), MIXTURES.items())
def test_a_mixture_is_refused_naming_the_result_and_what_changed(own, entry, says):
    path = own / "smoke/seed_0/case_2/offline_improved/record.json"
    changed(path, entry)
    sentence = refusal(own)
    assert f"{path} (changed: {says})" in sentence
    assert sentence.count("record.json") == 1


def changed(path, entry):
    """Write another value for an entry of a record."""
    whole = json.loads(path.read_text())
    part = whole[entry[0]] if len(entry) > 1 else whole
    assert entry[-1] in part
    part[entry[-1]] = 7
    path.write_text(json.dumps(whole))


def test_a_part_of_the_limits_is_none_all_count_in_the_time_and_are_left_out_by_name_when_made_from_other_inputs(own):
    folder = own / "smoke/seed_0/case_1"
    for part in collection.LIMITS[:-1]:
        shutil.copytree(folder / "online_improved", folder / f"limits_{part}")
    assert collect(own).limits == {}
    shutil.copytree(folder / "online_improved", folder / "limits_safety")
    results = collect(own)
    assert (set(results.limits), results.left_out) == ({(1, 0, part) for part in collection.LIMITS}, ())
    one_policy = load_stage(folder / "one_policy", "notebook 09")  # which is committed too
    records = [stage.record["seconds"] for stage in (*results.stages.values(), *results.limits.values(), one_policy)]
    assert report.provenance(results)["stage_seconds"] == pytest.approx(sum(records))
    changed(folder / "limits_budget/record.json", ("inputs", "params/learning.yaml"))
    results = collect(own)
    assert (results.limits, results.left_out) == ({}, ("03_online_improvement",))  # the notebook that the stand-in is of
    assert [stage.record["notebook"] for stage in results.beyond] == ["09_one_policy"]
    assert "made from other code or parameters than there are now: 03_online_improvement" in rendered(results)


@pytest.mark.torture
def test_seeds_with_missing_stages_are_left_out_only_when_asked_and_the_report_says_so(several, tmp_path):
    shutil.rmtree(several / "smoke/seed_2/case_3/transfer_improved")
    with pytest.raises(ArtifactError, match="seed_2/case_3/transfer_improved"):
        collect(several, PARAMS, 6)
    results = collection.collect(several, PARAMS, "smoke", CASES, 6, missing_allowed=True)
    assert (results.missing, results.n_seeds, set(results.seeds["seed"])) == ((2,), 5, {0, 1, 3, 4, 5})
    assert report.provenance(results)["missing_seeds"] == [2]
    assert "shows 5 of 6 seeds: a stage of seed 2 failed or was not run" in rendered(results)
    for seed in (0, 1, 3, 4, 5):
        shutil.rmtree(several / f"smoke/seed_{seed}/case_1/demonstrations")
    with pytest.raises(ArtifactError, match="seed_0/case_1/demonstrations"):  # none is whole
        collection.collect(several, PARAMS, "smoke", CASES, 6, missing_allowed=True)


@pytest.mark.parametrize("broken", ["draw", "tabulate", "said", "render", "to_html", "to_pdf"])
def test_a_report_that_fails_leaves_the_older_one_alone(results, tmp_path, monkeypatch, broken):
    def fail(*_, **__):
        raise RuntimeError(broken)

    stand_ins = {"draw": lambda *_: {}, "said": lambda *_: {}, "render": lambda *_, **__: "", "to_html": lambda *_: None}
    for name, stand_in in (stand_ins | {broken: fail}).items():
        monkeypatch.setattr(report, name, stand_in)
    (tmp_path / "figures").mkdir()
    old = [tmp_path / "figures/figure_3.svg", tmp_path / "report.html"]
    for path in old:
        path.write_text("old")
    with pytest.raises(RuntimeError, match=broken):
        report.write(tmp_path, results)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "figures", *old]
    assert [path.read_text() for path in old] == ["old", "old"]
