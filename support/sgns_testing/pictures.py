"""Looking at figures in tests."""

import io

import numpy as np
from matplotlib import image
from matplotlib.figure import Figure

from sgns.evaluate import figures

SMALLEST_TEXT = 8.0
"""Of every picture of a report [points]."""


def pixels(figure: Figure) -> np.ndarray:
    """The drawn picture, shape (height, width, channels); fails if it is empty."""
    picture = image.imread(io.BytesIO(figures.png(figure)))
    assert picture[..., :3].std() > 0.01
    return picture
