"""What every run of a notebook begins with: its parameters, checked, and where its results come from and go."""

import html
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from IPython import get_ipython
from IPython.display import Markdown
from matplotlib.figure import Figure
from torch import nn

from helpers.runs import artifacts
from helpers.runs.finished import Finished
from helpers.runs.identity import changes, digest, identity, inputs, versions
from helpers.runs.request import NOTEBOOK_PARAMETERS, SessionError, check_parameters, parameter_names
from helpers.runs.sources import PROJECT
from helpers.settings.evidence import IdentificationParams, IdentificationScaleParams, load_identification
from helpers.settings.leaf import LESSON
from helpers.settings.paper import Params, PublishedCase, ScaleParams, load, load_published

PLAIN = (str, int, float, list, dict, type(None))
IPYTHON_NAMES = ("In", "Out")
OF_THE_MACHINE = ("number_type", "threads")  # settings of a scale that tell a reader nothing
VARIABLE = re.compile(r"(?<![A-Za-z])([A-Z])_([A-Z]\w*)")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of one notebook: what it was given, where its results come from, and where they go.

    Attributes:
        made_from: `identity.inputs` as they were when the run began.
        upstream: the earlier results that it read, by folder, and the hash of their files.
        clock: processor time in seconds at the beginning and at each result.
    """

    notebook: str
    seed: int
    scale: str
    input_root: Path
    output_root: Path
    params_root: Path
    made_from: Mapping[str, str]
    upstream: dict[str, str] = field(default_factory=dict)
    clock: list[float] = field(default_factory=lambda: [time.process_time()])

    @property
    def given(self) -> dict[str, Any]:
        """The run's own parameters, but for folders."""
        names = ("case", "seed", "scale", "variant")
        return {name: getattr(self, name) for name in names if hasattr(self, name)}

    def folder(self, root: Path, stage: str, case: int | None = None) -> Path:
        """Where a stage of this scale and seed keeps its results below a root."""
        return root / self.scale / f"seed_{self.seed}" / self._place(stage, case)

    def _place(self, stage: str, case: int | None = None) -> str:
        of_case = case or self.given.get("case")
        return f"case_{of_case}/{stage}" if of_case else stage

    def inputs_now(self) -> dict[str, str]:
        """`made_from` as it would be if the run began now."""
        own = {name: self.given[name] for name in ("case", "variant") if name in self.given}
        return inputs(self.notebook, self.params_root, self.scale, **own)

    def origin(self) -> dict[str, Any]:
        """Where a result of this run comes from, for its record.

        Raises:
            SessionError: if code or parameters have changed since the run began, because nobody could tell what made it.
        """
        if changed := changes({"inputs": self.made_from}, self.inputs_now()):
            raise SessionError(f"notebooks/{self.notebook}.ipynb: {', '.join(changed)} changed during the run; run it again")
        run = {"notebook": self.notebook, **self.given}
        self.clock.append(time.process_time())
        return {
            **run,
            "identity": identity(run, self.made_from, self.upstream),
            "inputs": dict(self.made_from),
            "upstream": dict(self.upstream),
            "seconds": self.clock[-1] - self.clock[-2],  # since the result before, so that those of a run add up to its time
            "revision": artifacts.code_revision(PROJECT),
            "versions": versions(),
        }

    def load(self, stage: str, made_by: str, case: int | None = None) -> artifacts.Stage:
        """A finished earlier stage; `made_by` is the notebook to run where it is missing."""
        whose = f"{made_by} for case {case or self.given['case']}"
        found = artifacts.load_stage(self.folder(self.input_root, stage, case), whose)
        self.upstream[self._place(stage, case)] = found.content
        return found

    def save(
        self,
        stage: str,
        tables: Mapping[str, pd.DataFrame],
        policy: nn.Module | None = None,
        figures: Mapping[str, Figure] | None = None,
        last: bool = True,
    ) -> artifacts.Stage:
        """Write a stage's results with a record of where they come from; `last`: this run writes no other stage."""
        saved = artifacts.save_stage(self.folder(self.output_root, stage), self.origin(), tables, policy, figures)
        self.upstream[self._place(stage)] = saved.content
        if last:
            self.finished.remove()
        return saved

    @property
    def finished(self) -> Finished:
        """The trainings that this run has finished, beside its results."""
        hidden = "_".join([".finished", self.notebook, *([self.given["variant"]] if "variant" in self.given else [])])
        return Finished(self.folder(self.output_root, hidden), digest([self.made_from, *self.given.values()]))

    def settings_table(self, scale_params: ScaleParams | IdentificationScaleParams) -> pd.DataFrame:
        """What the notebook was run with: a row for each setting that tells a reader something."""
        scale = {key: value for key, value in scale_params.model_dump(exclude_none=True).items() if key not in OF_THE_MACHINE}
        return pd.DataFrame(
            [{"setting": key.replace("_", " "), "value": str(value)} for key, value in (self.given | scale).items()]
        )

    def banner_of(self, what: str, measure: str, copy: str) -> Markdown:
        """What kind of run this is, for the top of the notebook; `measure`: of which the smoke run has few."""
        link = f"reports/reference/notebooks/{self.notebook}{copy}.ipynb"
        words = f"{what}, seed {self.seed}"
        return _banner(self.scale, words, f"a short one, few {measure}, results without meaning.", "executed copy", link)


