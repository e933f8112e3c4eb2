"""What a notebook knows of its run: its parameters, checked, and the objects that they describe."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from IPython.display import Markdown
from matplotlib.figure import Figure

from helpers.learning.features import FeatureMap, feature_names
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import PID, MinimumVariance
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import stream
from helpers.plant.task import ControlTask
from helpers.runs import artifacts
from helpers.runs.finished import Finished, State
from helpers.runs.identity import changes, digest, identity, inputs, versions
from helpers.runs.request import NOTEBOOK_PARAMETERS, SessionError, check_parameters, parameter_names
from helpers.runs.sources import PROJECT
from helpers.settings.evidence import IdentificationParams, IdentificationScaleParams, load_identification
from helpers.settings.paper import Params, PublishedCase, ScaleParams, VariantParams, load, load_published

PLAIN = (str, int, float, list, dict, type(None))
IPYTHON_NAMES = ("In", "Out")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of one notebook: what it was given, and where its results come from.

    Attributes:
        made_from: `identity.inputs` as they were when the run began.
        upstream: the earlier results that it read, by folder, and the hash of their files.
    """

    notebook: str
    seed: int
    scale: str
    output_root: Path
    params_root: Path
    made_from: Mapping[str, str]
    upstream: dict[str, str] = field(default_factory=dict)
    started: float = field(default_factory=time.perf_counter)

    @property
    def given(self) -> dict[str, Any]:
        """The run's own parameters, but for folders."""
        names = ("case", "seed", "scale", "variant")
        return {name: getattr(self, name) for name in names if hasattr(self, name)}

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
        return {
            **run,
            "identity": identity(run, self.made_from, self.upstream),
            "inputs": dict(self.made_from),
            "upstream": dict(self.upstream),
            "seconds": time.perf_counter() - self.started,
            "revision": artifacts.code_revision(PROJECT),
            "versions": versions(),
        }

    def settings_table(self, scale_params: ScaleParams | IdentificationScaleParams) -> pd.DataFrame:
        """What the notebook was run with. Columns: setting, value."""
        scale = {f"scale.{key}": value for key, value in scale_params.model_dump().items()}
        return pd.DataFrame([{"setting": key, "value": str(value)} for key, value in (self.given | scale).items()])


