"""What the targets of the Makefile would run."""

import os
import shutil
import subprocess

import pytest

from helpers.runs.sources import PROJECT

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not to be had")


@pytest.fixture
def dry_make(tmp_path):
    """The commands that a target would run in a copy, where everything is installed unless a file of .venv is removed."""
    for name in ("Makefile", "environment.txt", "pyproject.toml"):
        shutil.copy(PROJECT / name, tmp_path)
    (tmp_path / ".venv").mkdir()
    for name in ("installed", "alternatives"):
        (tmp_path / ".venv" / name).touch()

    def commands(target, *words, **environment):
        clean = {name: value for name, value in os.environ.items() if name not in ("SEEDS", "MAKEFLAGS", "MAKELEVEL")}
        make = ["make", "--dry-run", target, *words]
        return subprocess.run(make, cwd=tmp_path, env=clean | environment, capture_output=True, text=True, check=True).stdout

    return commands


@pytest.mark.parametrize(("target", "default"), [("reports", 1), ("evidence", 20)])
def test_the_number_of_seeds_is_that_of_the_command_line_the_environment_or_the_default(dry_make, target, default):
    assert f" seeds={default} " in dry_make(target)
    assert " seeds=3 " in dry_make(target, SEEDS="3")
    assert " seeds=4 " in dry_make(target, "SEEDS=4", SEEDS="3")


def test_a_resumed_run_installs_nothing_and_so_needs_no_network(dry_make, tmp_path):
    assert "pip" not in dry_make("evidence")
    (tmp_path / ".venv/alternatives").unlink()
    assert dry_make("evidence").count("pip install") == 1
    assert "pip" not in dry_make("reports")
    (tmp_path / "environment.txt").touch()
    assert dry_make("evidence").count("pip install") == 3
