"""The section of the report on limits: what it shows is what notebook 06 wrote, and it is not there where that was not run."""

from types import SimpleNamespace

import pandas as pd
import pytest
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from helpers import limits_report
from helpers.artifacts import load_stage, save_stage
from helpers.collection import LIMITS
from helpers.params import load
from helpers.report import stacked
from helpers.sources import PROJECT
from helpers.tables import to_markdown


@pytest.fixture
def results(root, tmp_path):
    def build(seeds, written=True):
        params = {case: load(root, case) for case in (1, 2)}
        limits = {}
        for case in params:
            for seed in range(seeds if written else 0):
                folder = tmp_path / f"seed_{seed}/case_{case}"
                write(folder, 10.0 * case + seed)
                limits |= {(case, seed, part): load_stage(folder / f"limits_{part}", "notebook 06") for part in LIMITS}
        return SimpleNamespace(params=params, limits=limits)

    return build


def write(folder, level):
    """What notebook 06 writes, in small: the gap of the MPC and every other number follow from `level`."""
    names = ["expert", "mpc", "minimum_variance", "minimum_variance_filtered", "irl_reinforce", "dynamic_programme"]
    objectives, below = [10.0, 19.0, 18.0, 18.5, level, 20.0], [50.0, level, 10.0, 7.5, 8.0, 0.0]
    gaps = pd.DataFrame({"beta": 30.0, "controller": names, "objective": objectives, "gap": below})
    gaps = gaps.assign(gap_low=gaps["gap"] - 1, gap_high=gaps["gap"] + 1, low=0.0, high=0.0)
    save_stage(folder / "limits_attainable", {}, {"gaps.csv": gaps})
    curves = pd.DataFrame({"learner": ["mpc", "ppo", "ppo"], "episodes": [0, 0, 500], "objective": [19.0, 1.0, level]})
    objectives = {"0": [19.0, 1.0, 15.0], "500": [19.0, level, level + 2]}
    budget = pd.DataFrame({"learner": ["mpc", "ppo", "irl_reinforce"], **objectives})
    save_stage(folder / "limits_budget", {}, {"curves.csv": curves, "budget.csv": budget})
    values = {"iae:T": level, "settling_time_5:T": None, "offset:T": 0.012, "overshoot_single:T": 0.1, "harris:T": 0.9}
    quality = pd.DataFrame({"controller": "mpc", "figure": list(values), "value": list(values.values())})
    save_stage(folder / "limits_quality", {}, {"quality.csv": quality})
    there = (("expert", 10.0, 10.0), ("mpc", 10.0, 20.0), ("online", 8.0, 16.0))
    cells = [("model", row, "1", name, values[int(row) - 1]) for row in "12" for name, *values in there]
    robust = pd.DataFrame(cells, columns=["group", "row", "column", "controller", "objective"]).assign(standard_error=0.0)
    there = {"expert": 1.0, "minimum_variance": 15.0, "online_there": level}
    improved = pd.DataFrame({"state": 1.3, "input": 0.7, "controller": list(there), "objective": list(there.values())})
    save_stage(folder / "limits_robustness", {}, {"robustness.csv": robust, "improved.csv": improved})
    safety = pd.DataFrame({"run": ["hot", "scratch"], "worst": [level, 0.0], "worse": [0.5, 1.0]})
    save_stage(folder / "limits_safety", {}, {"safety.csv": safety})


def test_nothing_where_it_was_not_run(results):
    assert limits_report.tabulate(results(1, written=False)) == {}
    assert limits_report.draw(results(1, written=False)) == {}
    assert limits_report.answers(results(1, written=False)) == {}


def test_one_seed_shows_its_monte_carlo_interval(results):
    found = limits_report.tabulate(results(1))
    gaps = found["limits_gaps"].set_index("controller")
    assert gaps.loc["offset-free MPC"].tolist() == ["10.0 [9.0, 11.0]", "20.0 [19.0, 21.0]"]
    budget = found["limits_budget"].set_index(["case", "controller"])
    assert budget.loc[("II", "PPO from scratch")].tolist() == ["1.00", "20.00"]
    worst = found["limits_robustness"].set_index(["case", "controller"])["model"]
    assert (worst["I", "offset-free MPC"], worst["I", "PID (demonstrator)"]) == ("100", "100")
    assert found["limits_errors"].iloc[0].to_dict() == {"case": "I", "controller": "offset-free MPC", "IAE, $T^*$ (time)": "10.000"}
    response = {"Settling, 5 %, $T^*$ (time)": "–", "Offset, $T^*$ (%)": "1.2"}
    assert found["limits_response"].iloc[0].to_dict() == {"case": "I", "controller": "offset-free MPC"} | response
    assert found["limits_inputs"]["Harris index, $T^*$"].tolist() == ["0.90", "0.90"]
    assert found["limits_safety"].set_index(["case", "controller"]).loc[("I", "hot start"), "Worst episode ($J$)"] == "10.0"


def test_several_seeds_show_medians(results):
    found = limits_report.tabulate(results(3))
    assert found["limits_gaps"].set_index("controller").loc["offset-free MPC"].tolist() == ["11.0", "21.0"]
    figures = limits_report.draw(results(3))
    assert set(figures) == {f"limits_{name}_case_{case}" for name in ("budget", "gaps", "model") for case in (1, 2)}
    line = next(line for line in figures["limits_budget_case_1"].axes[0].lines if line.get_label() == "PPO from scratch")
    assert line.get_ydata().tolist() == [1.0, 11.0]


