"""The section of the report on limits: what it shows is what notebook 06 wrote, and it is not there where that was not run."""

from itertools import product
from types import SimpleNamespace

import pandas as pd
import pytest

from helpers.report import limits_findings, limits_report, typesetting
from helpers.report.collection import LIMITS
from helpers.runs.artifacts import load_stage, save_stage
from helpers.runs.sources import PROJECT
from helpers.settings.paper import load


@pytest.fixture(scope="module")
def results(root, tmp_path_factory):
    """What notebook 06 wrote of two cases, for as many seeds as a test asks for, five at most."""
    stages = {}
    for case, seed in product((1, 2), range(5)):
        place = tmp_path_factory.mktemp("limits")
        write(place, 10.0 * case + seed)
        stages |= {(case, seed, part): load_stage(place / f"limits_{part}", "notebook 06") for part in LIMITS}

    def build(seeds):
        limits = {place: stage for place, stage in stages.items() if place[1] < seeds}
        return SimpleNamespace(params={case: load(root, case) for case in (1, 2)}, limits=limits)

    return build


def write(folder, level):
    """What notebook 06 writes, in small: the gap of the MPC and every other number follow from `level`."""
    objectives = {"expert": 10.0, "mpc": 19.0, "irl_reinforce": level, "dynamic_programme": 20.0, "minimum_variance": 18.0}
    objectives |= {"minimum_variance_filtered": 18.5, "minimum_variance_x": 19.8, "dynamic_programme_filtered": 19.0}
    gaps = pd.DataFrame(objectives.items(), columns=["controller", "objective"])
    below = gaps["controller"].map({"mpc": level, "irl_reinforce": 8.0}).fillna(100 * (1 - gaps["objective"] / 20))
    gaps = gaps.assign(gap=below, gap_low=below - 1, gap_high=below + 1, low=gaps["objective"] - 0.1, high=gaps["objective"] + 0.1)
    grids = pd.DataFrame({"states": [41, 61], "difference": [0.02, -level / 1e4]})
    save_stage(folder / "limits_attainable", {}, {"gaps.csv": gaps, "grids.csv": grids})
    rows = [("mpc", 0, 19.0), ("ppo", 0, 1.0), ("ppo", 500, level), ("pid_tuned", 0, 10.0), ("pid_tuned", 400, level / 2)]
    curves = pd.DataFrame(rows, columns=["learner", "episodes", "objective"])
    rows = [("mpc", 19.0, 19.0), ("ppo", 1.0, level), ("irl_reinforce", 15.0, level + 2)]
    budget = pd.DataFrame(rows, columns=["learner", "0", "500"])
    save_stage(folder / "limits_budget", {}, {"curves.csv": curves, "budget.csv": budget})
    rows = [("mpc", "iae:T", level), ("mpc", "rise_time:T", 0.2), ("mpc", "settling_time_5:T", None), ("mpc", "offset:T", 0.012)]
    rows += [("mpc", "overshoot_single:T", 0.1), ("mpc", "harris:T", 0.9)]
    rows += [("ppo", "offset:C_A", -1.5), ("ppo", "rise_time:T", 0.2), ("ppo", "overshoot:C_A", 0.0)]
    save_stage(folder / "limits_quality", {}, {"quality.csv": pd.DataFrame(rows, columns=["controller", "figure", "value"])})
    places = [("model", "1", "1"), ("model", "2", "1"), ("model", "1.3", "0.7"), ("set_point", "1.25", "1")]
    objectives = {"expert": [10.0] * 4, "mpc": [10.0, 20.0, 18.0, 12.0], "online": [8.0, 16.0, 5.0, 4.0]}
    cells = [(*place, name, value) for name, values in objectives.items() for place, value in zip(places, values, strict=True)]
    robust = pd.DataFrame(cells, columns=["group", "row", "column", "controller", "objective"]).assign(standard_error=0.0)
    there = {"expert": 1.0, "minimum_variance": 15.0, "online_there": level}
    improved = pd.DataFrame(there.items(), columns=["controller", "objective"]).assign(state=1.3, input=0.7)
    save_stage(folder / "limits_robustness", {}, {"robustness.csv": robust, "improved.csv": improved})
    safety = pd.DataFrame({"run": ["hot", "scratch"], "worst": [level, 0.0], "worse": [0.5, 1.0]})
    save_stage(folder / "limits_safety", {}, {"safety.csv": safety})


def by_case(tabulated):
    """The tables of the section by their short names, each by case and controller, as far as it has these."""
    tables = {name.removeprefix("limits_"): table.rename(columns={"rival": "controller"}) for name, table in tabulated.items()}
    return {name: table.set_index([key for key in ("case", "controller") if key in table]) for name, table in tables.items()}


