"""Parameter files: what the committed ones hold, and that every mistake is one sentence naming the file and the key."""

import copy
import shutil

import pytest
from ruamel.yaml import YAML

from helpers.settings.leaf import DEVIATION, EPISODES_PER_EPOCH, LEAF_KEYS, STATUSES, ParameterError
from helpers.settings.limits import load_limits
from helpers.settings.paper import load, load_published

DELETE = "delete this key"
SCALES = [([1.0, 4.0], None, (2.0, 5.0)), ([1.0, 4.0], [0.5, -2.0], (0.5, -2.0)), ([-1.0, 4.0], [1.0, 4.0], (1.0, 4.0))]
GAINS = ("proportional", "integral", "derivative")
FILES = ("process.yaml", "demonstrators.yaml", "features.yaml", "learning.yaml", "trials.yaml", "limits.yaml", "published.yaml")
DAMAGED = {"empty": b"", "a list": b"- 1\n- 2\n", "unclosed bracket": b"beta: {value: 10.0\n", "tab": b"beta:\n\t- 1\n"}
DAMAGED |= {"unknown tag": b"beta: !!python/object/apply:os.getcwd []\n", "two documents": b"a: 1\n---\nb: 2\n"}
DAMAGED |= {"unknown alias": b"a: *b\n", "unhashable key": b"{[1, 2]: 3}\n"}
DAMAGED |= {"binary": bytes(range(256)), "control characters": b"beta: \x00\x01\x02\n"}
NO_KEYS = {"beta: {value: 9.0, value: 10.0": 'duplicate key "value"', "discount: 1\nbeta: {value: 10.0": 'duplicate key "discount"'}
NO_KEYS |= {"7: 1\nbeta: {value: 10.0": "key '7'"}


@pytest.fixture
def folder(root, tmp_path):
    """A copy of the committed files that a test may damage."""
    return shutil.copytree(root, tmp_path / "params")


def edit(path, changes):
    """Set (or delete) entries of a YAML file, each given by its dotted key."""
    yaml = YAML(typ="safe", pure=True)
    content = yaml.load(path)
    for key, value in changes.items():
        *parents, last = key.split(".")
        entry = content
        for parent in parents:
            entry = entry[parent]
        if value is DELETE:
            del entry[last]
        else:
            entry[last] = copy.deepcopy(value)  # else YAML would write an alias for what stands twice
    yaml.dump(content, path)


def leaf(value, unit="-"):
    return {"value": value, "unit": unit, "source": "a test", "status": "assumed"}


def read_all(folder, case):
    """Every kind of file that a test here damages."""
    params = load(folder, case)
    return params, load_limits(folder, params), load_published(folder)


def refusal(folder, case=1):
    """The sentence with which the parameters are refused."""
    with pytest.raises(ParameterError) as caught:
        read_all(folder, case)
    sentence = str(caught.value)
    assert "\n" not in sentence, sentence
    assert "key ''" not in sentence, sentence
    assert len(sentence) < 500 + len(str(folder)), sentence
    return sentence


@pytest.mark.equation("4.1.3b")
@pytest.mark.equation("4.1.3c")
@pytest.mark.parametrize(("case", "printed"), [(1, (300, 4, "PID1")), (2, (250, 3, "PID2")), (3, (80, 1, "PID1"))])
def test_the_committed_files_are_as_printed_and_every_leaf_is_listed(root, case, printed):
    params, limits, published = read_all(root, case)
    found = {(row["file"], row["key"]) for row in params.leaves}
    keys = ("balance.rate_constant", "PID2.integral", "variants.printed.weights.step", "online.headline_beta")
    files = ("process.yaml", "demonstrators.yaml", "learning.yaml", f"case_{case}.yaml")
    assert set(zip(files, keys, strict=True)) <= found
    assert len(found) == len(params.leaves)
    assert all(set(row) == {"file", "key", *LEAF_KEYS} and row["status"] in STATUSES for row in params.leaves)
    process, offline, online = params.process, params.case.offline, params.case.online
    assert process.drift_state == ((-3.997, -0.446), (-6.092, -1.581))
    assert (process.drift_input, process.disturbance, process.horizon) == (((0.5, 0.0), (0.0, 0.305)), (0.5, 0.3), 50)
    assert (offline.epochs, offline.iterations, params.case.demonstrator) == printed
    assert (online.epochs, online.headline_beta) == ((10, 10), 30)
    scale = params.learning.scales["paper"]
    assert (scale.demonstrations, scale.epoch_share) == (EPISODES_PER_EPOCH, 1) == (500, 1)
    assert {"paper", "smoke"} <= set(limits.scales)
    assert sorted(published) == [1, 2, 3]
    with pytest.raises(ValueError, match="frozen"):
        params.process.sampling_time = 1.0
    table = published[case]
    assert (table.table, len(table.expert), len(table.policy), len(table.alpha)) == (case + 1, 6, 6, 6)
    assert sum(weight**2 for weight in table.alpha) == pytest.approx(1, abs=3e-3)  # printed with three decimals


