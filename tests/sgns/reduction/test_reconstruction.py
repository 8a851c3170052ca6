import numpy as np
import pytest
import torch
from surrogates import fitted, small_dataset
from synthetic import make_run

from sgns.reduction.reconstruction import reconstruction_curve
from sgns.runs import Run


def test_reconstruction_curve_is_the_error_of_projecting(tmp_path):
    dataset = small_dataset(tmp_path)
    basis = fitted(dataset.runs("train"), modes=6)
    path = dataset.runs("test")[0]
    curve = reconstruction_curve([path], basis)
    with Run(path) as run:
        true = torch.from_numpy(run.positions()).double()
        for r in (1, 3, 6):
            part = basis.sliced(r)
            direct = float((part.inverse(part.transform(true)) - true).square().mean())
            assert curve[r] == pytest.approx(direct, rel=1e-6)
    assert (np.diff(curve) <= 0.0).all()


def test_reconstruction_curve_of_the_training_runs_is_the_basis_own(tmp_path):
    paths = [make_run(tmp_path / f"{i}.h5", frames=10, n=40, seed=i) for i in range(3)]
    basis = fitted(paths, modes=8)
    curve = reconstruction_curve(paths, basis)
    assert curve[1:] == pytest.approx(np.asarray(basis.residual_mse()), rel=1e-4, abs=1e-14)


def test_no_runs_give_no_curve(tmp_path):
    basis = fitted(small_dataset(tmp_path).runs("train"), modes=3)
    assert np.isnan(reconstruction_curve([], basis)).all()
