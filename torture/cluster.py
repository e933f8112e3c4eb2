"""The smoke run through SLURM: `python -m torture.cluster`, as root on Debian; `make cluster` runs it.

It installs Debian's packages where they are missing, starts a SLURM of one node on loopback with all its files in a temporary
folder, runs three case studies with four seeds through the profile in profiles/slurm, compares every result with that of a
local run to the last bit, and stops what it started. With `--accounting` the cluster has an accounting database. Packages stay
installed.
"""

import argparse
import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from torture.runs import Place

PACKAGES = {  # and a program of each
    "slurmctld": "slurmctld",
    "slurmd": "slurmd",
    "slurm-client": "sbatch",
    "munge": "munged",
}
OF_ACCOUNTING = {"slurmdbd": "slurmdbd", "mariadb-server": "mariadb-install-db"}
PROFILES = {False: "profiles/slurm/without_accounting", True: "profiles/slurm/with_accounting"}
SYSTEM = Path("/etc/slurm/slurm.conf")  # where commands inside a job look: the plugin takes SLURM_CONF out of its environment
PATIENCE = 120.0  # seconds for a package manager to answer and for the node to come up
WAITED_FOR = {"mariadbd": "database", "slurmdbd": "accountant"}  # daemons that others need, and the names of their ports
JOBS = 20.0  # seconds for cancelled jobs to end
CONFIGURATION = """\
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
{accounting}
JobAcctGatherType=jobacct_gather/none
PropagatePrioProcess=1
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
NO_ACCOUNTING = "AccountingStorageType=accounting_storage/none"
ACCOUNTING = """\
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
AccountingStoragePort={accountant}
AccountingStoragePass={folder}/munge.socket"""
ACCOUNTANT = """\
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
DbdHost={host}
DbdAddr=127.0.0.1
DbdPort={accountant}
SlurmUser=root
LogFile={folder}/slurmdbd.log
PidFile={folder}/slurmdbd.pid
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort={database}
StorageUser=root
StorageLoc=slurm
"""


class SkipError(RuntimeError):
    """SLURM is not to be had here; one sentence says why."""


def install(accounting: bool) -> None:
    """Debian's packages, if they are not there yet.

    Raises:
        SkipError: if they cannot be had.
    """
    packages = PACKAGES | (OF_ACCOUNTING if accounting else {})
    if all(shutil.which(program) for program in packages.values()):
        return
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        raise SkipError("installing SLURM needs root and apt-get")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    options = ["-o", "Acquire::Retries=0", "-o", "Acquire::http::Timeout=20", "-o", "Acquire::https::Timeout=20"]
    for words in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", *packages]):
        command = ["apt-get", *options, *words]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE)
        except subprocess.TimeoutExpired as error:
            raise SkipError(f"apt-get did not answer within {PATIENCE:.0f} s") from error
    if done.returncode:
        raise SkipError(f"apt-get could not install {', '.join(packages)}: {done.stderr.strip().splitlines()[-1:]}")


@contextmanager
def one_node(folder: Path, accounting: bool = False) -> Iterator[dict[str, str]]:
    """A SLURM of one node on loopback while the context lasts; gives the environment in which its commands find it.

    Raises:
        SkipError: if the machine has a SLURM of its own, or this one does not come up.
    """
    if SYSTEM.exists():
        raise SkipError(f"{SYSTEM} exists: this machine has a SLURM of its own, use it with a profile of profiles/slurm")
    host, memory = socket.gethostname().split(".")[0], os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    for name in ("state", "spool"):
        (folder / name).mkdir()
    configuration = folder / "slurm.conf"
    ports = dict(zip(("controller", "daemon", "accountant", "database"), _free_ports(4), strict=True))
    values = {"host": host, "folder": folder, "cores": os.cpu_count(), "memory": memory * 9 // 10, **ports}
    values["accounting"] = (ACCOUNTING if accounting else NO_ACCOUNTING).format(**values)
    configuration.write_text(CONFIGURATION.format(**values), encoding="utf-8")
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o600)
    environment = {"SLURM_CONF": str(configuration)}
    places = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
    munge = [f"--{option}={folder}/munge.{ending}" for option, ending in places.items()]
    commands = [["munged", "--foreground", "--force", *munge]]
    if accounting:
        commands += _accounting(folder, values)
    commands += [["slurmctld", "-D", "-f", str(configuration)], ["slurmd", "-D", "-f", str(configuration), "-N", host]]
    started: list[subprocess.Popen[bytes]] = []
    with (folder / "daemons.log").open("wb") as log:
        try:
            SYSTEM.parent.mkdir(exist_ok=True)
            SYSTEM.unlink(missing_ok=True)  # a link that a killed run left
            SYSTEM.symlink_to(configuration)
            for command in commands:
                started.append(subprocess.Popen(command, env={**os.environ, **environment}, stdout=log, stderr=subprocess.STDOUT))
                time.sleep(1.0)
                if command[0] in WAITED_FOR:
                    _wait_for_port(ports[WAITED_FOR[command[0]]], folder)
                if command[0] == "slurmdbd":
                    _register(environment, folder)
            _wait_until_idle(environment, folder)
            yield environment
        finally:
            _cancel_jobs(environment)
            SYSTEM.unlink(missing_ok=True)
            for process in reversed(started):
                process.terminate()
                try:
                    process.wait(20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def _accounting(folder: Path, values: Mapping[str, Any]) -> list[list[str]]:
    """The commands of a database with nothing in it and of SLURM's accounting daemon."""
    configuration, data = folder / "slurmdbd.conf", folder / "database"
    configuration.write_text(ACCOUNTANT.format(**values), encoding="utf-8")
    configuration.chmod(0o600)
    empty = ["mariadb-install-db", "--no-defaults", "--user=root", f"--datadir={data}", "--auth-root-authentication-method=normal"]
    done = subprocess.run(empty, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SkipError(f"no database could be made: {(done.stderr or done.stdout).strip()[-500:]}")
    place = [f"--datadir={data}", f"--socket={folder}/database.socket", f"--pid-file={folder}/database.pid"]
    database = ["mariadbd", "--no-defaults", "--user=root", *place, "--bind-address=127.0.0.1", f"--port={values['database']}"]
    return [database, ["slurmdbd", "-D"]]


def _register(environment: dict[str, str], folder: Path) -> None:
    """Tell the accounting of the cluster and of an account for its user."""
    user = getpass.getuser()
    for words in ("cluster loopback", "account stages cluster=loopback", f"user {user} account=stages cluster=loopback"):
        command = ["sacctmgr", "--immediate", "add", *words.split()]
        done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SkipError(f"{' '.join(command)}: {done.stdout}{done.stderr}\n{_tail(folder)}")


def _wait_for_port(port: int, folder: Path) -> None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        time.sleep(0.5)
    raise SkipError(f"nobody answered on port {port} within {PATIENCE:.0f} s:\n{_tail(folder)}")


def _tail(folder: Path) -> str:
    return (folder / "daemons.log").read_text(encoding="utf-8", errors="replace").strip()[-1500:]


def _cancel_jobs(environment: dict[str, str]) -> None:
    """Jobs would outlive the daemons. At the end of an undisturbed run there are none."""
    found = {**os.environ, **environment}
    subprocess.run(["scancel", "--user", getpass.getuser()], env=found, capture_output=True, check=False)
    end = time.monotonic() + JOBS
    while time.monotonic() < end:
        if not subprocess.run(["squeue", "-h"], env=found, capture_output=True, check=False).stdout.strip():
            return
        time.sleep(0.5)


def _free_ports(number: int) -> list[int]:
    sockets = [socket.socket() for _ in range(number)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()


def _wait_until_idle(environment: dict[str, str], folder: Path) -> None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = subprocess.run(
            ["sinfo", "-h", "-o", "%T"], env={**os.environ, **environment}, capture_output=True, text=True, check=False
        )
        if found.stdout.strip() == "idle":
            return
        time.sleep(1.0)
    raise SkipError(f"the node did not come up within {PATIENCE:.0f} s: {found.stdout}{found.stderr}\n{_tail(folder)}")


def compare(
    seeds: int, targets: Sequence[str], environment: dict[str, str], folder: Path, profile: str
) -> tuple[int, int, float, float]:
    """The same run here and through SLURM: results, those that differ, and the seconds of both."""
    local = Place.copied(folder / "local", seeds=seeds, targets=tuple(targets))
    cluster = replace(Place.copied(folder / "cluster", seeds=seeds, targets=tuple(targets)), profile=profile)
    seconds = []
    for place, extra in ((local, {}), (cluster, environment)):
        began = time.perf_counter()
        with (place.project / "said.log").open("wb") as log, place.start(output=log, **extra) as run:
            try:
                status = run.wait()
            finally:
                if run.poll() is None:  # stopped from outside
                    os.killpg(run.pid, signal.SIGKILL)
        seconds.append(time.perf_counter() - began)
        if status:
            logs = [place.project / "said.log", *place.project.glob(".snakemake/slurm_logs/**/*.log")]
            words = [path.read_text(encoding="utf-8", errors="replace")[-2000:] for path in logs]
            raise RuntimeError("\n".join([f"the run in {place.project.name}/ failed:", *words]))
    here, there = local.content(), cluster.content()
    differing = sum(there.get(name) != content for name, content in here.items()) + len(there.keys() - here.keys())
    return len(here), differing, seconds[0], seconds[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status: 0 also where SLURM is not to be had, unless it is required."""
    parser = argparse.ArgumentParser(prog="python -m torture.cluster", description="The smoke run through SLURM, and here.")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--case", type=int, help="only the offline learning of this case")
    parser.add_argument("--accounting", action="store_true", help="with an accounting database, and the profile for one")
    parser.add_argument("--required", action="store_true", help="fail where SLURM is not to be had")
    given = parser.parse_args(arguments)
    names = range(given.seeds) if given.case else ()
    targets = [f"results/smoke/seed_{seed}/case_{given.case}/offline_improved/record.json" for seed in names]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # stopped from outside, it stops what it started all the same
    try:
        install(given.accounting)
        with tempfile.TemporaryDirectory(prefix="slurm") as name:
            folder = Path(name)
            with one_node(folder, given.accounting) as environment:
                profile = PROFILES[given.accounting]
                number, differing, here, there = compare(given.seeds, targets, environment, folder, profile)
    except SkipError as error:
        print(f"SKIPPED: the run through SLURM: {error}", flush=True)
        return 1 if given.required else 0
    times = f"{here:.0f} s here, {there:.0f} s through SLURM"
    print(f"{number} results of {given.seeds} seed(s): {differing} differ; {times}", flush=True)
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
