"""Leaves of the parameter files and the records that hold them.

A leaf is a mapping {value, unit, source, status}; the records hold the bare values, checked for type, unit and range, and
`list_leaves` lists them all for the report. Whatever is wrong with a file is one sentence that names the file, the key and what was
expected.
"""

import copy
from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, Strict, ValidationError, model_validator
from pydantic_core import PydanticCustomError, core_schema
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

LESSON = "lesson"  # the scale between smoke and paper
LEAF_KEYS = ("value", "unit", "source", "status")
STATUSES = ("reported", "inferred", "assumed")
LONGEST = 200  # characters of a file that a message shows
EPISODES_PER_EPOCH = 500  # the size of the paper's batch of demonstrations; no epoch may draw more
DEVIATION = "deviation, unit not given"
KEY_MESSAGES = {
    "missing": "the key is missing",
    "extra_forbidden": "the key is unknown",
    "tuple_type": "expected a list in brackets",
    "dict_type": "expected keys and values",
    "model_type": "expected keys and values",
}


class InputError(ValueError):
    """What a user gave cannot be used; the message is one sentence, on one line, that says all there is to say."""

    def __init__(self, sentence: str) -> None:
        super().__init__(" ".join(sentence.splitlines()))  # it may quote what it met

    def _render_traceback_(self) -> list[str]:
        """What IPython shows: the sentence alone."""
        return [f"{type(self).__name__}: {self}"]


class ParameterError(InputError):
    """A parameter file is unusable; the message names the file and the key."""


def refusal(sentence: str) -> PydanticCustomError:
    """The error by which a record's own check refuses what it was given."""
    return PydanticCustomError("refused", "{sentence}", {"sentence": sentence})


@dataclass(frozen=True)
class Leaf:
    """Marks a field whose entry in the file is {value, unit, source, status}, with the unit it must be given in."""

    unit: str

    def unwrap(self, entry: Any) -> Any:
        """The value of a leaf, once its keys, unit and status are right."""
        if not isinstance(entry, dict):
            raise refusal("expected a leaf with the keys value, unit, source, status")
        if missing := [key for key in LEAF_KEYS if key not in entry]:
            raise refusal(f"the leaf lacks the key '{missing[0]}'")
        if unknown := [key for key in entry if key not in LEAF_KEYS]:
            raise refusal(f"the leaf has the unknown key '{unknown[0]}'")
        if entry["unit"] != self.unit:
            raise refusal(f"expected the unit '{self.unit}', found '{entry['unit']}'")
        if entry["status"] not in STATUSES:
            raise refusal(f"expected a status of {', '.join(STATUSES)}, found '{entry['status']}'")
        if not isinstance(entry["source"], str) or not entry["source"]:
            raise refusal("expected a source in words")
        return entry["value"]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(self.unwrap, handler(source))


def _not_zero(value: float) -> float:
    if value == 0:
        raise refusal("expected a number other than zero")
    return value


Real = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Real, Field(gt=0)]
NotNegative = Annotated[Real, Field(ge=0)]
Count = Annotated[int, Strict(), Field(gt=0)]
Text = Annotated[str, Strict(), Field(min_length=1)]
Vector = Annotated[tuple[Real, ...], Field(min_length=1)]
Share = Annotated[Positive, Field(le=1)]
Memory = Annotated[NotNegative, Field(lt=1)]
NotZero = Annotated[Real, AfterValidator(_not_zero)]
Matrix = Annotated[tuple[Vector, ...], Field(min_length=1)]


Rules = Iterator[tuple[bool, str]]


class Record(BaseModel):
    """A frozen record that refuses unknown keys and what breaks a rule between its entries."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="after")
    def _follows_its_rules(self) -> Self:
        for broken, sentence in self._rules():
            if broken:
                raise refusal(sentence)
        return self

    def _rules(self) -> Rules:
        """The rules between entries: whether each is broken, and the sentence that says so; none is read behind a broken one."""
        yield from ()

    def _lengths(self, expected: int, *names: str) -> Rules:
        """The rule that these fields have as many entries as expected."""
        for name in names:
            found = len(getattr(self, name))
            yield found != expected, f"'{name}' has {found} entries, expected {expected}"


R = TypeVar("R", bound=Record)


def read_yaml(path: Path) -> dict[str, Any]:
    """A parameter file as nested dictionaries; YAML 1.2, so that 1e-3 is a number."""
    if not path.is_file():
        raise ParameterError(f"{path}: the parameter file is missing")
    try:
        content = copy.deepcopy(_parsed(path.read_text(encoding="utf-8")))
    except DuplicateKeyError as error:
        raise ParameterError(f"{path}: {' '.join(str(error.problem).split())}") from error
    except RecursionError as error:
        raise ParameterError(f"{path}: not readable as YAML: its entries are nested too deeply") from error
    except (OSError, YAMLError, UnicodeDecodeError, ValueError) as error:
        raise ParameterError(f"{path}: not readable as YAML: {' '.join(str(error).split())[:LONGEST]}") from error
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: expected keys and values, found {type(content).__name__}")
    for key in content:
        if not isinstance(key, str):
            raise ParameterError(f"{path}: key '{key}': expected a word")
    return content


class _PlainComposer(Composer):
    """Refuses aliases: nine lines of them can stand for more values than there is memory, or for themselves."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node of the document."""
        if self.parser.check_event(AliasEvent):
            event = self.parser.peek_event()
            raise ComposerError("", event.start_mark, f"found the alias '{event.anchor}'; write the value out", event.start_mark)
        return super().compose_node(parent, index)


@cache
def _parsed(text: str) -> Any:
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _PlainComposer
    return yaml.load(text)


def validate(kind: type[R], content: Any, path: Path, prefix: str = "") -> R:
    """The content of a file as a record, or one sentence that names the file and the first key that is wrong."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join([prefix, *(str(part) for part in first["loc"])]).strip(".")
        message = KEY_MESSAGES.get(first["type"])
        if message is None:
            found = first["input"]
            shown = "" if isinstance(found, (dict, BaseModel)) else f", found {repr(found)[:LONGEST]}"
            message = first["msg"][:1].lower() + first["msg"][1:] + shown
        where = f"key '{key}': " if key else ""  # a rule between keys names them itself
        raise ParameterError(f"{path}: {where}{message}") from error


def list_leaves(content: Any, file: str, key: str = "") -> list[dict[str, Any]]:
    """Every leaf below `content` as {file, key, value, unit, source, status}."""
    if isinstance(content, dict) and set(content) == set(LEAF_KEYS):
        return [{"file": file, "key": key, **content}]
    if isinstance(content, dict):
        return [row for name, entry in content.items() for row in list_leaves(entry, file, f"{key}.{name}".strip("."))]
    return []


def load_record(kind: type[R], path: Path, scales: Iterable[str] = ()) -> R:
    """A whole file as a record, with all of these scales but for the lesson, which is not of all notebooks.

    Raises:
        ParameterError: if the file is missing, damaged or holds a value that cannot be, in one sentence.
    """
    record = validate(kind, read_yaml(path), path)
    for scale in scales:
        if scale != LESSON and scale not in vars(record)["scales"]:
            raise ParameterError(f"{path}: key 'scales.{scale}': the key is missing")
    return record


def check_length(path: Path, key: str, value: Sized, expected: int, one_a: str = "variable") -> None:
    """Refuse a vector that does not fit the process of the case."""
    if len(value) != expected:
        raise ParameterError(f"{path}: key '{key}': expected {expected} entries, one a {one_a}, found {len(value)}")
