"""The command line: `python -m helpers --help`."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

COMMANDS = {
    "run": ("helpers.runs.run", "one notebook, by papermill"),
    "refresh": ("helpers.runs.refresh", "all notebooks at their defaults, and their outputs stored in them"),
    "publish": ("helpers.report.publish", "the last report becomes the committed reference"),
    "search": ("helpers.evidence.search", "the printed algorithms' best settings, a run of hours that can be stopped"),
    "verdicts": ("helpers.report.verdicts", "every verdict of a published report again, from its CSV files alone"),
    "plant": ("helpers.report.plant_report", "from the historian file of your own plant to a controller"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of the list; returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m helpers",
        usage="%(prog)s COMMAND ...",
        description="\n".join(f"{name:8} {what}" for name, (_, what) in COMMANDS.items()),
        epilog="python -m helpers COMMAND --help tells more of each.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of the above")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="its own")
    given = parser.parse_args(arguments)
    return int(import_module(COMMANDS[given.command][0]).main(given.arguments))


if __name__ == "__main__":
    sys.exit(main())
