"""Runs that survive: a full disk, a read-only folder, a closed network, one seed that fails; `torture.torture` kills them."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest

from helpers.runs.artifacts import load_stage
from torture import cluster
from torture.kills import strike, undisturbed
from torture.runs import Place

STAGE = "results/smoke/seed_{}/case_{}/{}/record.json"
SMALL = (STAGE.format(0, 2, "online_improved"), STAGE.format(0, 1, "demonstrations"))  # three stages in a row, and one beside
CLOSED = '''
"""Every way out of this machine by Python's sockets is noted and closed."""
import os, socket

def note(*what, **_):
    with open(os.environ["NETWORK_LOG"], "a") as file:
        print(*what, file=file)
    raise OSError("the network is closed")

def guarded(connect):
    return lambda self, address: connect(self, address) if self.family == socket.AF_UNIX else note(address)

socket.socket.connect, socket.socket.connect_ex = guarded(socket.socket.connect), guarded(socket.socket.connect_ex)
socket.getaddrinfo = socket.gethostbyname = note
'''


def allowed(*command):
    """Whether the system lets us do something."""
    return bool(shutil.which(command[0])) and subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """The environment of a process that can reach no network, the command that takes its interfaces away, and the log of tries."""
    folder = tmp_path_factory.mktemp("closed")
    (folder / "sitecustomize.py").write_text(CLOSED, encoding="utf-8")
    prefix = ("unshare", "--net") if allowed("unshare", "--net", "true") else ()
    return {"PYTHONPATH": str(folder), "NETWORK_LOG": str(folder / "log")}, prefix, folder / "log"


@pytest.fixture(scope="module")
def small(tmp_path_factory, closed):
    """A small run, and what it makes undisturbed and without a network."""
    place, (environment, prefix, _) = Place.copied(tmp_path_factory.mktemp("survival") / "project", targets=SMALL), closed
    return place, undisturbed(place, prefix=prefix, **environment)[0]


@pytest.mark.torture
def test_nothing_reaches_the_network_while_notebooks_run(small, closed):
    (_, expected), (environment, _, log) = small, closed
    assert len(expected) == 4
    assert not log.exists(), log.read_text()
    tried = [sys.executable, "-c", "import urllib.request; urllib.request.urlopen('http://192.0.2.1/')"]  # the guard does its work
    assert subprocess.run(tried, env=os.environ | environment, capture_output=True, check=False).returncode == 1
    assert "192.0.2.1" in log.read_text()


def test_a_strike_that_finds_nobody_is_no_kill():
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        assert [strike(gone.pid, kind, 0.5, []) for kind in ("group", "engine", "kernel")] == [None] * 3


@pytest.mark.torture
def test_one_seed_that_fails_stops_no_other_and_is_named_once(small, tmp_path):
    place, expected = small
    targets = tuple(STAGE.format(seed, 2, "offline_improved") for seed in (0, 1))
    broken = replace(Place.copied(tmp_path / "project"), seeds=2, targets=targets)
    shutil.copytree(place.project / "results", broken.project / "results")
    path = broken.project / "notebooks/02_offline_irl.ipynb"
    notebook = path.read_text(encoding="utf-8")
    cell = '"demonstrations = session.load_demonstrations()\\n",'
    assert notebook.count(cell) == 1
    path.write_text(notebook.replace(cell, f"{cell}\n    \"assert seed != 1, 'this seed fails'\\n\","), encoding="utf-8")
    with (tmp_path / "said").open("wb") as output:
        assert broken.start(output=output).wait() != 0
    said, _, summary = (tmp_path / "said").read_text(encoding="utf-8").partition("1 notebook(s) failed")
    assert "again: 02_offline_irl, 1 result(s); changed: notebooks/02_offline_irl.ipynb" in said
    copy = "results/smoke/seed_1/case_2/notebooks/02_offline_irl_improved.ipynb"
    assert (summary.count("AssertionError: this seed fails"), copy in summary) == (1, True)
    assert "assert seed != 1" in (broken.project / copy).read_text(encoding="utf-8")
    content = broken.content()
    assert content["seed_0/case_2/offline_improved"][0] == expected["seed_0/case_2/offline_improved"][0]
    assert sorted(name for name in content if name.startswith("seed_1")) == ["seed_1/case_2/demonstrations"]


@pytest.fixture
def disk(tmp_path):
    """A disk of 200 kB, and a function that mounts it anew with other options."""
    if not allowed("mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(tmp_path)):
        pytest.skip("a small disk needs the right to mount one")

    def again(options):
        subprocess.run(["mount", "-o", f"remount,{options}", str(tmp_path)], check=True)

    yield tmp_path, again
    subprocess.run(["umount", "-l", str(tmp_path)], check=True)


def record(folder):
    """Notebook 01 for case 2 with results in `folder`: the exit status and what it said."""
    given = ["-p", "case", "2", "-p", "scale", "smoke", "-p", "output_root", str(folder)]
    command = [sys.executable, "-m", "helpers", "run", "01_demonstrations", str(folder / "01.ipynb"), *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr.strip()


@pytest.mark.torture
def test_a_full_disk_and_a_read_only_one_end_in_a_sentence_and_the_run_resumes(small, disk):
    (_, expected), (folder, again) = small, disk
    files = expected["seed_0/case_2/demonstrations"][0]
    for options, cause in (("size=200k", "No space left on device"), ("ro,size=20m", "Read-only file system")):
        again(options)
        status, said = record(folder)
        assert (status, "Traceback" in said) == (1, False)
        assert re.fullmatch(f"error: 01_demonstrations case=2 scale=smoke: .*{cause}.*", said.splitlines()[-1])
        again("rw,size=20m")
        assert list(folder.rglob("record.json")) == []
    assert record(folder) == (0, "")
    assert load_stage(folder / "smoke/seed_0/case_2/demonstrations", "01").record["files"] == files
    assert [path.name for path in folder.rglob(".*")] == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_the_right_to_write_ends_in_a_sentence(tmp_path):
    tmp_path.chmod(0o500)
    status, said = record(tmp_path)
    assert (status, "Permission denied" in said.splitlines()[-1]) == (1, True)


def test_where_slurm_is_not_to_be_had_the_script_says_so(monkeypatch, capsys):
    monkeypatch.setattr(cluster.shutil, "which", lambda _: None)
    assert [cluster.main(arguments) for arguments in ([], ["--required"])] == [0, 1]
    assert capsys.readouterr().out.startswith("SKIPPED: the run through SLURM: ")


def test_the_slurm_profiles_differ_from_the_local_one_in_nothing_but_the_cluster(root):
    yaml = pytest.importorskip("yaml")
    places = (root.parent / "profiles" / name for name in ("local", "slurm/with_accounting", "slurm/without_accounting"))
    local, *others = (yaml.safe_load((place / "config.yaml").read_text(encoding="utf-8")) for place in places)
    assert [other for other in others if not local.items() <= other.items()] == []