@pytest.mark.parametrize(
    ("times", "shown"),
    [
        ([0.1, 0.2, 0.3, 0.4, None], "0.30 [0.10, –]"),
        ([0.1, 0.2, None, None, None], "–"),
        ([0.1, 0.2, None, None], "–"),  # one of the two in the middle never came there
        ([0.2] * 5, "0.20"),
    ],
)
def test_what_a_seed_never_reached_counts_as_long(times, shown):
    rows = pd.DataFrame({"case": 1, "seed": range(len(times)), "controller": "mpc", "metric": "rise_time:T", "value": times})
    table = limits_report._quality(rows, limits_report.QUALITY["response"])
    assert table["Rise 10-90 %, $T^*$ (time)"].tolist() == [shown]


def test_the_papers_way_beside_its_rivals(results):
    pairs = limits_report.tabulate(results(1))["limits_pairs"].set_index(["case", "rival"])
    assert pairs.loc[("I", "PPO from scratch")].tolist() == ["14.00", "2.00"]
    assert limits_report.standings(results(1)) == {}
    assert limits_report.standings(results(5)) == {0: {"ppo": {"ahead": [1, 2]}}, 500: {"ppo": {"ahead": [1, 2]}}}


def test_the_plants_that_were_improved_on(results):
    improved = limits_report.tabulate(results(1))["limits_improved"].set_index(["case", "controller"])
    assert improved.loc[("II", "improved on that plant"), "A x 1.3, B x 0.7"] == "20.0"


def test_where_improving_on_the_plant_beats_a_wrong_model(results):
    assert limits_report.improved_there(results(1, written=False)) == {}
    assert limits_report.improved_there(results(4)) == {}  # too few for an interval
    assert limits_report.improved_there(results(5)) == {"A x 1.3, B x 0.7": [2]}  # 20 to 24 in Case II, 10 to 14 in Case I


def test_what_a_practitioner_reads(results):
    found = limits_report.answers(results(3))
    assert "after 500 episodes IRL, then REINFORCE is best, $J$ = 13.0" in found[1]
    assert "passes offset-free MPC at none of these budgets" in found[1]
    assert "passes offset-free MPC from 500 episodes on" in found[2]


def test_with_seeds_enough_only_whole_intervals_count(results):
    """Of seeds 0 to 4 the paper's way ends at 12 to 16 in Case I and at 22 to 26 in Case II, PPO two below it, the MPC has 19."""
    found = limits_report.answers(results(5))
    assert "after 500 episodes IRL, then REINFORCE, $J$ = 14.0 (ahead of all others)" in found[1]
    assert "by the whole interval: after 500 none." in found[1]
    assert "by the whole interval: after 500 IRL, then REINFORCE, PPO from scratch." in found[2]


def test_learners_that_cannot_be_told_apart():
    own = pd.DataFrame({"seed": range(5), "controller": "mpc", "objective": 1.0, "gap": 0.0})
    others = ["expert", "minimum_variance", "minimum_variance_filtered"]
    own = pd.concat([own, *(own.assign(controller=name) for name in others)])
    rows = [(seed, name, value + seed) for seed in range(5) for name, value in (("ppo", 2.0), ("scratch_reinforce", 1.0 + seed))]
    listed = pd.DataFrame(rows, columns=["seed", "learner", 100]).set_index(["seed", "learner"])
    told = limits_report._answer_over_seeds(own, listed)
    assert "after 100 episodes REINFORCE from scratch, $J$ = 5.0 (not to be told apart from PPO from scratch)" in told


def test_the_ranges_of_the_grids(results):
    assert limits_report.ranges(results(1, written=False)) == ""
    assert limits_report.ranges(results(1)) == "A and B times 1 to 2 and 1 to 1"


def test_the_price_of_improving(results):
    assert limits_report.price(results(1, written=False)) == {}
    found = limits_report.price(results(1))
    assert found[1]["worse"] == 50.0
    assert found[2]["model"] == 80.0


def test_the_section_of_the_template(results):
    text = (PROJECT / "reports/template/report.md.jinja").read_text(encoding="utf-8")
    start = text.index("{% if tables.limits_gaps is defined %}")
    section = text[start : text.index("{% if benchmarks %}", start)]
    environment = Environment(loader=FileSystemLoader("."), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"table": to_markdown, "numeral": lambda case: "I" * case, "stacked": stacked}
    environment.globals["studies"] = lambda cases: " and ".join("I" * case for case in cases)
    run = results(1)
    shown = {"tables": limits_report.tabulate(run), "answers": limits_report.answers(run), "cases": run.params, "n_seeds": 1}
    shown |= {"standings": limits_report.standings(run), "fewest": 5, "ranges": limits_report.ranges(run)}
    shown |= {"improved_there": {"A x 1.3, B x 0.7": [2]}}
    rendered = environment.from_string(section).render(shown)
    assert "10.0 [9.0, 11.0]" in rendered
    assert "figures/limits_budget_case_2.svg" in rendered
    assert "- A x 1.3, B x 0.7: II\n" in rendered
    assert environment.from_string(section).render(tables={}, cases=run.params, n_seeds=1).strip() == ""
