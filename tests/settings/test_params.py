"""Parameter files: what the committed ones hold, and that every mistake is one sentence naming the file and the key."""

import copy
import shutil

import pytest
from ruamel.yaml import YAML

from helpers.settings.leaf import DEVIATION, LEAF_KEYS, STATUSES, ParameterError
from helpers.settings.limits import load_limits
from helpers.settings.paper import Params, load, load_published

DELETE = "delete this key"
GAINS = ("proportional", "integral", "derivative")
FILES = ("process.yaml", "demonstrators.yaml", "features.yaml", "learning.yaml", "case_1.yaml")


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
    """An entry of a parameter file."""
    return {"value": value, "unit": unit, "source": "a test", "status": "assumed"}


def refusal(folder, case=1, read=load):
    """The sentence with which the parameters are refused."""
    with pytest.raises(ParameterError) as caught:
        read(folder, case)
    sentence = str(caught.value)
    assert "\n" not in sentence, sentence
    assert "key ''" not in sentence, sentence
    assert len(sentence) < 500 + len(str(folder)), sentence
    return sentence


# What the committed files hold


@pytest.mark.parametrize("case", [1, 2, 3])
def test_the_committed_files_are_valid_and_every_leaf_is_listed(root, case):
    params = load(root, case)
    assert isinstance(params, Params)
    found = {(row["file"], row["key"]) for row in params.leaves}
    assert {
        ("process.yaml", "balance.rate_constant"),
        ("demonstrators.yaml", "PID2.integral"),
        ("learning.yaml", "variants.printed.weights.step"),
        (f"case_{case}.yaml", "online.headline_beta"),
    } <= found
    assert len(found) == len(params.leaves)
    assert all(set(row) == {"file", "key", *LEAF_KEYS} and row["status"] in STATUSES for row in params.leaves)


@pytest.mark.equation("4.1.3b")
@pytest.mark.equation("4.1.3c")
def test_the_process_is_as_printed(root):
    process = load(root, 1).process
    assert process.drift_state == ((-3.997, -0.446), (-6.092, -1.581))
    assert process.drift_input == ((0.5, 0.0), (0.0, 0.305))
    assert process.disturbance == (0.5, 0.3)
    assert process.horizon == 50


@pytest.mark.parametrize(
    ("case", "epochs", "iterations", "demonstrator"), [(1, 300, 4, "PID1"), (2, 250, 3, "PID2"), (3, 80, 1, "PID1")]
)
def test_no_more_epochs_than_the_paper(root, case, epochs, iterations, demonstrator):
    params = load(root, case).case
    assert (params.offline.epochs, params.offline.iterations, params.demonstrator) == (epochs, iterations, demonstrator)
    assert params.online.epochs == (10, 10)
    assert params.online.headline_beta == 30


@pytest.mark.parametrize("case", [1, 2, 3])
def test_published_tables_hold_six_features_and_unit_weights(root, case):
    table = load_published(root)[case]
    assert table.table == case + 1
    assert len(table.expert) == len(table.policy) == len(table.alpha) == 6
    assert sum(weight**2 for weight in table.alpha) == pytest.approx(1, abs=3e-3)  # printed with three decimals


def test_records_are_frozen(root):
    params = load(root, 1)
    with pytest.raises(ValueError, match="frozen"):
        params.process.sampling_time = 1.0
    with pytest.raises(AttributeError):
        params.process = None


@pytest.mark.equation("4.2.1")
@pytest.mark.parametrize(("error_scale", "expected"), [(DELETE, (2.0, 5.0)), ([0.5, -2.0], (0.5, -2.0))])
def test_scale_of_error(folder, error_scale, expected):
    changes = {"set_point.value": [1.0, 4.0], "steady_state.value": [-1.0, -1.0]}
    if error_scale is not DELETE:
        changes["error_scale"] = leaf(error_scale, DEVIATION)
    edit(folder / "case_1.yaml", changes)
    assert load(folder, 1).case.scale_of_error == expected


def test_a_set_point_at_rest_is_fine_with_an_error_scale(folder):
    edit(folder / "case_1.yaml", {"set_point.value": [0.0, 4.0], "error_scale": leaf([1.0, 4.0], DEVIATION)})
    assert load(folder, 1).case.scale_of_error == (1.0, 4.0)


