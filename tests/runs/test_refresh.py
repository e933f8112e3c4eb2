"""Refreshing the committed notebooks: new outputs in them, or, where a cell fails, not a byte of them changed."""

import nbformat
import pytest
from papermill.exceptions import PapermillExecutionError

from helpers.runs import refresh
from tests.runs.test_run import here, toy  # noqa: F401  (fixtures)


@pytest.fixture
def notebook(monkeypatch, toy):  # noqa: F811
    """Writes a notebook that is alone in a folder that stands for the project's."""
    path = toy("")
    for name, value in (("NOTEBOOKS", path.parent), ("PROJECT", path.parents[1]), ("make_inputs", lambda: None)):
        monkeypatch.setattr(refresh, name, value)
    return toy


def test_a_notebook_that_fails_stays_as_it_was_and_nothing_is_left_beside_it(notebook):
    path = notebook("1 / 0")
    before = path.read_bytes()
    with pytest.raises(PapermillExecutionError):
        refresh.main([])
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_notebook_that_succeeds_holds_its_outputs_and_no_mark_of_an_earlier_failure(notebook):
    """As papermill by hand leaves such marks, with a tag, by which papermill itself finds and drops them."""
    mark = nbformat.v4.new_markdown_cell("An Exception was encountered", metadata={"tags": ["papermill-error-cell-tag"]})
    path = notebook("1 / 2", mark)
    assert refresh.main([]) == 0
    _, cell = nbformat.read(path, as_version=4).cells
    assert cell.outputs[0].data["text/plain"] == "0.5"
    assert list(path.parent.iterdir()) == [path]
