"""One stage = one notebook, executed by papermill. `python -m helpers run --help` tells how."""

import helpers.runs.quick_start  # noqa: F401  (before nbformat)

# isort: split
import argparse
import base64
import os
import re
import shutil
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import nbformat
import papermill
import psutil
from nbclient.exceptions import DeadKernelError
from papermill.exceptions import PapermillExecutionError
from traitlets.config import Config

from helpers.runs.pictures import smaller
from helpers.runs.request import SessionError, check_parameters, check_place
from helpers.runs.scratch import beside, sweep
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import ParameterError
from helpers.settings.paper import HEADLINE

NOTEBOOKS = PROJECT / "notebooks"
DAY = 86400.0  # seconds
WIDGET = "application/vnd.jupyter.widget-view+json"


def execute(notebook: str, output: Path, parameters: dict[str, Any]) -> None:
    """Run a notebook with papermill; the executed copy, whole or failed, ends up at `output`.

    Raises:
        ParameterError, SessionError: if the parameters cannot be used; nothing was run then.
        PapermillExecutionError: if a cell failed; its traceback stands in the executed copy.
    """
    source, known = NOTEBOOKS / f"{notebook}.ipynb", sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))
    if notebook not in known:
        raise SessionError(f"{source}: there is no such notebook; the notebooks are {', '.join(known)}")
    check_parameters(notebook, parameters)
    output.parent.mkdir(parents=True, exist_ok=True)
    sweep(output)
    # Kernels started side by side race for TCP ports; where the platform has Unix sockets, a fresh folder for each
    # kernel's sockets avoids the race. Its path must stay short: socket names are limited to about 100 characters.
    _forget_dead_sockets()
    with tempfile.TemporaryDirectory(prefix=f"hk{os.getpid()}_") as sockets:
        config = Config()
        # Papermill has every output by the time it stops the kernel, so the kernel need not take itself apart first.
        config.NotebookClient.shutdown_kernel = "immediate"
        if parameters.get("variant", HEADLINE) != HEADLINE:
            config.NotebookClient.skip_cells_with_tag = HEADLINE  # cells with the variant's name are for it alone
        if os.name == "posix":
            config.KernelManager.transport = "ipc"
            config.KernelManager.ip = str(Path(sockets) / "k")
        partial = beside(output)
        try:
            papermill.execute_notebook(
                source,
                partial,
                parameters=parameters,
                kernel_name="python3",
                cwd=str(NOTEBOOKS),
                progress_bar=False,
                log_output=False,
                config=config,
            )
        finally:
            if partial.exists():
                try:
                    strip_machine(partial)
                    partial.replace(output)
                except nbformat.reader.NotJSONError:  # half-written, because the disk is full: what went wrong is on its way
                    partial.unlink()


def _forget_dead_sockets() -> None:
    """Remove the folders of sockets that killed runs of this machine left a day ago or earlier."""
    for folder in Path(tempfile.gettempdir()).glob("hk*_*"):
        found = re.match(r"hk(\d+)_", folder.name)
        with suppress(OSError):
            if found and not psutil.pid_exists(int(found[1])) and time.time() - folder.stat().st_mtime > DAY:
                shutil.rmtree(folder, ignore_errors=True)


def _forget_finished(notebook: str, parameters: dict[str, Any]) -> None:
    """Remove the finished trainings of a notebook that has ended: what it skipped may have been its last stage."""
    place = [parameters.get(name) for name in ("scale", "seed", "case")]
    if None not in place:  # as the Snakefile gives them; a run by hand keeps its few files until the stage is run again
        folder = Path(parameters.get("output_root") or PROJECT / "results") / "{}/seed_{}/case_{}".format(*place)
        shutil.rmtree(folder / f".finished_{notebook}_{parameters.get('variant', HEADLINE)}", ignore_errors=True)


def strip_machine(path: Path) -> None:
    """Take papermill's paths and times, and widgets, out of an executed notebook, so that it can be compared; pictures shrink."""
    notebook = nbformat.read(path, as_version=4)
    for name in ("papermill", "widgets"):
        notebook.metadata.pop(name, None)
    for cell in notebook.cells:
        cell.metadata.pop("papermill", None)
        cell.metadata.pop("execution", None)
        if "injected-parameters" in cell.metadata.get("tags", []):
            cell.source = re.sub(r'(?m)^(\w+_root) = ".+"$', r'\1 = ""  # a folder of the machine that ran this', cell.source)
        tags = [tag for tag in cell.metadata.get("tags", []) if tag != "papermill-error-cell-tag"]
        if tags:
            cell.metadata["tags"] = tags
        else:
            cell.metadata.pop("tags", None)
        if "outputs" in cell:  # a widget lives in the kernel that made it
            cell.outputs = [output for output in cell.outputs if WIDGET not in output.get("data", {})]
        for output in cell.get("outputs", []):
            if picture := output.get("data", {}).get("image/png"):
                output.data["image/png"] = base64.b64encode(smaller(base64.b64decode(picture))).decode() + "\n"
            if output.output_type == "stream":  # a warning names the file of a package
                output.text = output.text.replace(f"{sysconfig.get_path('purelib')}/", "").replace(f"{PROJECT}/", "")
    nbformat.write(notebook, path)


def _value(name: str, text: str) -> str | int:
    """A parameter from the command line: folders are those of the caller's directory, for the kernel works elsewhere."""
    if name.endswith("_root"):
        return str(Path(text).resolve()) if text else ""
    return int(text) if re.fullmatch(r"-?[0-9]+", text) else text


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m helpers run", description="Run one notebook of the reproduction by papermill.")
    parser.add_argument("notebook", help="its name without ending, such as 02_offline_irl")
    parser.add_argument("output", type=Path, help="where the executed copy goes")
    parser.add_argument(
        "-p", "--parameter", nargs=2, action="append", default=[], metavar=("NAME", "VALUE"), help="a parameter of the notebook"
    )
    given = parser.parse_args(arguments)
    os.environ["TQDM_DISABLE"] = "1"
    parameters = {name: _value(name, text) for name, text in given.parameter}
    if parameters.get("seed"):
        os.environ["MPLBACKEND"] = "agg"  # copies of other seeds than the first are not published: no pictures in them
    else:
        os.environ.pop("MPLBACKEND", None)  # the kernel's own, which puts pictures into the notebook
    what = " ".join([given.notebook, *(f"{name}={value}" for name, value in parameters.items() if not name.endswith("_root"))])
    failed = given.output.with_suffix(".failed")  # what went wrong, for the summary at the end of a long run
    status = 1
    try:
        check_place("output", given.output)
        failed.unlink(missing_ok=True)
        execute(given.notebook, given.output, parameters)
    except SessionError as error:  # in the command itself, perhaps in its place: nothing is written
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ParameterError as error:
        status, sentence = 2, f"{what}: {error}"
    except PapermillExecutionError as error:
        sentence = f"{what}: {error.ename}: {error.evalue} (executed copy with the traceback: {given.output})"
    except DeadKernelError:
        sentence = f"{what}: the kernel died (executed copy up to there: {given.output})"
    except OSError as error:
        sentence = f"{what}: {error.filename or given.output}: could not be written: {error.strerror or error}"
    else:
        _forget_finished(given.notebook, parameters)
        print(f"done: {what}")
        return 0
    print(f"error: {sentence}", file=sys.stderr)
    with suppress(OSError):  # the disk may be full; or there is no folder, if nothing was run
        failed.write_text(f"{sentence}\n", encoding="utf-8")
    return status
