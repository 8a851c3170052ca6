"""Errors against the training data's solver: those of `sgns evaluate`."""

from pathlib import Path

import numpy as np
import pytest
from surrogates import FakeSimulator, fitted, frozen_latent, small_dataset

from sgns.evaluation.evaluate import evaluate
from sgns.frontier.own_errors import own_errors


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"))


def simulator(dataset, **kw):
    return FakeSimulator(fitted(dataset.runs("train"), 6), dataset.runs("train") + dataset.runs("test"), **kw)


def test_they_are_those_of_evaluate(dataset, tmp_path):
    known = simulator(
        dataset, mistake=lambda z, d: z + 1e-3 * np.arange(len(z))[:, None, None], force_factor=1.1
    )
    found = own_errors(known, dataset.runs("test"), dataset.runs("train")).row()
    told = evaluate(known, dataset, tmp_path, checkpoint=Path("best.ckpt")).total.row()
    assert set(found) == set(told)
    # A run file keeps positions in float32.
    for key in ("rmse_total_mm", "skill_frozen", "surface_rmse_mm", "force_nrmse", "draft_mpe_percent"):
        assert found[key] == pytest.approx(told[key], rel=1e-3)


def test_the_truth_leaves_only_the_reduction(dataset):
    scores = own_errors(simulator(dataset), dataset.runs("test"), dataset.runs("train"))
    assert scores.force.overall_nrmse == 0
    assert scores.rmse_mm("total") == pytest.approx(scores.rmse_mm("reduction"), rel=1e-6)


def test_a_frozen_bed_has_no_skill(dataset):
    known = simulator(dataset, mistake=frozen_latent)
    scores = own_errors(known, dataset.runs("test"), dataset.runs("train"))
    # But for what the reduction leaves out of the frame it is frozen in.
    assert abs(scores.skill("frozen")) < 0.2