def test_nothing_where_it_was_not_run(results):
    assert [show(results(0)) for show in (limits_report.tabulate, limits_report.draw, limits_findings.find)] == [{}, {}, {}]


def test_one_seed_shows_its_monte_carlo_interval(results):
    found = by_case(limits_report.tabulate(results(1)))
    assert found["gaps"].loc["offset-free MPC"].tolist() == ["10.0 [9.0, 11.0]", "20.0 [19.0, 21.0]"]
    assert found["budget"].loc[("II", "PPO from scratch")].tolist() == ["1.00", "20.00"]
    worst = found["robustness"]["model"]
    assert (worst["I", "offset-free MPC"], worst["I", "PID (demonstrator)"]) == ("100", "100")
    assert found["errors"].loc[("I", "offset-free MPC")].to_dict() == {"IAE, $T^*$ (time)": "10.000"}
    numbers = {"Rise 10-90 %, $T^*$ (time)": "0.20", "Settling, 5 %, $T^*$ (time)": "–", "Offset, $T^*$ (%)": "1.2"}
    assert found["response"].loc[("I", "offset-free MPC"), list(numbers)].to_dict() == numbers
    assert found["response"].loc[("I", "PPO from scratch"), "Overshoot, $C_A^*$ (%)"] == "–"  # it never rises
    assert found["inputs"]["Harris index, $T^*$"].tolist() == ["0.90", "0.90"]
    known = found["attainable"]["$J$"]
    assert (len(known), known["II", "minimum variance on y"]) == (10, "18.00 [17.90, 18.10]")
    assert found["safety"].loc[("I", "hot start"), "Worst episode ($J$)"] == "10.0"
    assert found["pairs"].loc[("I", "PPO from scratch")].tolist() == ["14.00", "2.00"]


@pytest.mark.torture
def test_several_seeds_show_medians(results):
    found = by_case(limits_report.tabulate(results(3)))
    assert found["gaps"].loc["offset-free MPC"].tolist() == ["11.0", "21.0"]
    assert found["budget"].loc[("I", "PPO from scratch"), "least to greatest at the end"] == "10.00 to 12.00"
    figures = limits_report.draw(results(3))
    maps = [f"limits_{name}_case_{case}" for case in (1, 2) for name in ("model", "set_point")]
    assert set(figures) == {"limits_budget", "limits_gaps", "limits_robustness", *maps}
    assert limits_report.heat_map_names(results(3)) == maps
    for axes, level in zip(figures["limits_budget"].axes, (11.0, 21.0), strict=True):
        line = next(line for line in axes.lines if line.get_label() == "PPO from scratch")
        assert line.get_ydata().tolist() == [1.0, level]
    assert [axes.get_label() for axes in figures["limits_gaps"].axes] == ["A case 1", "B case 2"]
    first = {line.get_label(): sorted(line.get_xdata()) for line in figures["limits_robustness"].axes[0].lines[:-1]}
    assert first == {"model": [50.0, 100.0, 100.0], "set points": [40.0, 100.0, 120.0]}


TIMES = [([0.1, 0.2, 0.3, 0.4, None], "0.30 [0.10, –]"), ([0.1, 0.2, None, None, None], "–"), ([0.2] * 5, "0.20")]
TIMES += [([0.1, 0.2, None, None], "–")]  # one of the two in the middle never came there


@pytest.mark.parametrize(("times", "shown"), TIMES)
def test_what_a_seed_never_reached_counts_as_long(times, shown):
    rows = pd.DataFrame({"case": 1, "seed": range(len(times)), "controller": "mpc", "metric": "rise_time:T", "value": times})
    table = limits_report._quality(rows, limits_report.QUALITY["response"])
    assert table["Rise 10-90 %, $T^*$ (time)"].tolist() == [shown]


def test_what_several_seeds_say(results):
    """Improving on the plant reaches 10 to 14 in Case I and 20 to 24 in Case II; minimum variance has 15 there, the MPC 18."""
    assert limits_findings.there(results(4)) == {}  # too few for an interval
    behind = ["offset-free MPC", "minimum variance on y"]
    assert limits_findings.there(results(5)) == {"A x 1.3, B x 0.7": {1: behind, 2: []}}
    assert limits_findings.standings(results(1)) == {}
    assert limits_findings.standings(results(5)) == {0: {"ppo": {"ahead": [1, 2]}}, 500: {"ppo": {"ahead": [1, 2]}}}
    found = limits_findings.tuned(results(3))  # the searches for gains end at 5 to 7 in Case I, 10 to 12 in Case II, from 10
    assert found[1] == {"better": 0, "seeds": 3, "least": 5.0, "greatest": 6.0}
    assert found[2] == {"better": 1, "seeds": 3, "least": 10.0, "greatest": 11.0}