@dataclass(frozen=True, kw_only=True)
class Session(Run):
    """One run of a notebook for one case."""

    case: int
    variant: str
    input_root: Path
    params: Params
    scale_params: ScaleParams
    variant_params: VariantParams
    finished: Finished

    @property
    def dtype(self) -> torch.dtype:
        """The number type of this scale."""
        return getattr(torch, self.scale_params.number_type)

    @property
    def published(self) -> PublishedCase | None:
        """The paper's table for this case; None for a case of your own."""
        return load_published(self.params_root).get(self.case)

    def expect_transfer(self, expected: bool) -> None:
        """Refuse a case that belongs to another notebook: one that starts from another case, or one that does not."""
        if (self.params.case.offline.transfer_from is not None) != expected:
            rule = "names a case to start from" if not expected else "names no case to start from"
            other = "04_knowledge_transfer" if not expected else "03_online_improvement"
            raise SessionError(
                f"notebooks/{self.notebook}.ipynb: parameter 'case': params/case_{self.case}.yaml {rule} "
                f"(key 'offline.transfer_from'), so it belongs to notebooks/{other}.ipynb"
            )

    @cached_property
    def process(self) -> LinearProcess:
        """The process of Eq. 4.1.3-4.1.4."""
        return LinearProcess(self.params.process, self.dtype)

    @cached_property
    def task(self) -> ControlTask:
        """The control task of this case, Table 1."""
        return ControlTask.from_params(self.params.process, self.params.case, self.dtype)

    @cached_property
    def features(self) -> FeatureMap:
        """The features of this case."""
        return FeatureMap(self.params.features, self.task, self.params.process.sampling_time)

    @cached_property
    def expert(self) -> PID:
        """The demonstrating controller of this case."""
        return PID(self.params.demonstrator, self.task.set_point, self.params.process.sampling_time)

    @cached_property
    def minimum_variance(self) -> MinimumVariance:
        """The reference for what is attainable in this case: it knows the process and acts on the observation."""
        return MinimumVariance(self.process.state_step, self.process.input_step, self.task.set_point)

    @property
    def feature_names(self) -> list[str]:
        """Names of the features in their order."""
        return feature_names(self.params.process.controlled)

    def epochs(self, full: int) -> int:
        """How many of the paper's epochs this scale runs."""
        return max(1, round(full * self.scale_params.epoch_share))

    def stream(self, *purpose: str) -> torch.Generator:
        """The random stream of this seed and case for one purpose."""
        return stream(self.seed, self.case, *purpose)

    def folder(self, root: Path, stage: str, case: int | None = None) -> Path:
        """Where a stage of this scale and seed keeps its results below a root."""
        return root / self.scale / f"seed_{self.seed}" / f"case_{case or self.case}" / stage

    def load(self, stage: str, made_by: str, case: int | None = None) -> artifacts.Stage:
        """A finished earlier stage; `made_by` is the notebook to run where it is missing."""
        found = artifacts.load_stage(self.folder(self.input_root, stage, case), f"{made_by} for case {case or self.case}")
        self.upstream[f"case_{case or self.case}/{stage}"] = found.content
        return found

    def save(
        self, stage: str, tables: Mapping[str, pd.DataFrame], policy: LSTMPolicy | None = None, last: bool = True
    ) -> artifacts.Stage:
        """Write a stage's results with a record of where they come from; `last`: this run writes no other stage."""
        saved = artifacts.save_stage(self.folder(self.output_root, stage), self.origin(), tables, policy)
        self.upstream[f"case_{self.case}/{stage}"] = saved.content
        if last:
            self.finished.remove()
        return saved

    def once(self, train: Callable[[], State], *start: Any) -> State:
        """A training of this run, or what it gave before the run was interrupted; see `Finished.once`.

        Args:
            start: all that it starts from beside the session's parameters.
        """
        return self.finished.once(train, self.params, *start)

    def banner(self) -> Markdown:
        """What kind of run this is, for the top of the notebook."""
        run = f"{self.params.case.title}, seed {self.seed}"
        if self.scale != "smoke":
            return Markdown(f"**{run}, scale `{self.scale}`.**")
        copy = f"reports/reference/notebooks/{self.notebook}_case_{self.case}.ipynb"
        return Markdown(
            f"**{run}. This is the smoke run: a few seconds, few epochs, results without meaning.** "
            f"The full run's executed copy is [{copy}](../{copy})."
        )

    def settings(self) -> pd.DataFrame:
        """What the notebook was run with."""
        return self.settings_table(self.scale_params)


def parameters_hash(params: Params) -> str:
    """A hash of every parameter that a case was run with."""
    return leaves_hash(params.leaves)


def leaves_hash(leaves: Iterable[Mapping[str, Any]]) -> str:
    """A hash of the values of leaves."""
    return digest([[leaf["file"], leaf["key"], leaf["value"]] for leaf in leaves])


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
        if self.scale != "smoke":
            return Markdown(f"**{self.seeds} seed(s), scale `{self.scale}`.**")
        report = "reports/reference/report.html"
        return Markdown(
            "**This is the smoke run on the small committed results of notebooks 01 to 04: its numbers mean nothing.** "
            f"The full run's report is [{report}](../{report})."
        )


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

    def save(self, tables: Mapping[str, pd.DataFrame], figures: Mapping[str, Figure]) -> artifacts.Stage:
        """Write the results with a record of where they come from; they belong to a seed and to no case."""
        folder = self.output_root / self.scale / f"seed_{self.seed}" / "inferred_settings"
        return artifacts.save_stage(folder, self.origin(), tables, figures=figures)

    def banner(self) -> Markdown:
        """What kind of run this is, for the top of the notebook."""
        if self.scale != "smoke":
            return Markdown(f"**Expert rows of Tables 2 to 4, seed {self.seed}, scale `{self.scale}`.**")
        copy = f"reports/reference/notebooks/{self.notebook}.ipynb"
        return Markdown(
            "**This is the smoke run: a few seconds, few evaluations, results without meaning.** "
            f"The full run's executed copy is [{copy}](../{copy})."
        )

    def settings(self) -> pd.DataFrame:
        """What the notebook was run with."""
        return self.settings_table(self.scale_params)


