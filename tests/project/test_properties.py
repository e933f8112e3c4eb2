"""Mutated parameter files, artifacts and tables: a correct load or one sentence that names the file, never anything else.

CASES in the environment says how many (60 by default; `make torture` asks for 5,000).
"""

import copy
import hashlib
import io
import json
import math
import os
import pickle
import re
import shutil
import time
from functools import cache, reduce
from operator import getitem

import pandas as pd
import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers.own_plant.settings import load_own_plant
from helpers.own_plant.tank import load_tank
from helpers.plant.rollout import rollout, stream
from helpers.report.claims import load_claims
from helpers.runs import identity
from helpers.runs.artifacts import load_stage, save_stage, trajectories_from_table, trajectories_to_table
from helpers.runs.sources import PROJECT
from helpers.settings.evidence import load_experiments, load_identification
from helpers.settings.leaf import InputError, read_yaml
from helpers.settings.limits import load_limits
from helpers.settings.one_policy import load_one_policy
from helpers.settings.paper import load, load_published
from helpers.settings.search import load_search
from tests.runs.test_artifacts import NAMES, Bomb

CASES = int(os.environ.get("CASES", "60"))
SLOWEST = 20.0  # seconds of the processor: what takes longer hangs
PARAMS = PROJECT / "params"
FILES = sorted(path.name for path in PARAMS.glob("*.yaml"))
CASE_OF = {"02": 1, "04": 3, "05": None, "06": 1, "07": 1, "08": 2, "09": 1}  # with which these notebooks are run
NOTEBOOKS = {path.stem: CASE_OF[path.stem[:2]] for path in (PROJECT / "notebooks").glob("*.ipynb") if path.stem[:2] in CASE_OF}


def some(share):
    """Settings for a share of all cases."""
    fixed = {"deadline": None, "database": None, "derandomize": True, "suppress_health_check": [*HealthCheck]}
    return settings(max_examples=math.ceil(share * CASES), **fixed)


def outcome(action, *names):
    """Run a loader: it returns, or raises an InputError of one line that holds one of the names; and it ends soon."""
    began = time.process_time()
    try:
        return action()
    except InputError as error:
        sentence = str(error)
        assert "\n" not in sentence
        assert len(sentence) < 2000
        assert any(name in sentence for name in names), sentence
        return None
    finally:
        assert time.process_time() - began < SLOWEST


FEW = st.integers(0, 9)
NUMBERS = st.sampled_from([0, -1, 1, 2, 10**400, -0.0, 1e308, 1e-308, math.nan, math.inf, -math.inf, 2**63])
SCALARS = st.none() | st.booleans() | NUMBERS | st.integers(-9, 9) | st.floats(width=32) | st.text(max_size=8) | st.dates()
KEYS = st.text(max_size=5) | st.integers(0, 3)
ANYTHING = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=3), max_leaves=6)
BOMB = "\n".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9) if n else 'x'}]" for n in range(30))
LINES = ["!!python/object/apply:os.system ['touch exploded']", "extra: !!python/object/new:os.system ['touch exploded']"]
LINES += ["extra: !!python/name:os.system", "extra: !unknown x", "extra: &a [*a]", "extra: {<<: *nowhere}", "extra: 1\nextra: 2"]
LINES += [f"extra: {'[' * 3000}", "? [a, b]\n: c", "--- second document", "\t- tab", "extra: \x07", "extra: 0x1F", BOMB]
DTYPES = st.sampled_from([torch.float32, torch.float64])
CELLS = st.floats() | st.integers() | st.text(max_size=5) | st.none() | st.booleans() | st.sampled_from(["1e999", "0x1", "1_000"])


def nodes(content, path=()):
    """The path of every entry of nested dictionaries and lists."""
    entries = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, entry in entries:
        yield (*path, key)
        yield from nodes(entry, (*path, key))


@st.composite
def parameter_files(draw):
    """A file's name and its mutated bytes."""
    name = draw(st.sampled_from(FILES))
    text = (PARAMS / name).read_text(encoding="utf-8")
    kind = draw(st.sampled_from(["value", "value", "value", "delete", "rename", "swap", "cut", "noise", "line"]))
    if kind in ("value", "delete", "rename", "swap"):
        content = read_yaml(PARAMS / name)
        places = sorted(nodes(content), key=str)
        *path, last = draw(st.sampled_from(places))
        parent = reduce(getitem, path, content)
        if kind == "value":
            parent[last] = draw(ANYTHING)
        elif kind == "swap":
            parent[last] = copy.deepcopy(reduce(getitem, draw(st.sampled_from(places)), content))
        else:
            value = parent.pop(last)
            if kind == "rename" and isinstance(parent, dict):
                parent[draw(st.text(max_size=6))] = value
        return name, yaml.safe_dump(content, allow_unicode=True, sort_keys=False).encode()
    raw = text.encode()
    place = draw(st.integers(0, len(raw)))
    if kind == "cut":
        return name, raw[:place]
    if kind == "noise":
        return name, raw[:place] + draw(st.binary(max_size=6)) + raw[place + draw(st.integers(0, 6)) :]
    lines = text.splitlines()
    lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(LINES)))
    return name, "\n".join(lines).encode()