def test_three_loops_need_no_change_of_code(folder):
    """The parameter files alone know how many variables there are."""
    three = [0.1, 0.2, 0.3]
    identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    edit(
        folder / "process.yaml",
        {
            **{f"{name}.value": ["a", "b", "c"] for name in ("controlled", "manipulated")},
            **{f"{name}_description.value": ["a", "b", "c"] for name in ("controlled", "manipulated")},
            **{f"{name}.value": identity for name in ("drift_state", "drift_input")},
            **{f"{name}.value": three for name in ("disturbance", "observation_noise", "input_high")},
            "input_low.value": [-1.0, -1.0, -1.0],
            "balance": DELETE,
        },
    )
    edit(folder / "demonstrators.yaml", {f"PID1.{gain}.value": three for gain in GAINS})
    edit(folder / "learning.yaml", {"policy.error_unit.value": three})
    edit(folder / "case_1.yaml", {f"{name}.value": three for name in ("set_point", "initial_mean", "initial_std")})
    edit(folder / "case_1.yaml", {"steady_state.value": [0.0, 0.0, 0.0]})
    assert load(folder, 1).process.balance is None


@pytest.mark.parametrize(("text", "expected"), [("1e-3", 1e-3), ("1.0e-3", 1e-3), ("2", 2.0), (".5", 0.5)])
def test_numbers_may_be_written_as_people_write_them(folder, text, expected):
    path = folder / "process.yaml"
    path.write_text(path.read_text().replace("value: 0.04\n", f"value: {text}\n"))
    assert load(folder, 1).process.sampling_time == expected


# Mistakes in a value: file, key, new value, and what the sentence must say

VALUES = [
    # mistyped
    ("process.yaml", "sampling_time.value", "1e-3", "number"),
    ("process.yaml", "sampling_time.value", True, "number"),
    ("process.yaml", "sampling_time.value", None, "number"),
    ("process.yaml", "sampling_time.value", [0.04], "number"),
    ("process.yaml", "horizon.value", 50.0, "integer"),
    ("process.yaml", "horizon.value", True, "integer"),
    ("process.yaml", "horizon.value", "50", "integer"),
    ("process.yaml", "disturbance.value", 0.5, ""),
    ("process.yaml", "disturbance.value", [0.5, "0.3"], "number"),
    ("process.yaml", "disturbance.value", None, ""),
    ("process.yaml", "controlled.value", [1, 2], "string"),
    ("process.yaml", "balance.rate_constant.value", "3.497", "number"),
    ("process.yaml", "balance", 3.0, ""),
    ("learning.yaml", "variants.printed.weights.scaled_by_expert.value", "no", ""),
    ("learning.yaml", "variants.printed.weights.scaled_by_expert.value", 1, ""),
    ("learning.yaml", "policy.hidden_cells.value", [20.0, 20], "integer"),
    ("learning.yaml", "scales.paper", None, ""),
    ("case_1.yaml", "demonstrator.value", 1, "string"),
    ("demonstrators.yaml", "PID1", "well tuned", ""),
    # not finite
    ("process.yaml", "sampling_time.value", float("nan"), "finite"),
    ("case_1.yaml", "set_point.value", [float("inf"), 4.0], "finite"),
    # out of range
    ("process.yaml", "sampling_time.value", -0.04, "greater than 0"),
    ("process.yaml", "sampling_time.value", 0, "greater than 0"),
    ("process.yaml", "horizon.value", 0, "greater than 0"),
    ("process.yaml", "observation_noise.value", [-0.025, 0.025], "greater than or equal to 0"),
    ("process.yaml", "input_low.value", [20.0, -60.0], "below"),
    ("process.yaml", "input_low.value", [30.0, -60.0], "below"),
    ("features.yaml", "discount.value", 1.5, "less than or equal to 1"),
    ("features.yaml", "discount.value", 0.0, "greater than 0"),
    ("features.yaml", "beta.value", -10.0, "greater than 0"),
    ("features.yaml", "features_on.value", "z", "'x' or 'y'"),
    ("learning.yaml", "policy.initial_std.value", 0.5, "std_high"),
    ("learning.yaml", "policy.error_unit.value", [0.0, 0.4], "greater than 0"),
    ("learning.yaml", "scales.paper.episodes.value", 401, "500"),
    ("learning.yaml", "scales.paper.epoch_share.value", 1.01, "less than or equal to 1"),
    ("learning.yaml", "scales.smoke.number_type.value", "float16", "float32"),
    ("learning.yaml", "variants.improved.weights.averaging.value", 1.0, "less than 1"),
    ("learning.yaml", "variants.printed.learner.learning_rate_start.value", 1e39, ""),
    ("learning.yaml", "online.learner.credit.value", "all", "reward_to_go"),
    ("learning.yaml", "online.learner.patience.value", -1, "greater than or equal to 0"),
    ("case_1.yaml", "initial_std.value", [-0.25, 0.75], "greater than or equal to 0"),
    ("case_1.yaml", "offline.epochs.value", 0, "greater than 0"),
    ("case_1.yaml", "offline.iterations.value", 301, "epochs"),  # every iteration needs an epoch
    ("case_1.yaml", "online.beta.value", [30.0, 0.0], "greater than 0"),
    ("case_1.yaml", "demonstrator.value", "PID3", "PID1, PID2"),
    # of the wrong length
    ("process.yaml", "input_high.value", [20.0], "expected 2"),
    ("process.yaml", "disturbance.value", [0.5, 0.3, 0.1], "expected 2"),
    ("process.yaml", "disturbance.value", [], ""),
    ("process.yaml", "drift_state.value", [[-3.997, -0.446]], "expected 2"),
    ("process.yaml", "drift_state.value", [[-3.997, -0.446], [-6.092]], "2"),
    ("demonstrators.yaml", "PID1.integral.value", [48.3], "expected 2"),
    ("learning.yaml", "policy.error_unit.value", [0.1], "expected 2"),
    ("learning.yaml", "variants.printed.weights.initial.value", [1.0, -1.0], "3"),
    ("case_1.yaml", "set_point.value", [-1.0, 4.0, 0.0], ""),
    ("case_1.yaml", "steady_state.value", [0.0], "set_point"),
    ("case_1.yaml", "initial_std.value", [0.25], "expected 2"),
    ("case_1.yaml", "online.beta.value", [30.0], "expected 2"),
]


