"""Imported before nbformat, by the command line and as a plugin of pytest: saves two seconds of every process that reads notebooks.

nbformat's validator would build a grammar of international web addresses for a check that no notebook asks for. It is optional:
where the package is not to be had, that check is left out.
"""

import sys

sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
