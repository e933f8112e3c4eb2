"""Refreshing the committed notebooks: new outputs in them, or, where a cell fails, not a byte of them changed."""

import nbformat
import pytest
from papermill.exceptions import PapermillExecutionError

from helpers.runs import refresh, run

CODE = "case = 1\n1 / {divisor}"


@pytest.fixture
def notebook(monkeypatch, tmp_path):
    """A notebook of one code cell, alone in a folder that stands for the project's; `write` writes it."""
    folder = tmp_path / "notebooks"
    folder.mkdir()
    path = folder / "02_offline_irl.ipynb"
    for module in (run, refresh):
        monkeypatch.setattr(module, "NOTEBOOKS", folder)
    monkeypatch.setattr(refresh, "PROJECT", tmp_path)
    monkeypatch.setattr(refresh, "make_inputs", lambda: None)
    monkeypatch.setenv("TQDM_DISABLE", "1")
    monkeypatch.setenv("MPLBACKEND", "agg")

    def write(divisor, *more):
        cell = nbformat.v4.new_code_cell(CODE.format(divisor=divisor), metadata={"tags": ["parameters"]})
        nbformat.write(nbformat.v4.new_notebook(cells=[*more, cell]), path)
        return path

    return write


def test_a_notebook_that_fails_stays_as_it_was_and_nothing_is_left_beside_it(notebook):
    path = notebook(divisor=0)
    before = path.read_bytes()
    with pytest.raises(PapermillExecutionError):
        refresh.main([])
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_notebook_that_succeeds_holds_its_outputs_and_no_mark_of_an_earlier_failure(notebook):
    """As papermill by hand leaves such marks, with a tag, by which papermill itself finds and drops them."""
    mark = nbformat.v4.new_markdown_cell("An Exception was encountered", metadata={"tags": ["papermill-error-cell-tag"]})
    path = notebook(2, mark)
    assert refresh.main([]) == 0
    (cell,) = nbformat.read(path, as_version=4).cells
    assert cell.outputs[0].data["text/plain"] == "0.5"
    assert list(path.parent.iterdir()) == [path]
