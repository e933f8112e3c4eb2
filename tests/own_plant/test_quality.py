"""Reading a historian file: every defect is found with its rows, repaired as stated and counted, or refused in one sentence."""

import re

import numpy as np
import pandas as pd
import pytest

from helpers.own_plant.description import load_description
from helpers.own_plant.records import read_records
from tests.own_plant.plants import MadeUpPlant, refusal

PLANT = MadeUpPlant(2, 2, n_cycles=15)
TABLE, TIME, START = PLANT.table, PLANT.table["TIME"], pd.Timestamp("2026-03-01")


@pytest.fixture
def clean(tmp_path, root):
    return lambda table, **changes: PLANT.examined(tmp_path, root, table, **changes)[0]


def found(clean, check, column=None):
    rows = [entry for entry in clean.findings if entry.check == check and column in (None, entry.column)]
    assert len(rows) == 1, [entry.check for entry in clean.findings]
    return rows[0]


def test_a_sound_file_is_left_as_it_is(clean):
    after = clean(TABLE)
    assert {entry.check for entry in after.findings} <= {"set point step", "input at a bound"}
    assert after.table["Y0.PV"].to_numpy() == pytest.approx(TABLE["Y0.PV"].to_numpy())
    assert after.table["segment"].eq(0).all()
    assert found(after, "set point step", "Y1.SP").rows[:2] == (22, 42)  # sample 20 stands in the file's row 22


@pytest.mark.parametrize("name", ["plant.csv", "plant.parquet"])
def test_parquet_and_stamps_with_a_zone_or_without_read_like_csv_and_numbers(clean, name):
    begin = pd.Timestamp("2026-10-25 00:50", tz="UTC")  # shortly before the clocks change
    stamps = begin + pd.to_timedelta(TIME, unit="s")
    words = stamps.dt.strftime("%Y-%m-%dT%H:%M:%S")
    local = stamps.dt.tz_convert("Europe/Berlin")
    expected = clean(TABLE).table
    for time in (TIME, stamps.dt.tz_localize(None), words + "Z", words + "+01:00", local):
        pd.testing.assert_frame_equal(clean(TABLE.assign(TIME=time), data=name).table, expected)


def test_a_short_gap_is_filled_and_a_long_one_ends_a_stretch(clean):
    after = clean(TABLE.drop(index=[30, 31, *range(100, 140)]))
    assert found(after, "short gap").count == 1
    assert list(after.section().columns) == ["check", "column", "count", "rows", "rule"]
    assert after.section().set_index("check").loc["short gap", "rows"] == "32"
    assert found(after, "long gap").rows == (2 + 140 - 42,)
    assert len(after.table) == len(TABLE) - 40
    assert after.table["U0.OP"][[30, 31]].tolist() == [TABLE["U0.OP"][29]] * 2  # an input is held
    assert after.table["row"][[29, 30, 31, 32]].tolist() == [31, 0, 0, 32]
    assert after.table["segment"].value_counts().to_dict() == {0: 100, 1: len(TABLE) - 140}


def test_doubled_late_and_unsorted_rows_find_their_place(clean):
    corrected = TABLE["Y0.PV"][59] + 0.02
    table = pd.concat([TABLE.iloc[:60], TABLE.iloc[59:60].assign(**{"Y0.PV": corrected}), TABLE.iloc[60:]])
    table = table.reset_index(drop=True)
    table.loc[100, "TIME"] += 0.5
    table.iloc[[200, 201]] = table.iloc[[201, 200]].to_numpy()
    after = clean(table)
    assert found(after, "doubled row").rows == (61,)
    assert after.table["Y0.PV"][59] == pytest.approx(corrected)
    assert found(after, "uneven time").count == 2
    assert found(after, "out of order").rows == (203,)
    assert after.table["U0.OP"].to_numpy() == pytest.approx(TABLE["U0.OP"].to_numpy())


def test_words_a_frozen_sensor_and_a_spike_are_repaired_and_inputs_at_bounds_and_manual_rows_kept(clean):
    table = TABLE.astype(object)
    table.loc[10:14, "U0.OP"] = PLANT.steady_u[0] + 3
    table.loc[40:49, "MODE"] = "MAN"
    table.loc[[50, 51], "Y0.PV"] = "I/O Timeout"
    table.loc[200:230, "Y1.PV"] = table.loc[200, "Y1.PV"]
    table.loc[310, "Y0.PV"] += 20
    after = clean(table)
    assert found(after, "no number").rows == (52, 53)
    assert found(after, "filled", "Y0.PV").count == 3  # on a line
    left, right = TABLE["Y0.PV"][[49, 52]]
    assert after.table["Y0.PV"][[50, 51]].tolist() == pytest.approx([left + (right - left) / 3, left + 2 * (right - left) / 3])
    assert found(after, "frozen sensor").count == 30
    assert found(after, "frozen sensor").rule == "10 or more equal values: all but the first missing"
    assert found(after, "outlier", "Y0.PV").rows == (312,)
    assert after.table["Y0.PV"][310] == pytest.approx(TABLE["Y0.PV"][[309, 311]].mean())
    assert after.table["segment"][[200, 201, 230, 231]].tolist() == [0, -1, -1, 1]
    assert found(after, "of no use").count == 30
    assert found(after, "input at a bound", "U0.OP").count >= 5
    assert found(after, "not in automatic").rows == (42, 43, 44, 45, 46)
    assert not after.table["automatic"][40:50].any()