def _banner(scale: str, what: str, smoke: str, full: str, link: str) -> Markdown:
    small = {
        "smoke": f"the smoke run: {smoke}",
        LESSON: "the lesson: fewer episodes and epochs than the paper's, and the same story.",
    }
    if scale not in small:
        return Markdown(f"**{what}, scale `{scale}`.**")
    return Markdown(f"**{what}. This is {small[scale]}** The full run's {full} is [{link}](../{link}).")


@dataclass(frozen=True, kw_only=True)
class IdentificationSession(Run):
    """One run of the notebook that infers settings from the expert rows of all cases that the paper printed.

    `params` holds the parameters of each case.
    """

    params: Mapping[int, Params]
    published: Mapping[int, PublishedCase]
    identification: IdentificationParams

    @property
    def scale_params(self) -> IdentificationScaleParams:
        """How much this scale computes."""
        return self.identification.scales[self.scale]

    def banner(self) -> Markdown:
        """What kind of run this is, for the top of the notebook."""
        return self.banner_of("Expert rows of Tables 2 to 4", "evaluations", "")

    def settings(self) -> pd.DataFrame:
        """What the notebook was run with."""
        return self.settings_table(self.scale_params)


@dataclass(frozen=True)
class ReportSession:
    """One run of the report's notebook, which reads all cases and `seeds` seeds."""

    cases: tuple[int, ...]
    seeds: int
    scale: str
    input_root: Path
    output_root: Path
    params_root: Path

    def banner(self) -> Markdown:
        """What kind of run this is, for the top of the notebook."""
        smoke = "the small committed results of notebooks 01 to 04, numbers without meaning."
        return _banner(self.scale, f"{self.seeds} seed(s)", smoke, "report", "reports/reference/report.html")


def parameters_hash(params: Params) -> str:
    """A hash of the value of every parameter that a case was run with."""
    return digest([[leaf["file"], leaf["key"], leaf["value"]] for leaf in params.leaves])


def checked(notebook: str, namespace: dict[str, Any]) -> tuple[dict[str, Any], Params]:
    """What a notebook was given, checked; names that are no parameters count only when the notebook first asks."""
    first_time = "_session_opened" not in namespace  # a cell that is run again meets the notebook's own variables
    given = {
        name: value
        for name, value in namespace.items()
        if name in NOTEBOOK_PARAMETERS
        or (first_time and not name.startswith("_") and name not in IPYTHON_NAMES and isinstance(value, PLAIN))
    }
    for name in parameter_names(notebook):
        if name not in given:
            raise SessionError(f"notebooks/{notebook}.ipynb: parameter '{name}' is not set; run the cell of parameters first")
    params = check_parameters(notebook, given)
    namespace["_session_opened"] = True
    # Whole tables in the plain text of an output too, which is what nbval compares.
    pd.set_option("display.max_columns", None, "display.width", 200, "display.max_rows", 400, "display.max_colwidth", 120)
    pd.set_option("display.float_format", "{:.6g}".format)
    if shell := get_ipython():
        shell.display_formatter.formatters["text/html"].for_type(pd.DataFrame, readable)
    torch.set_num_threads(params.learning.scales[given["scale"]].threads)
    return given, params


def readable(table: pd.DataFrame) -> str:
    """A table as HTML for a reader: four digits, variables with their index, no underscores, a dash where there is no number."""
    shown = table.rename_axis(index=_words, columns=_words).map(_words).rename(index=_words, columns=_words)
    numbers: dict[str, Any] = {
        "float_format": lambda value: f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}",
        "na_rep": "–",
    }
    return str(shown.to_html(escape=False, border=0, **numbers))


def _words(label: Any) -> Any:
    """alpha:C_A-I becomes alpha of C_A-I with the A as an index; what is no text, a key of a file, or TeX stays as it is."""
    if not isinstance(label, str) or re.search(r"[.$]|: ", label):
        return html.escape(label, quote=False) if isinstance(label, str) else label
    words = re.sub(r"(?<=[a-z]):(?=[A-Za-z])", " of ", html.escape(label, quote=False))
    return VARIABLE.sub(r"<i>\1</i><sub>\2</sub>", words).replace("_", " ")


def roots_of(given: Mapping[str, Any], output: str = "results") -> dict[str, Any]:
    """The folders that a notebook was given, or their defaults."""
    committed = given["scale"] in ("smoke", LESSON)
    defaults = {"input_root": "notebooks/inputs" if committed else "results", "output_root": output}
    return {
        name: Path(given.get(name) or PROJECT / default).resolve()
        for name, default in (defaults | {"params_root": "params"}).items()
    }


def open_report(notebook: str, namespace: dict[str, Any]) -> ReportSession:
    """`open_session` for the report's notebook, which has no case of its own: the cases are those that the paper printed."""
    given, _ = checked(notebook, namespace)
    roots = roots_of(given, "results/smoke/report" if given["scale"] == "smoke" else "reports/latest")
    return ReportSession(tuple(sorted(load_published(roots["params_root"]))), given["seeds"], given["scale"], **roots)


def open_identification(notebook: str, namespace: dict[str, Any]) -> IdentificationSession:
    """`open_session` for the notebook that infers settings, which reads the cases that the paper printed."""
    given, first = checked(notebook, namespace)
    roots = roots_of(given)
    published = load_published(roots["params_root"])
    return IdentificationSession(
        notebook=notebook,
        seed=given["seed"],
        scale=given["scale"],
        **roots,
        made_from=inputs(notebook, roots["params_root"], given["scale"]),
        params={case: load(roots["params_root"], case) for case in sorted(published)},
        published=published,
        identification=load_identification(roots["params_root"], first),
    )
