"""Files of other programs and countries: how they are written and how they tell the time is found, or named in one sentence."""

import numpy as np
import pandas as pd
import pytest

from helpers.own_plant.description import load_description
from helpers.own_plant.records import read_records
from tests.own_plant.plants import MadeUpPlant, refusal

PLANT = MadeUpPlant(1, 1, n_cycles=15)  # 600 rows
MINUTES = {"time_unit": "min", "sampling_time": 20.0}
STAMPS = pd.Timestamp("2026-01-03 22:00") + pd.to_timedelta(20 * np.arange(len(PLANT.table)), unit="min")  # nine days


@pytest.fixture
def read(tmp_path):
    def found(text, written_in="utf-8", **changes):
        description = load_description(PLANT.write(tmp_path, **changes))
        (tmp_path / "plant.csv").write_bytes(text.encode(written_in))
        return read_records(tmp_path / "plant.csv", description)

    return found


def stamped(stamps):
    return PLANT.table.assign(TIME=stamps).to_csv(index=False)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ","), ("\t", ","), (";", "."), ("|", "."), (",", ",")])
def test_a_file_of_another_country_reads_like_any_other(read, separator, decimal, encoding):
    table = PLANT.table.assign(**{"Kühler, °C": "heiß"})
    text = table.to_csv(index=False, sep=separator, decimal=decimal)
    expected = read(PLANT.table.to_csv(index=False)).table
    pd.testing.assert_frame_equal(read(text, encoding).table, expected)
    said = {"separator": {"\t": "tab"}.get(separator, separator), "decimal": decimal, "encoding": encoding}
    pd.testing.assert_frame_equal(read(text, encoding, **said).table, expected)


def test_words_among_decimal_commas_are_missing_and_no_other_value_is(read):
    text = PLANT.table.to_csv(index=False, sep=";", decimal=",").splitlines()
    cells = text[51].split(";")
    text[51] = ";".join([cells[0], "Störung", *cells[2:]])
    after = read("\n".join(text), "latin-1")
    assert [(entry.check, entry.rows) for entry in after.findings] == [("no number", (52,))]
    assert after.table["Y0.PV"].drop(50).to_numpy() == pytest.approx(PLANT.table["Y0.PV"].drop(50).to_numpy())


def test_what_is_said_wrongly_about_a_file_is_named_with_its_key(read):
    text = PLANT.table.assign(Ort="Köln").to_csv(index=False, sep=";", decimal=",")
    assert "'encoding' utf-8" in refusal(read, text, "latin-1", encoding="utf-8")
    assert "'separator'" in refusal(read, text, separator=",")
    assert "'separator'" in refusal(read, "a;b\n1;2\n", separator="|")
    assert "'decimal'" in refusal(read, text, decimal=".")
    dated = PLANT.table.assign(TIME=STAMPS).to_csv(index=False, sep=";", decimal=",")
    assert "holds no number, the first is '50,006" in refusal(read, dated, decimal=".", **MINUTES)


FORMS = ["%d/%m/%Y %H:%M", "%m/%d/%Y %H:%M", "%Y/%m/%d %H:%M", "%d.%m.%Y %H:%M:%S", "%d-%m-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S"]
FORMS += ["%m/%d/%Y %I:%M:%S %p", "%d/%m/%Y %H:%M:%S,000", "%d/%m/%Y %H:%M +01:00", "%H:%M:%S", "%I:%M %p"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("later", [0, 7], ids=["days to 12", "days beyond"])
def test_day_and_month_are_told_apart_and_midnight_begins_a_day(read, form, later):
    clock = read(stamped((STAMPS + pd.Timedelta(days=later)).strftime(form)), **MINUTES).table["clock"]
    assert clock.to_numpy() == pytest.approx(np.arange(len(PLANT.table)))


def test_a_day_a_row_is_told_from_a_month_a_row(read):
    days = pd.date_range("2026-02-01", periods=12)
    text = PLANT.table.head(12).assign(TIME=days.strftime("%d/%m/%Y")).to_csv(index=False)
    assert read(text, time_unit="h", sampling_time=24.0).table["clock"].tolist() == list(range(12))


def test_a_late_row_at_midnight_begins_no_day(read):
    clock = STAMPS.strftime("%H:%M").to_numpy().copy()
    clock[[5, 6]] = clock[[6, 5]]  # 23:40 after 00:00
    found = read(stamped(clock), **MINUTES)
    assert [entry.check for entry in found.findings] == ["out of order"]
    assert found.table["clock"].to_numpy() == pytest.approx(np.arange(len(PLANT.table)))


def test_stamps_read_as_their_format_says(read):
    for form in ("%Y%m%d%H%M%S", "%H%M%S", "%d/%m/%Y %H:%M"):
        assert read(stamped(STAMPS.strftime(form)), time_format=form, **MINUTES).table["clock"].iloc[-1] == 599
    wrong = stamped(STAMPS.strftime("%d/%m/%Y %H:%M"))
    assert "no time in rows 2, 3" in refusal(read, wrong, time_format="%d.%m.%Y %H:%M")
    assert "'time_format' %Q" in refusal(read, wrong, time_format="%Q")


def test_stamps_that_read_both_ways_or_go_back_for_no_reason_are_refused(read):
    both = PLANT.table.head(3).assign(TIME=["01/02/2026", "02/03/2026", "04/03/2026"]).to_csv(index=False)
    assert "'time_format'" in refusal(read, both)
    back = STAMPS.strftime("%H:%M").to_numpy().copy()
    back[30:] = np.roll(back, 20)[30:]
    assert "no date and goes back by 6.3 h in row 32" in refusal(read, stamped(back), **MINUTES)
    assert "no time in rows 2, 3, 4, 5, 6 and more (keys 'time_format'" in refusal(read, stamped("gestern"))