def _given(notebook: str, namespace: dict[str, Any]) -> tuple[dict[str, Any], Params]:
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
    return given, params


def _root(given: Mapping[str, Any], name: str, default: str) -> Path:
    return Path(given.get(name) or PROJECT / default).resolve()


def _inputs(scale: str) -> str:
    return "notebooks/inputs" if scale == "smoke" else "results"


def open_session(notebook: str, namespace: dict[str, Any]) -> Session:
    """Check what the notebook was given, and set the scale up.

    Args:
        notebook: its name without ending.
        namespace: its `globals()`, taken before anything else was defined, so that a misspelt parameter is found:
            papermill itself only logs a warning and runs on with the defaults.

    Raises:
        SessionError, ParameterError: in one sentence.
    """
    given, params = _given(notebook, namespace)
    scale, variant = given["scale"], given.get("variant", "improved")
    scale_params = params.learning.scales[scale]
    torch.set_num_threads(scale_params.threads)
    case, seed = given.get("case", 1), given["seed"]
    output_root, params_root = _root(given, "output_root", "results"), _root(given, "params_root", "params")
    made_from = inputs(notebook, params_root, scale, case, variant)
    hidden = output_root / scale / f"seed_{seed}" / f"case_{case}" / f".finished_{notebook}_{variant}"
    return Session(
        notebook=notebook,
        seed=seed,
        scale=scale,
        output_root=output_root,
        params_root=params_root,
        made_from=made_from,
        case=case,
        variant=variant,
        input_root=_root(given, "input_root", _inputs(scale)),
        params=params,
        scale_params=scale_params,
        variant_params=params.learning.variants[variant],
        finished=Finished(hidden, digest([made_from, case, seed, scale, variant])),
    )


def open_report(notebook: str, namespace: dict[str, Any]) -> ReportSession:
    """`open_session` for the report's notebook, which has no case of its own: the cases are those that the paper printed."""
    given, _ = _given(notebook, namespace)
    params_root = _root(given, "params_root", "params")
    cases = sorted(load_published(params_root))
    return ReportSession(
        cases=tuple(cases),
        seeds=given["seeds"],
        scale=given["scale"],
        input_root=_root(given, "input_root", _inputs(given["scale"])),
        output_root=_root(given, "output_root", "results/smoke/report" if given["scale"] == "smoke" else "reports/latest"),
        params_root=params_root,
    )


def open_identification(notebook: str, namespace: dict[str, Any]) -> IdentificationSession:
    """`open_session` for the notebook that infers settings, which reads the cases that the paper printed."""
    given, first = _given(notebook, namespace)
    params_root = _root(given, "params_root", "params")
    published = load_published(params_root)
    params = {case: load(params_root, case) for case in sorted(published)}
    torch.set_num_threads(first.learning.scales[given["scale"]].threads)
    return IdentificationSession(
        notebook=notebook,
        seed=given["seed"],
        scale=given["scale"],
        output_root=_root(given, "output_root", "results"),
        params_root=params_root,
        made_from=inputs(notebook, params_root, given["scale"]),
        params=params,
        published=published,
        identification=load_identification(params_root, first),
    )