@pytest.mark.equation("4.2.1")
@pytest.mark.parametrize(("set_point", "error_scale", "expected"), SCALES)
def test_scale_of_error(folder, set_point, error_scale, expected):
    changes = {"set_point.value": set_point, "steady_state.value": [-1.0, -1.0]}
    edit(folder / "case_1.yaml", changes | ({"error_scale": leaf(error_scale, DEVIATION)} if error_scale else {}))
    assert load(folder, 1).case.scale_of_error == expected


def test_three_loops_need_no_change_of_code(folder):
    """The parameter files alone know how many variables there are."""
    three, identity = [0.1, 0.2, 0.3], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    words = [f"{kind}{what}" for kind in ("controlled", "manipulated") for what in ("", "_description")]
    process = {word: ["a", "b", "c"] for word in words} | dict.fromkeys(("drift_state", "drift_input"), identity)
    process |= dict.fromkeys(("disturbance", "observation_noise", "input_high"), three) | {"input_low": [-1.0, -1.0, -1.0]}
    edit(folder / "process.yaml", {f"{name}.value": value for name, value in process.items()} | {"balance": DELETE})
    edit(folder / "demonstrators.yaml", {f"PID1.{gain}.value": three for gain in GAINS})
    edit(folder / "learning.yaml", {"policy.error_unit.value": three})
    case = {f"{name}.value": three for name in ("set_point", "initial_mean", "initial_std")}
    edit(folder / "case_1.yaml", case | {"steady_state.value": [0.0, 0.0, 0.0]})
    assert load(folder, 1).process.balance is None


@pytest.mark.parametrize(("text", "expected"), [("1e-3", 1e-3), ("1.0e-3", 1e-3), ("2", 2.0), (".5", 0.5)])
def test_numbers_may_be_written_as_people_write_them(folder, text, expected):
    path = folder / "process.yaml"
    path.write_text(path.read_text().replace("value: 0.04\n", f"value: {text}\n"))
    assert load(folder, 1).process.sampling_time == expected


NAN, INF = float("nan"), float("inf")
VALUES = {  # mistakes, by file and key: what the sentence must say, and the values of which it says that
    "process.yaml": {
        "sampling_time": [("number", "1e-3", True, None, [0.04]), ("finite", NAN), ("greater than 0", -0.04, 0)],
        "horizon": [("integer", 50.0, True, "50"), ("greater than 0", 0)],
        "disturbance": [("", 0.5, None, []), ("number", [0.5, "0.3"]), ("expected 2", [0.5, 0.3, 0.1])],
        "controlled": [("string", [1, 2])],
        "balance.rate_constant": [("number", "3.497")],
        "observation_noise": [("greater than or equal to 0", [-0.025, 0.025])],
        "input_low": [("below", [20.0, -60.0], [30.0, -60.0])],
        "input_high": [("expected 2", [20.0])],
        "drift_state": [("expected 2", [[-3.997, -0.446]]), ("length is not 2", [[-3.997, -0.446], [-6.092]])],
    },
    "demonstrators.yaml": {"PID1.integral": [("expected 2", [48.3])]},
    "features.yaml": {
        "discount": [("less than or equal to 1", 1.5), ("greater than 0", 0.0)],
        "beta": [("greater than 0", -10.0)],
        "features_on": [("'x' or 'y'", "z")],
    },
    "learning.yaml": {
        "policy.hidden_cells": [("integer", [20.0, 20])],
        "policy.initial_std": [("std_high", 0.5)],
        "policy.error_unit": [("greater than 0", [0.0, 0.4]), ("expected 2", [0.1])],
        "scales.paper.episodes": [("500", 401)],
        "scales.paper.epoch_share": [("less than or equal to 1", 1.01)],
        "scales.smoke.number_type": [("float32", "float16")],
        "variants.improved.weights.averaging": [("less than 1", 1.0)],
        "variants.printed.weights.scaled_by_expert": [("boolean", "no", 1)],
        "variants.printed.weights.initial": [("3", [1.0, -1.0])],
        "variants.printed.learner.learning_rate_start": [("less than or equal to 1", 1e39)],
        "online.learner.credit": [("reward_to_go", "all")],
        "online.learner.patience": [("greater than or equal to 0", -1)],
    },
    "case_1.yaml": {
        "demonstrator": [("string", 1), ("PID1, PID2", "PID3")],
        "set_point": [("finite", [INF, 4.0]), ("differ in length", [-1.0, 4.0, 0.0])],
        "steady_state": [("set_point", [0.0])],
        "initial_std": [("greater than or equal to 0", [-0.25, 0.75]), ("expected 2", [0.25])],
        "offline.epochs": [("greater than 0", 0)],
        "offline.iterations": [("epochs", 301)],  # every iteration needs an epoch
        "online.beta": [("greater than 0", [30.0, 0.0]), ("expected 2", [30.0])],
    },
    "limits.yaml": {
        "robustness.load": [("robustness.load", "much")],
        "robustness.improve_state": [("'improve_state' and 'improve_input' differ", [1.3])],
        "attainable.nodes": [("attainable.nodes", 0)],
        "quality.order": [("'quality.order': needs more than twice as many samples as 'scales.smoke.at_rest'", 150)],
        "quality.n_last": [("'quality.n_last': exceeds the horizon of 50 samples", 51)],
        "scales.smoke.listed": [("multiples of 'every'", [0, 70])],
        "scales.smoke.states": [("'states' and 'inputs' differ", [11])],
    },
}

