"""Another processor, as far as this machine can play one: `python -m torture.processors older -- COMMAND`.

The numerical libraries choose their kernels by what the processor offers. Told to offer less, they round otherwise, as they would
on another machine; what is green here only by this machine's rounding fails.
"""

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module

STAND_INS = {
    # torch's own kernels, its products (MKL, oneDNN), those of numpy and scipy (OpenBLAS), the C library's functions; numpy's own
    # loops are added below.
    "older": {
        "ATEN_CPU_CAPABILITY": "default",
        "MKL_CBWR": "COMPATIBLE",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "OPENBLAS_CORETYPE": "Nehalem",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
    },
    "avx2": {"ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2", "OPENBLAS_CORETYPE": "Haswell"},
}
KEPT = {"older": (), "avx2": ("X86_V3", "AVX2", "FMA3")}  # of numpy's own loops


def dispatched() -> dict[str, bool]:
    """The features of a processor for which numpy has loops of its own, and whether this machine has them."""
    numpy = import_module("numpy._core._multiarray_umath")
    return {name: numpy.__cpu_features__[name] for name in numpy.__cpu_dispatch__}


def environment(name: str) -> dict[str, str] | None:
    """The environment variables that make this machine stand for another; None where it has nothing to leave out."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return None
    features = dispatched()
    if name == "avx2" and not any(has for feature, has in features.items() if feature.startswith(("X86_V4", "AVX512"))):
        return None
    left_out = [feature for feature, has in features.items() if has and feature not in KEPT[name]]
    return STAND_INS[name] | ({"NPY_DISABLE_CPU_FEATURES": " ".join(left_out)} if left_out else {})


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the command's exit status, or 0 where there is nothing to leave out."""
    parser = argparse.ArgumentParser(prog="python -m torture.processors", description="Run a command as on another processor.")
    parser.add_argument("name", choices=STAND_INS, help="older: of before 2013; avx2: where the machine has AVX-512")
    parser.add_argument("command", nargs="+", help="what to run, after --")
    given = parser.parse_args(arguments)
    found = environment(given.name)
    if found is None:
        print(f"SKIPPED: this machine ({platform.machine()}) has nothing that '{given.name}' would leave out")
        return 0
    print("as on another processor:", *(f"{name}='{value}'" for name, value in found.items()), flush=True)
    return subprocess.run(given.command, env=os.environ | found, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
