"""The stand-ins for another processor: they change how numbers are rounded, and nothing else."""

import json
import os
import platform
import subprocess
import sys

import pytest

from helpers.runs.sources import PROJECT
from torture import processors

pytestmark = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the stand-ins are of x86-64")
WHAT = """
import json, torch
from torture.processors import dispatched
matrix = torch.rand(200, 200, generator=torch.Generator().manual_seed(0))
found = {"torch": torch.backends.cpu.get_cpu_capability(), "numpy": [name for name, has in dispatched().items() if has]}
print(json.dumps(found | {"product": (matrix @ matrix @ matrix).double().sum().item()}))
"""


def seen(*prefix):
    done = subprocess.run([*prefix, sys.executable, "-c", WHAT], cwd=PROJECT, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.torture
def test_an_older_processor_has_less_and_computes_the_same_but_for_rounding():
    older = seen(sys.executable, "-m", "torture.processors", "older", "--")
    assert older["torch"] == "DEFAULT"
    assert not {"AVX2", "X86_V3", "AVX512F", "X86_V4"} & set(older["numpy"])
    assert older["product"] == pytest.approx(seen()["product"], rel=1e-5)


def test_the_command_s_exit_status_is_returned_and_a_stand_in_with_nothing_to_leave_out_says_so(monkeypatch, capsys):
    assert processors.main(["older", "--", sys.executable, "-c", "import sys; sys.exit(3)"]) == 3
    assert "ATEN_CPU_CAPABILITY" not in os.environ
    monkeypatch.setattr(processors.platform, "machine", lambda: "arm64")
    assert processors.main(["older", "--", "false"]) == 0
    assert "SKIPPED: this machine (arm64)" in capsys.readouterr().out
