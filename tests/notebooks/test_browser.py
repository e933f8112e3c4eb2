"""Every notebook as a reader meets it: opened in JupyterLab by a browser, all cells run, and a picture taken (`make browser`).

The server works on a copy of the project, because JupyterLab saves what it runs. Pictures go to results/browser/.
"""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from helpers.runs.sources import PROJECT

NOTEBOOKS = sorted(path.stem for path in (PROJECT / "notebooks").glob("*.ipynb"))
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for found in map(shutil.which, BROWSERS) if found), None)
PICTURES = PROJECT / "results/browser"
PARTS = ("notebooks", "params", "reports/reference", "reports/template", "src")
SETTINGS = {  # every cell is drawn, not only those in view; no question about news in the pictures
    "notebook-extension/tracker": '{"windowingMode": "none"}',
    "apputils-extension/notification": '{"fetchNews": "false", "checkForUpdates": false}',
}
WIDTH, TALLEST = 1200, 16000  # pixels
PATIENCE = 300.0  # seconds for the cells of a notebook
CELLS = "() => window.jupyterapp.shell.currentWidget.content.model.sharedModel.toJSON().cells"
PANEL = "() => document.querySelector('.jp-WindowedPanel-outer')"

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason=f"none of {', '.join(BROWSERS)} is installed; on Debian: apt-get install chromium"),
]


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The address of a JupyterLab on a copy of the project."""
    root = tmp_path_factory.mktemp("lab")
    for part in PARTS:
        shutil.copytree(PROJECT / part, root / part, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for name, content in SETTINGS.items():
        path = root / f"settings/@jupyterlab/{name}.jupyterlab-settings"
        path.parent.mkdir(parents=True)
        path.write_text(content, encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = ["--no-browser", "--allow-root", "--LabApp.expose_app_in_browser=True", "--IdentityProvider.token="]
    options += [f"--ServerApp.root_dir={root}", f"--ServerApp.port={port}"]
    options += [f"--LabApp.user_settings_dir={root / 'settings'}", f"--LabApp.workspaces_dir={root / 'workspaces'}"]
    environment = os.environ | {"PYTHONPATH": str(root / "src"), "JUPYTER_RUNTIME_DIR": str(root / "runtime")}
    environment.pop("MPLBACKEND", None)
    with (root / "log.txt").open("w", encoding="utf-8") as log:
        server = subprocess.Popen([sys.executable, "-m", "jupyterlab", *options], env=environment, stdout=log, stderr=log)
        try:
            yield f"http://127.0.0.1:{port}/lab"
        finally:
            server.terminate()
            server.wait(30)


@pytest.fixture(scope="module")
def browser():
    """Debian's Chromium under playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; make browser installs it")
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@contextmanager
def opened(browser, lab, notebook):
    """A page with a notebook of which all cells were run."""
    page = browser.new_page(viewport={"width": WIDTH, "height": 900})
    page.set_default_timeout(1000 * PATIENCE)
    for _ in range(60):
        try:
            page.goto(f"{lab}/workspaces/{notebook}/tree/notebooks/{notebook}.ipynb")
            break
        except Exception:  # the server is not up yet
            time.sleep(1)
    page.wait_for_function("() => window.jupyterapp?.shell.currentWidget?.content?.model?.cells?.length > 0")
    page.evaluate("async () => { await window.jupyterapp.shell.currentWidget.sessionContext.ready }")
    page.evaluate("() => window.jupyterapp.shell.collapseLeft()")
    try:
        for what in ("clear-all-cell-outputs", "run-all-cells"):
            page.evaluate(f"() => window.jupyterapp.commands.execute('notebook:{what}')")
        yield page
    finally:
        page.evaluate("() => window.jupyterapp.serviceManager.sessions.shutdownAll()")
        page.close()


def picture(page, name):
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.set_viewport_size({"width": WIDTH, "height": min(TALLEST, page.evaluate(f"{PANEL}.scrollHeight") + 150)})
    page.evaluate(f"{PANEL}.scrollTo(0, 0)")
    page.wait_for_timeout(1500)  # formulas are set
    page.screenshot(path=PICTURES / f"{name}.png")


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_a_notebook_runs_in_the_browser_without_an_error(lab, browser, notebook):
    with opened(browser, lab, notebook) as page:
        cells = [cell for cell in page.evaluate(CELLS) if cell["cell_type"] == "code"]
        picture(page, notebook)
        assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
        assert [output for cell in cells for output in cell["outputs"] if output["output_type"] in ("error", "stream")] == []
        assert page.locator(".jp-Notebook .MathJax_Error, .jp-Notebook mjx-merror").count() == 0


def test_a_notebooks_links_open_the_code_the_next_notebook_and_the_full_run(lab, browser):
    with opened(browser, lab, "01_demonstrations") as page:
        tab = page.evaluate("() => window.jupyterapp.shell.currentWidget.id")
        full = "reports/reference/notebooks/01_demonstrations_case_1.ipynb"
        for words, title in (("02 Offline", "02_offline_irl.ipynb"), ("rollout.py", "rollout.py"), (full, full.rpartition("/")[2])):
            page.evaluate("tab => window.jupyterapp.shell.activateById(tab)", tab)
            page.get_by_role("link", name=words).first.click()
            page.locator(".lm-TabBar-tabLabel", has_text=re.compile(f"^{re.escape(title)}$")).first.wait_for()


def test_a_slider_draws_the_figure_anew(lab, browser):
    with opened(browser, lab, "10_sliders") as page:
        figure = page.locator(".jupyter-widgets img").first
        before = figure.get_attribute("src")
        page.locator(".jupyter-widgets .noUi-handle").first.press("ArrowRight")
        page.wait_for_function("before => document.querySelector('.jupyter-widgets img')?.src !== before", arg=before)
        picture(page, "10_sliders_moved")