# Mistakes in a leaf

LEAVES = [
    ({"unit": "s"}, "'time'"),
    ({"unit": None}, "'time'"),
    ({"unit": DELETE}, "'unit'"),
    ({"value": DELETE}, "'value'"),
    ({"source": DELETE}, "'source'"),
    ({"source": ""}, "source"),
    ({"source": 3}, "source"),
    ({"status": DELETE}, "'status'"),
    ({"status": "guessed"}, "reported, inferred, assumed"),
    ({"status": ["reported"]}, "reported, inferred, assumed"),
    ({"stauts": "reported"}, "'stauts'"),
]


# Mistakes in the keys

KEYS = [
    ("process.yaml", "sampling_time"),
    ("process.yaml", "balance.heat_exchange"),
    ("features.yaml", "beta"),
    ("learning.yaml", "online"),
    ("learning.yaml", "scales.paper.measured"),
    ("learning.yaml", "variants.improved.weights.step"),
    ("demonstrators.yaml", "PID1.derivative"),
    ("case_1.yaml", "offline.epochs"),
]


BARE = [0.04, None, [0.04], "0.04"]  # values that are no leaves

OTHERS = [
    ("demonstrators.yaml", {f"PID1.{gain}.value": [1.0, 2.0, 3.0] for gain in GAINS}, "PID1.proportional", "expected 2"),
    (
        "process.yaml",
        {f"{name}.value": ["a"] for name in ("manipulated", "manipulated_description")}
        | {"input_low.value": [-1.0], "input_high.value": [1.0], "drift_input.value": [[1.0], [1.0]]},
        "'manipulated'",
        "a PID pairs 2 loops",
    ),
    *(("case_1.yaml", {"steady_state.value": rest}, "'set_point'", "error_scale") for rest in ([-1.0, 0.0], [0.0, 4.0])),
    *(("case_1.yaml", {"error_scale": leaf(scale, DEVIATION)}, "error_scale", "") for scale in ([0.0, 4.0], [1.0], ["1", 4.0])),
]

MISTAKES = [
    *((file, {key: value}, key.removesuffix(".value").split(".")[-1], says) for file, key, value, says in VALUES),
    *(
        ("process.yaml", {f"sampling_time.{key}": value}, "'sampling_time'", says)
        for part, says in LEAVES
        for key, value in part.items()
    ),
    *(("process.yaml", {"sampling_time": entry}, "'sampling_time'", "value, unit, source, status") for entry in BARE),
    *((file, {key: DELETE}, f"'{key}'", "missing") for file, key in KEYS),
    *((file, {f"{key}_": leaf(1)}, f"'{key}_'", "unknown") for file, key in KEYS),
    *OTHERS,
]


@pytest.mark.parametrize(("file", "changes", "key", "says"), MISTAKES, ids=[f"{file} {changes}" for file, changes, *_ in MISTAKES])
def test_a_mistake_is_named(folder, file, changes, key, says):
    edit(folder / file, changes)
    sentence = refusal(folder)
    assert all(part in sentence for part in (file, key, says)), sentence


LIMITS = [
    ("attainable.nodes", 0, "attainable.nodes"),
    ("quality.order", 150, "'quality.order': needs more than twice as many samples as 'scales.smoke.at_rest'"),
    ("quality.n_last", 51, "'quality.n_last': exceeds the horizon of 50 samples"),
    ("scales.smoke.states", [11], "'states' and 'inputs' differ"),
    ("scales.smoke.listed", [0, 70], "multiples of 'every'"),
    ("robustness.improve_state", [1.3], "'improve_state' and 'improve_input' differ"),
    ("robustness.load", "much", "robustness.load"),
]