def moved_by_hand(tau, noise, digit, hold, seed=0, n_samples=3000):
    """Rows of one output under PI control with set point steps, and moves by hand that last `hold` samples; no spike in it."""
    rng = np.random.default_rng(seed)
    x = integral = target = u = 0.0
    delayed, rows = [0.0, 0.0], []
    for t in range(n_samples):
        target = rng.uniform(-10, 10) if t % 200 == 0 else target
        y = digit * np.round((x + noise * rng.normal()) / digit)
        integral += 0.1 / tau * (target - y)
        if t % 200 < 180:
            u = 0.3 * (target - y) + integral
        elif t % hold == 0:
            u = integral + rng.uniform(-8, 8)
        delayed = [u, *delayed[:-1]]
        x += (1 - np.exp(-1 / tau)) * (delayed[-1] - x)
        rows.append([50 + y, 50 + target, 50 + u])
    return np.array(rows)


@pytest.mark.parametrize(
    ("tau", "noise", "digit", "hold"),
    [(0.3, 0.01, 1e-3, 1), (0.3, 0.01, 1e-3, 3), (2, 0.02, 1e-3, 4), (5, 0.002, 1e-3, 10), (2, 0.05, 0.5, 4), (8, 0.0, 1e-3, 20)],
)
def test_good_samples_are_no_outliers_and_spikes_are_found_in_moves_by_hand_too(clean, tau, noise, digit, hold):
    rows = moved_by_hand(tau, noise, digit, hold)
    single = {key: [PLANT.content[key][0] | {"low": -50.0, "high": 150.0}] for key in ("controlled", "manipulated")}
    table = pd.DataFrame(rows, columns=["Y0.PV", "Y0.SP", "U0.OP"]).assign(TIME=2.0 * np.arange(len(rows)), MODE="AUTO")
    assert not [entry for entry in clean(table, **single, pid=[]).findings if entry.check == "outlier"]
    struck = [150, 790, 1230, 1333, 1334, 1750, 2221, 2650]  # of which two lie side by side
    table.loc[struck, "Y0.PV"] += 80
    after = clean(table, **single, pid=[])
    assert found(after, "outlier").count == len(struck)
    assert after.table["segment"].eq(0).all()  # and no coarse signal is taken for a frozen one


def test_a_new_episode_ends_a_stretch_and_a_row_out_of_order_does_not(clean):
    table = TABLE.assign(RUN=np.where(TABLE.index < 77, "a", "b"))
    late = table.copy()
    late.iloc[[75, 80]] = late.iloc[[80, 75]].to_numpy()
    for given in (table, late):
        after = clean(given, episode="RUN")
        assert after.table["segment"].diff().fillna(0).ne(0).to_numpy().nonzero()[0].tolist() == [77]


@pytest.mark.parametrize(
    ("table", "changes", "says"),
    [
        (TABLE.drop(columns="Y0.PV"), {}, "'Y0.PV'; the columns are"),
        (TABLE.assign(**{"Y0.PV": "off"}), {}, "holds no number"),
        (TABLE.assign(**{"U0.OP": 20.0}), {}, "too little excitation"),
        (TABLE.assign(**{"U1.OP": TABLE["U0.OP"] + 1}), {}, "move as one"),
        (TABLE.assign(**{"U0.OP": TABLE["U0.OP"] / 100}), {}, "rows 2, 3.* looks like a share for per cent"),
        (TABLE.assign(**{"Y1.PV": TABLE["Y1.PV"] * 1.8 + 32}), {}, "rows 2, 3.* like degrees Fahrenheit for degrees Celsius"),
        (TABLE, {"sampling_time": 0.02}, "rows are 2 s apart, but 'sampling_time' is 0.02 s: .*, or 'time_unit', is wrong"),
        (TABLE, {"sampling_time": 20.0}, "rows are 2 s apart, but 'sampling_time' is 20 s: "),
        (TABLE.assign(TIME=START + pd.to_timedelta(TIME, unit="s")), {"time_unit": "min"}, "0.0333333 min apart, .* is 2 min: "),
        (TABLE.assign(TIME=5.0), {}, "'TIME': the time of all rows is the same"),
        (TABLE.assign(TIME=60.0 * (TIME // 60)), {"sampling_time": 60.0}, "97 % of the rows have the time of .* first is row 2"),
        (TABLE.assign(TIME=TIME + 0.9 * np.random.default_rng(0).integers(0, 2, len(TIME))), {}, "between two samples"),
        (TABLE.assign(TIME="yesterday"), {}, "no time in rows 2, 3"),
        (TABLE.iloc[:0], {}, "holds no rows"),
    ],
)
def test_what_no_rule_can_help_is_refused(clean, table, changes, says):
    assert re.search(says, refusal(clean, table, **changes))


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    description = load_description(PLANT.write(tmp_path))
    assert "is missing" in refusal(read_records, tmp_path / "plant.txt", description)
    (tmp_path / "plant.csv").write_text("TIME,Y0.PV\n1,2,3\n", encoding="utf-8")
    assert "not readable as CSV" in refusal(read_records, tmp_path / "plant.csv", description)
