"""Pictures of pixels, small enough to be committed."""

import io
from typing import Any

COLOURS = 256  # of a PNG: a third of the size


def smaller(png: bytes) -> bytes:
    """The PNG with a palette of its most frequent colours, if that is smaller: areas keep theirs, edges take the nearest."""
    from PIL import Image  # noqa: PLC0415  # a run without pictures starts without it

    picture, palette, found = Image.open(io.BytesIO(png)).convert("RGB"), Image.new("P", (1, 1)), io.BytesIO()
    counted: Any = sorted(picture.getcolors(picture.width * picture.height) or [], reverse=True)
    palette.putpalette([channel for _, colour in counted[:COLOURS] for channel in colour])
    picture.quantize(palette=palette, dither=Image.Dither.NONE).save(found, format="PNG", optimize=True)
    return min(png, found.getvalue(), key=len)