@pytest.mark.parametrize(("key", "value", "says"), LIMITS)
def test_a_mistake_in_the_limits_is_named(folder, key, value, says):
    edit(folder / "limits.yaml", {f"{key}.value": value})
    sentence = refusal(folder, read=lambda root, case: load_limits(root, load(root, case)))
    assert "limits.yaml" in sentence
    assert says in sentence


@pytest.mark.parametrize("case", [1, 2, 3])
def test_the_committed_limits_fit_every_case(root, case):
    record = load_limits(root, load(root, case))
    assert {"paper", "smoke"} <= set(record.scales)


@pytest.mark.parametrize("file", FILES)
def test_a_duplicate_key_is_named(folder, file):
    path = folder / file
    first = next(line.split(":")[0] for line in path.read_text().splitlines() if line and not line.startswith("#"))
    path.write_text(path.read_text() + f"{first}: 1\n")
    sentence = refusal(folder)
    assert file in sentence
    assert f'"{first}"' in sentence
    assert "duplicate" in sentence


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [("beta: {value: 10.0", "beta: {value: 9.0, value: 10.0", ('"value"', "duplicate")), ("beta:", "7: 1\nbeta:", ("key '7'",))],
)
def test_a_key_that_stands_twice_in_a_leaf_or_is_no_word_is_named(folder, old, new, says):
    path = folder / "features.yaml"
    path.write_text(path.read_text().replace(old, new, 1))
    sentence = refusal(folder)
    assert all(part in sentence for part in ("features.yaml", *says)), sentence


# Files that are no parameter files

CONTENTS = {
    "empty": b"",
    "comments only": b"# nothing\n",
    "a list": b"- 1\n- 2\n",
    "a number": b"3\n",
    "unclosed bracket": b"beta: {value: 10.0\n",
    "tab": b"beta:\n\t- 1\n",
    "unknown tag": b"beta: !!python/object/apply:os.getcwd []\n",
    "two documents": b"a: 1\n---\nb: 2\n",
    "unknown alias": b"a: *b\n",
    "binary": bytes(range(256)),
    "control characters": b"beta: \x00\x01\x02\n",
    "latin-1": "source: é\n".encode("latin-1"),
    "unhashable key": b"{[1, 2]: 3}\n",
}


@pytest.mark.parametrize("name", CONTENTS)
@pytest.mark.parametrize("file", ["process.yaml", "demonstrators.yaml", "case_1.yaml"])
def test_a_damaged_file_is_named(folder, file, name):
    (folder / file).write_bytes(CONTENTS[name])
    assert file in refusal(folder)


@pytest.mark.parametrize("file", FILES[:-1])
def test_a_missing_file_is_named(folder, file):
    (folder / file).unlink()
    sentence = refusal(folder)
    assert file in sentence
    assert "missing" in sentence


@pytest.mark.parametrize("case", [0, 4, 12, -1])
def test_an_unknown_case_lists_the_known_ones(folder, case):
    sentence = refusal(folder, case)
    assert f"case_{case}.yaml" in sentence
    assert "1, 2, 3" in sentence


def test_a_folder_without_parameters_is_named(tmp_path):
    assert str(tmp_path) in refusal(tmp_path)
    assert "none" in refusal(tmp_path)


PUBLISHED = [
    ({"case_1": None}, "case_1"),
    ({"case_1.expert": DELETE}, "case_1.expert"),
    ({"case_1.expert": "21.63"}, "case_1.expert"),
    ({"case_1.expert": [21.63, "20.68", 4.08, 7.93, -22.87, -22.43]}, "case_1.expert"),
    ({"case_1.table": 0}, "case_1.table"),
    ({"case_1.tabel": 2}, "case_1.tabel"),
    ({"case_1.alpha": [0.137, 0.652, -0.067, -0.630, -0.194]}, "alpha"),  # a weight too few
]


def published(folder, _):
    return load_published(folder)


@pytest.mark.parametrize(("changes", "key"), PUBLISHED, ids=[str(changes) for changes, _ in PUBLISHED])
def test_a_wrong_published_table_is_named(folder, changes, key):
    edit(folder / "published.yaml", changes)
    sentence = refusal(folder, read=published)
    assert "published.yaml" in sentence
    assert key in sentence


@pytest.mark.parametrize("name", ["empty", "a list", "binary", "control characters"])
def test_a_damaged_published_file_is_named(folder, name):
    (folder / "published.yaml").write_bytes(CONTENTS[name])
    assert "published.yaml" in refusal(folder, read=published)


def test_a_case_of_your_own_has_no_published_table(root):
    assert sorted(load_published(root)) == [1, 2, 3]