# The same of the parts of a leaf.
LEAF = [("unit", "s", "'time'"), ("unit", None, "'time'"), ("source", "", "source"), ("source", 3, "source")]
LEAF += [("status", status, "reported, inferred, assumed") for status in ("guessed", ["reported"])]
LEAF += [("stauts", "reported", "'stauts'"), *((key, DELETE, f"'{key}'") for key in LEAF_KEYS)]

# Keys that are deleted, or misspelt.
KEYS = [("process.yaml", "sampling_time"), ("process.yaml", "balance.heat_exchange"), ("demonstrators.yaml", "PID1.derivative")]
KEYS += [("learning.yaml", key) for key in ("online", "scales.paper.measured", "variants.improved.weights.step")]
KEYS += [("features.yaml", "beta"), ("case_1.yaml", "offline.epochs")]

# What is no leaf, or no group of them; of the last a weight is missing.
PARTS = [("process.yaml", "sampling_time", entry, "value, unit, source, status") for entry in (0.04, None, [0.04], "0.04")]
PARTS += [("process.yaml", "balance", 3.0, ""), ("learning.yaml", "scales.paper", None, "")]
PARTS += [("case_1.yaml", "error_scale", leaf(scale, DEVIATION), "") for scale in ([0.0, 4.0], [1.0], ["1", 4.0])]
PARTS += [("published.yaml", "case_1.expert", entry, "case_1.expert") for entry in (DELETE, "21.63", [21.63, "20.68", 4.08])]
PARTS += [("published.yaml", "case_1.table", 0, "case_1.table"), ("published.yaml", "case_1.tabel", 2, "case_1.tabel")]
PARTS += [("demonstrators.yaml", "PID1", "well tuned", ""), ("published.yaml", "case_1", None, "")]
PARTS += [("published.yaml", "case_1.alpha", [0.137, 0.652, -0.067, -0.630, -0.194], "")]

ONE_INPUT = {f"{name}.value": ["a"] for name in ("manipulated", "manipulated_description")}
ONE_INPUT |= {"input_low.value": [-1.0], "input_high.value": [1.0], "drift_input.value": [[1.0], [1.0]]}
MISTAKES = [
    *(
        (file, {f"{key}.value": value}, key.split(".")[-1], says)
        for file, keys in VALUES.items()
        for key, mistakes in keys.items()
        for says, *values in mistakes
        for value in values
    ),
    *(("process.yaml", {f"sampling_time.{part}": value}, "'sampling_time'", says) for part, value, says in LEAF),
    *((file, {key: DELETE}, f"'{key}'", "missing") for file, key in KEYS),
    *((file, {f"{key}_": leaf(1)}, f"'{key}_'", "unknown") for file, key in KEYS),
    *((file, {key: entry}, key.split(".")[-1], says) for file, key, entry, says in PARTS),
    ("demonstrators.yaml", {f"PID1.{gain}.value": [1.0, 2.0, 3.0] for gain in GAINS}, "PID1.proportional", "expected 2"),
    ("process.yaml", ONE_INPUT, "'manipulated'", "a PID pairs 2 loops"),
    *(("case_1.yaml", {"steady_state.value": rest}, "'set_point'", "error_scale") for rest in ([-1.0, 0.0], [0.0, 4.0])),
]


@pytest.mark.parametrize(("file", "changes", "key", "says"), MISTAKES, ids=[f"{file} {changes}" for file, changes, *_ in MISTAKES])
def test_a_mistake_is_named(folder, file, changes, key, says):
    edit(folder / file, changes)
    sentence = refusal(folder)
    assert all(part in sentence for part in (file, key, says)), sentence


@pytest.mark.parametrize(("new", "says"), NO_KEYS.items())
def test_a_key_that_stands_twice_or_is_no_word_is_named(folder, new, says):
    path = folder / "features.yaml"
    path.write_text(path.read_text().replace("beta: {value: 10.0", new, 1))
    sentence = refusal(folder)
    assert all(part in sentence for part in ("features.yaml", says)), sentence


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_file_is_named(folder, content):
    for path in (folder / file for file in (*FILES, "case_1.yaml")):
        good = path.read_bytes()
        path.write_bytes(content)
        assert path.name in refusal(folder)
        path.write_bytes(good)


@pytest.mark.parametrize("file", FILES)
def test_a_missing_file_is_named(folder, file):
    (folder / file).unlink()
    assert f"{file}: the parameter file is missing" in refusal(folder)


@pytest.mark.parametrize("case", [0, 4, -1])
def test_an_unknown_case_lists_the_known_ones(folder, tmp_path, case):
    assert refusal(folder, case).endswith(f"case_{case}.yaml: there is no case {case}; the cases are 1, 2, 3")
    assert refusal(tmp_path, case) == f"{tmp_path}/case_{case}.yaml: there is no case {case}; the cases are none"
