import numpy as np
import pytest
from pictures import pixels

from sgns.evaluation.histogram import SMALLEST, error_bins, histogram_figure
from sgns.evaluation.metrics import ParticleErrors


def test_bins_are_equally_wide_on_the_axis_and_hold_everything():
    values = 10.0 ** np.random.default_rng(0).uniform(-11.0, -3.0, 500)
    bins = error_bins([values, values[:3]])
    assert np.diff(np.log10(bins)) == pytest.approx(0.25)
    assert np.histogram(values, bins)[0].sum() == 500


@pytest.mark.parametrize("values", [np.zeros(4), np.full(4, 1e-6), np.full(1, 1e-4)])
def test_equal_errors_still_have_a_bin(values):
    bins = error_bins([values])
    assert len(bins) >= 2 and np.histogram(np.maximum(values, SMALLEST), bins)[0].sum() == len(values)


def test_shares_add_up_to_all_particles_of_all_runs():
    rng = np.random.default_rng(1)
    runs = [
        ParticleErrors(10.0 ** rng.uniform(-9, -4, 50), 10.0 ** rng.uniform(-13, -6, 50)) for _ in range(3)
    ]
    figure = histogram_figure(runs)
    for axis in figure.axes:
        assert sum(bar.get_height() for bar in axis.patches) == pytest.approx(100.0)
    medians = [axis.lines[0].get_xdata()[0] for axis in figure.axes]
    assert medians[0] == pytest.approx(np.median(np.concatenate([run.reduction for run in runs])))
    pixels(figure)