def test_what_one_seed_says(results):
    """With A doubled, or times 1.3 and B times 0.7, the inputs that hold the set point of Case II lie above their bounds."""
    run = results(1)
    assert limits_findings.left_out(run) == {"model": {2: (2, 3)}}
    assert limits_findings.out_of_reach(run) == {"A x 1.3, B x 0.7": [2]}
    kept = limits_report.worst(run).query("group == 'model'").set_index(["case", "controller"])["value"]
    assert (kept[1, "online"], kept[2, "online"]) == (50.0, 80.0)
    found = limits_findings.find(run)
    assert found["seeds"] == {1: 1, 2: 1}
    assert found["attainable"][2] == pytest.approx({"look_ahead": 1.0, "noise": 5.0, "filter": 2.5})
    assert found["agreement"] == pytest.approx(0.2)  # of the last grid only
    practice = {"with_model": pytest.approx({1: 150, 2: 100 * 18 / 22})}  # 18 against 12 and 22
    practice |= {"without_model": {500: {"PPO from scratch": [1, 2]}}, "budget": 500, "steady": ["IRL, then policy gradient"]}
    assert found["practice"] == practice | {"never_below": ["offset-free MPC"], "least": (40.0, 40.0), "kept": 0.9}
    assert found["not_found"] == {case: ["PPO from scratch ($C_A^*$)"] for case in (1, 2)}  # loops that it never found
    assert found["ranges"] == "A and B times 1 to 2 and 0.7 to 1; the set points of the two loops times 1.25 to 1.25 and 1 to 1"
    assert (found["price"][1]["worse"], found["price"][2]["model"]) == (50.0, 80.0)
    improved = by_case(limits_report.tabulate(run))["improved"]
    assert improved.loc[("II", "improved on that plant"), "A x 1.3, B x 0.7"] == "20.0"


def test_what_needs_no_plant(results):
    """Two seeds of notebook 09, three set points of notebook 07: medians, and shares of the PID that made the record."""
    shares = {"J(30)": [15.0, 16.0, 20.0], "share": [0.75, 0.8, 1.0], "set points, least": [0.5, 0.6, 1.0]}
    policies = pd.DataFrame({"controller": ["one_policy", "one_policy", "minimum_variance"], "case": 1, **shares})
    tank = pd.DataFrame({"controller": ["PID of the record"] * 2 + ["policy"] * 2, "mean |e|": [1.0, 3.0, 0.5, 1.5], "seed": 0})
    tank = tank.assign(movement=2.0, offset=[0.1, 0.2, 0.0, 0.01])
    run = results(1)
    run.one_policy, run.own_plant = policies.assign(**{"corners, least": float("nan")}), tank
    found = limits_report.without_the_plant(run)
    policy, least = found["one_policy"].to_numpy().tolist()
    assert policy == ["I", "one policy, through the model", "15.5", "78", "55", "–"]
    assert least == ["I", "minimum variance on y", "20.0", "100", "100", "–"]
    assert found["own_plant"].to_numpy().tolist() == [["PID of the record", "100", "100", "20.0"], ["policy", "50", "100", "1.0"]]
    run.one_policy = run.own_plant = pd.DataFrame()
    assert limits_report.without_the_plant(run) == {}


def test_the_section_of_the_template(results):
    """What the report says of the limits, from the template's own section."""
    text = (PROJECT / "reports/template/report.md.jinja").read_text(encoding="utf-8")
    start, end = text.index("## Which controller to take"), text.index("{% if one_policy | length %}\n\n## One policy")
    section = text[text.index("{% from") : text.index("{% set beta")] + "{% if limits %}" + text[start:end]
    template, run = typesetting.environment().from_string(section), results(1)
    found = limits_findings.find(run) | {"there": {"A x 1.3, B x 0.7": {1: ["offset-free MPC"], 2: []}}}
    shown = {"tables": limits_report.tabulate(run), "limits": found, "n_seeds": 1, "level_words": "95 %", "appendix": None}
    shown |= {"heat_maps": ["model_case_1", "set_point_case_2"], "grids": {"model": "m", "set_point": "s"}}
    rendered = typesetting.numbered(template.render(shown, rivals={}, one_policy=()))
    parts = ["10.0 [9.0, 11.0]", "](figures/limits_budget.svg)", "On the plant with A x 1.3, B x 0.7, by the whole interval"]
    parts += ["reaches\n  150.0 and 81.8 % of the objective of the best learner after 500 episodes in Case Studies"]
    parts += ["- all but offset-free MPC in Case Study I;\n- all controllers in Case Study II"]
    parts += ["in Case Study II (where no input within the bounds holds the set point)."]
    assert [part for part in parts if part not in rendered] == []
    assert template.render(limits={}).strip() == ""
