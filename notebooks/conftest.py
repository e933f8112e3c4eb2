"""How nbval guards the notebooks: one thread, no progress bars, and numbers compared as numbers.

The rule, here as in the tests: what is compared digit by digit is a continuous function of its inputs at double precision, so that
another processor, which rounds otherwise, changes no digit shown. The end point of a search, a sort, a count over few samples and
what lies at a threshold are no such functions. They are compared by what they mean: a search by the loss that it reaches, a share
within its sampling error. A cell that shows the end of a search has the tag `search`: of its output only words and layout are
compared, and the notebook's checks say what the search must have reached.
"""

import json
import math
import os
import re
from pathlib import Path

import pytest

os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "TQDM_DISABLE": "1", "MPLBACKEND": "agg"}
os.environ.setdefault("PYTHONHASHSEED", "0")

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)
RELATIVE, ABSOLUTE = 1.2e-5, 1e-9  # the notebooks print six significant digits, the last of which may round either way
SEARCH = "search"  # the tag of cells that show where a search ended
FOUND = re.compile(rf"{NUMBER.pattern}|\b(?:yes|no|nan)\b", re.IGNORECASE)  # what may differ there
FEWEST_COMPARED = 6  # cells with outputs, in every notebook


class Output(str):
    """Text that equals another if its words do exactly and its numbers do within the tolerance; white space counts once.

    The stored outputs come from another machine, whose last digits may differ.
    """

    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        mine, its = str(self), str(other)
        if NUMBER.sub("#", mine).split() != NUMBER.sub("#", its).split():
            return False
        pairs = zip(NUMBER.findall(mine), NUMBER.findall(its), strict=True)
        return all(math.isclose(float(left), float(right), rel_tol=RELATIVE, abs_tol=ABSOLUTE) for left, right in pairs)

    def __ne__(self, other: object) -> bool:
        return not self == other


class Layout(str):
    """Text that equals another if its words do, and if numbers stand where numbers do."""

    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        return FOUND.sub("#", str(self)).split() == FOUND.sub("#", str(other)).split()

    def __ne__(self, other: object) -> bool:
        return not self == other


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Compare by `Output`, and refuse notebooks whose outputs were stripped: nbval would pass them unseen."""
    for notebook in {Path(item.path) for item in items if item.path.suffix == ".ipynb"}:
        check_executed(notebook)
    for item in items:
        if hasattr(item, "sanitize"):
            type(item).sanitize = _sanitize


def _sanitize(self: pytest.Item, text: object) -> object:
    kind = Layout if SEARCH in self.cell.metadata.get("tags", []) else Output
    return kind(text) if isinstance(text, str) else text


def check_executed(path: Path) -> None:
    """Every code cell of a notebook was executed, in order from 1, and enough of them have outputs to compare.

    Raises:
        pytest.UsageError: otherwise.
    """
    cells = [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    if [cell["execution_count"] for cell in cells] != list(range(1, len(cells) + 1)):
        raise pytest.UsageError(f"{path}: not every code cell was executed in order; run make notebooks")
    if sum(bool(cell["outputs"]) for cell in cells) < FEWEST_COMPARED:
        raise pytest.UsageError(f"{path}: fewer than {FEWEST_COMPARED} cells have outputs to compare; run make notebooks")