def load_everything(root):
    """Every loader of parameter files, as the notebooks use them."""
    params = {case: load(root, case) for case in (1, 2, 3)}
    for load_whole in (load_published, load_claims, load_search, load_own_plant):
        load_whole(root)
    for load_for in (load_experiments, load_identification, load_limits, load_one_policy):
        load_for(root, params[1])
    load_tank(root, params[1].process)
    for notebook, case in NOTEBOOKS.items():
        identity.inputs(notebook, root, "smoke", case)


@pytest.fixture
def same_versions(monkeypatch):
    """What is installed does not depend on the files, and to ask for it again and again takes longer than all loaders."""
    monkeypatch.setattr(identity, "versions", cache(identity.versions))


@pytest.mark.usefixtures("same_versions")
@some(0.4)
@given(mutated=parameter_files())
def test_mutated_parameter_files(tmp_path, monkeypatch, mutated):
    monkeypatch.chdir(tmp_path)
    folder = shutil.copytree(PARAMS, tmp_path / "params", dirs_exist_ok=True)
    name, raw = mutated
    (folder / name).write_bytes(raw)
    outcome(lambda: load_everything(folder), *(f"{folder / file}: " for file in FILES))
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.usefixtures("same_versions")
def test_every_file_is_among_those_that_are_loaded(root, tmp_path, name):
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    path = tmp_path / name
    leaf = "extra: {value: 1, unit: '-', source: made up, status: assumed}\n"
    path.write_text(leaf + path.read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(f"{path}: ")):
        load_everything(tmp_path)


PICKLED = io.BytesIO()
torch.save({"a": Bomb()}, PICKLED)
PICKLES = [pickle.dumps(Bomb()), PICKLED.getvalue()]
FORGED = st.sampled_from([b"", b"{}", b"null", *PICKLES, b"\x93NUMPY\x01\x00", bytes(range(256))])
STAGE_FILES = ["record.json", "table.csv", "policy.safetensors"]
ENTRIES = st.dictionaries(st.sampled_from(["files", "seed", "inputs", "upstream"]), ANYTHING, max_size=4)
RECORDS = (ENTRIES | ANYTHING).map(lambda record: json.dumps(record, default=str).encode())


@pytest.fixture(scope="module")
def stage_of(tmp_path_factory, study):
    """A stage with a table and a policy, and a function that reads all of it."""
    case = study(1, torch.float32)
    folder = tmp_path_factory.mktemp("results") / "stage"
    table = pd.DataFrame({"stage": ["a", "b"], "metric": ["c", "d"], "value": [0.1, math.nan]})
    save_stage(folder, {"seed": 1}, {"table.csv": table}, case.policy())

    def read():
        stage = load_stage(folder, "notebook 02")
        stage.table("table.csv", ("stage", "metric", "value"))
        return stage.policy(case.params.learning, case.task)

    return folder, {name: (folder / name).read_bytes() for name in STAGE_FILES}, read


@some(0.35)
@given(data=st.data(), name=st.sampled_from(STAGE_FILES), sealed=st.booleans())
def test_mutated_artifacts(stage_of, monkeypatch, data, name, sealed):
    """One of a stage's files is cut, holds noise, or is forged."""
    folder, good, read = stage_of
    monkeypatch.chdir(folder.parent)
    for file, content in good.items():
        (folder / file).write_bytes(content)
    raw, places = good[name], st.integers(0, len(good[name]))
    cut = places.map(lambda at: raw[:at])
    noise = st.builds(lambda at, noise, length: raw[:at] + noise + raw[at + length :], places, st.binary(max_size=9), FEW)
    (folder / name).write_bytes(data.draw(cut | noise | FORGED | RECORDS))
    if sealed and name != "record.json":  # a record that was forged along with it does not help
        record = json.loads(good["record.json"])
        record["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        (folder / "record.json").write_text(json.dumps(record))
    policy = outcome(read, *(f"{folder / file}: " for file in STAGE_FILES), f"{folder}")
    if policy is not None:
        assert all(tensor.isfinite().all() for tensor in policy.state_dict().values())
    assert not (folder.parent / "exploded").exists()


@pytest.fixture(scope="module")
def recorded(study):
    case = study(1)
    return trajectories_to_table(rollout(case.process, case.pid, case.task, 3, stream(0, "properties")), *NAMES, 0.04)


@some(0.25)
@given(data=st.data(), kind=st.sampled_from(["cell", "column", "order", "text"]), dtype=DTYPES)
def test_mutated_tables_of_demonstrations(tmp_path, recorded, data, kind, dtype):
    """A cell, a column, the order of the rows, or any part of the text; what is missing or twice is tested by hand."""
    table = recorded.sample(frac=1, random_state=data.draw(st.integers(0, 99))).astype(object)
    row, column = (data.draw(st.integers(0, length - 1)) for length in table.shape)
    if kind in ("cell", "column"):
        table.iloc[row if kind == "cell" else slice(None), column] = data.draw(CELLS)
    text = table.to_csv(index=False)
    if kind == "text":
        at = data.draw(st.integers(0, len(text)))
        text = text[:at] + data.draw(st.text(max_size=9)) + text[at + data.draw(st.integers(0, 99)) :]
    stage = save_stage(tmp_path / "stage", {}, {"demonstrations.csv": recorded})
    path = stage.path("demonstrations.csv")
    path.write_text(text, encoding="utf-8")
    found = outcome(lambda: trajectories_from_table(stage.table("demonstrations.csv"), *NAMES, dtype, path), f"{path}: ")
    if found is not None:
        assert all(signal.isfinite().all() for signal in vars(found).values())
        assert {signal.dtype for signal in vars(found).values()} == {dtype}
