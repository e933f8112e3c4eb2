"""A picture made small."""

import io

import numpy as np
from PIL import Image

from helpers.runs.pictures import smaller


def test_areas_keep_their_colours_however_many_others_there_are():
    """Two bands of nearly the same pale colour beside a square of noise, with more colours than a palette holds."""
    picture = np.zeros((60, 300, 3), dtype=np.uint8)
    picture[:, :100], picture[:, 100:200] = (196, 222, 240), (196, 232, 223)
    picture[:, 200:] = np.random.default_rng(0).integers(0, 256, (60, 100, 3))
    png = io.BytesIO()
    Image.fromarray(picture).save(png, format="PNG")
    small = np.asarray(Image.open(io.BytesIO(smaller(png.getvalue()))).convert("RGB"))
    assert np.array_equal(small[:, :200], picture[:, :200])
    assert len(smaller(png.getvalue())) < len(png.getvalue())
