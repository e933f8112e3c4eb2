"""A smoke run that is killed at random moments and resumed, against an undisturbed one.

Three kinds of kill, each with signal 9: the whole process group of the engine; the engine alone, whose notebooks live on beside
the resumed run; and one kernel, which leaves a failed stage.
"""

import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import psutil

from torture.runs import Content, Place

KINDS = ("group", "engine", "kernel")
PATIENCE = 3600.0  # seconds in which a run without a kill must end, on the slowest machine


@dataclass
class Tally:
    """What was done, and what it did.

    Attributes:
        kills: by kind.
        resumes: runs that were started where others had left results.
        rounds: runs that ended, after any number of kills, and were compared with the undisturbed run.
        lost: finished results that were damaged, gone or made again after a kill.
        ending: results whose stage was ending at the moment of a kill: the engine had not noted it, and made them again.
        differing: results that are not those of the undisturbed run, to the last bit.
        left: files that killed processes left among the results of a finished round.
        seconds: of the undisturbed run.
    """

    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    resumes: int = 0
    rounds: int = 0
    lost: int = 0
    ending: int = 0
    differing: int = 0
    left: int = 0
    seconds: float = 0.0

    @property
    def clean(self) -> bool:
        """Whether nothing was lost, nothing differs and nothing was left."""
        return not (self.lost or self.differing or self.left)

    def row(self) -> dict[str, float]:
        """The tally as one flat row."""
        row = asdict(self)
        return {f"kills of {kind}": number for kind, number in row.pop("kills").items()} | row


def undisturbed(place: Place, **start: str) -> tuple[Content, float]:
    """The results of a run that nobody disturbs, and how long it took in seconds."""
    began = time.perf_counter()
    assert place.start(**start).wait(PATIENCE) == 0, "the undisturbed run failed"
    return place.content(), time.perf_counter() - began


def survive(
    place: Place,
    expected: Content,
    seconds: float,
    kills: int,
    seed: int,
    report: Callable[[Tally], None] = lambda tally: None,
) -> Tally:
    """Kill and resume runs in `place` until there were that many kills, let the last one end, and compare every one that ends.

    Args:
        expected: what an undisturbed run made in `seconds`, within which the moments of the kills are drawn.
        report: called after each kill.
    """
    draw, tally = random.Random(seed), Tally(seconds=seconds)
    started: list[psutil.Process] = []
    kept: dict[str, float] = {}  # the finished results of this round, and the seconds in their records
    place.clear()
    while True:
        tally.resumes += bool(place.finished())
        engine = place.start()
        killed = None
        if (number := sum(tally.kills.values())) < kills:
            killed = strike(engine.pid, KINDS[number % len(KINDS)], draw.uniform(0.0, seconds), started)
        if killed:
            tally.kills[killed] += 1
            report(tally)
        engine.wait(PATIENCE)
        found, safe = place.finished(), place.safe()
        gone = {name for name in kept if found.get(name) != kept[name]}
        tally.lost += len(gone)
        tally.ending += len(found.keys() - safe.keys())
        kept = {name: kept[name] for name in kept.keys() - gone} | safe
        if engine.returncode == 0:
            _wait_for_orphans(started)
            tally.rounds += 1
            made = place.content()
            tally.differing += sum(made.get(name) != content for name, content in expected.items())
            tally.differing += len(made.keys() - expected.keys())
            tally.left += len(place.left_behind())
            if sum(tally.kills.values()) >= kills:
                return tally
            place.clear()
            kept = {}


def strike(pid: int, kind: str, delay: float, started: list[psutil.Process]) -> str | None:
    """Kill the engine `pid` or what belongs to it after so many seconds; the kind, or None if there was nothing left to kill.

    All processes of the run are added to `started`.
    """
    engine = psutil.Process(pid)
    moment = time.perf_counter() + delay
    while time.perf_counter() < moment:
        if not _alive(engine):
            return None
        time.sleep(0.02)
    try:
        family = engine.children(recursive=True)
    except psutil.NoSuchProcess:
        return None
    started += family
    victims = [process for process in family if _is_kernel(process)]
    while kind == "kernel" and not victims and _alive(engine):  # between two stages: the next kernel, then
        time.sleep(0.05)
        victims = [process for process in _children(engine) if _is_kernel(process)]
        started += victims
    if not _alive(engine) or (kind == "kernel" and not victims):
        return None
    if kind == "group":
        os.killpg(pid, signal.SIGKILL)
    else:
        (engine if kind == "engine" else victims[0]).kill()
    return kind


def _alive(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _children(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _is_kernel(process: psutil.Process) -> bool:
    try:
        return any("ipykernel_launcher" in word for word in process.cmdline())
    except (psutil.NoSuchProcess, psutil.ZombieProcess):
        return False


def _wait_for_orphans(started: list[psutil.Process]) -> None:
    """Wait until everything that killed runs left alive has ended by itself."""
    _, alive = psutil.wait_procs(started, timeout=PATIENCE)
    assert not alive, f"processes of killed runs do not end: {alive}"
    started.clear()
