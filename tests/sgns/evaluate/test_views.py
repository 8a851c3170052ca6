"""The views in three dimensions: the whole bed and the subspace."""

import numpy as np
import pytest
from pictures import pixels
from surrogates import fitted
from synthetic import make_run, start_positions

from sgns.data.run import Run
from sgns.evaluate.figures import latent_path, subspace_view
from sgns.evaluate.solid_view import solid_views, upper_scale


@pytest.fixture
def pair(tmp_path):
    paths = [
        make_run(tmp_path / f"{seed}.h5", frames=12, n=300, seed=seed, producer=producer)
        for seed, producer in ((1, "mpm"), (2, "rollout"))
    ]
    with Run(paths[0]) as truth, Run(paths[1]) as prediction:
        yield truth, prediction, fitted(paths, 4)


def test_whole_bed_is_drawn_three_times_with_one_scale_of_displacement(pair):
    truth, prediction, _ = pair
    views = solid_views(truth, prediction, 9, start_positions(300))
    assert list(views) == ["simulated (MPM)", "network", "network, its error"]
    pictures = [pixels(view) for view in views.values()]
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(pictures[0], pictures[1])
    bars = [view.axes[-1].get_xlim() for view in views.values()]
    assert bars[0] == bars[1]


@pytest.mark.parametrize(
    "scene",
    [
        {"blade": None, "kind": "wheel", "diameter": 0.15, "width": 0.08},
        {"blade": None, "kind": "body"},
        {"blade": None, "speed": 1e-12, "depth": 0.0},
    ],
)
def test_other_bodies_and_soil_that_rests(tmp_path, scene):
    with Run(make_run(tmp_path / "run.h5", frames=6, n=200, scene=scene)) as run:
        for view in solid_views(run, run, 5, start_positions(200)).values():
            pixels(view)


def test_scale_of_nothing():
    assert upper_scale(np.zeros(5)).vmax == 1.0


def test_path_in_the_subspace_is_the_projection(pair):
    truth, _, basis = pair
    whole = latent_path(truth, basis)
    assert whole == pytest.approx(basis.transform(truth.positions()).numpy())
    assert whole.shape == (truth.frame_count, 4, 3)


def test_subspace_shows_both_paths_and_the_body(pair):
    truth, prediction, basis = pair
    paths = (latent_path(truth, basis), latent_path(prediction, basis))
    figure = subspace_view(truth, prediction, paths, 9)
    axis = figure.axes[0]
    assert [text.get_text() for text in axis.texts] == ["1", "2", "3", "4"]
    assert len(axis.lines) == 8  # a way for every mode of both
    assert len(axis.lines[0].get_data_3d()[0]) == 10
    pixels(figure)
