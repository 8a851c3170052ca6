"""Means and scales: round trip, nothing blown up, float64 before float32."""

import numpy as np
import pytest
import torch

from sgns.model.dynamics import Standardiser, fitted_band, together


def test_round_trip() -> None:
    torch.manual_seed(0)
    x = 3.0 + torch.randn(200, 4, 3, dtype=torch.float64) * torch.rand(4, 3, dtype=torch.float64)
    standard = Standardiser.fit(x)
    torch.testing.assert_close(standard.denormalise(standard.normalise(x)), x, rtol=0, atol=1e-6)
    y = standard.normalise(x)
    torch.testing.assert_close(y.mean(0), torch.zeros(4, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(y.square().mean(0), torch.ones(4, 3), rtol=1e-4, atol=0)


def test_zero_variance_stays_small() -> None:
    x = torch.zeros(50, 2, 3, dtype=torch.float64)
    x[:, 0] = torch.randn(50, 3)
    x[:, 1, 1] = 1e-12 * torch.randn(50)
    y = Standardiser.fit(x, floor=0.01).normalise(x)
    assert torch.isfinite(y).all()
    assert y[:, 1].abs().max() < 1e-9


def test_a_constant_is_scaled_by_one() -> None:
    constant = torch.full((9, 2, 3), 7.3, dtype=torch.float64)
    for centred in (True, False):
        standard = Standardiser.fit(constant if centred else 0 * constant, centred=centred)
        assert torch.equal(standard.scale, torch.ones(2, 3, dtype=torch.float64))


def test_without_centring_rest_stays_zero() -> None:
    standard = Standardiser.fit(1.0 + torch.randn(50, 3), centred=False)
    assert torch.equal(standard.normalise(torch.zeros(3)), torch.zeros(3))


def test_small_movements_of_large_positions_survive() -> None:
    x = 18.0 + 1e-7 * torch.arange(10, dtype=torch.float64)[:, None]
    y = Standardiser.fit(x).normalise(x)
    torch.testing.assert_close(y[:, 0].diff(), y[:, 0].diff().mean().expand(9), rtol=1e-5, atol=0)


def test_an_empty_quantity() -> None:
    standard = Standardiser.fit(torch.zeros(5, 0))
    assert standard.normalise(torch.zeros(2, 0)).shape == (2, 0)


def test_a_band_holds_nine_of_ten_truths() -> None:
    """Two members one apart, so that their deviation is √½, and truths 0, 1, ... 100 from their mean."""
    members = np.stack([np.full(101, 4.5), np.full(101, 5.5)])
    truth = 5.0 + np.arange(101.0) * (-1) ** np.arange(101)
    factor = fitted_band(members, truth)
    assert factor == pytest.approx(90.0 / np.sqrt(0.5))
    mean, half = together(members, factor)
    assert half is not None
    assert np.mean(np.abs(truth - mean) <= half + 1e-9) == pytest.approx(91 / 101)


def test_what_members_agree_on_has_no_spread_and_no_say_in_the_band() -> None:
    alike = np.stack([np.ones((5, 3))] * 2)
    _, none = together(alike, 7.0)
    assert none is not None and not none.any() and fitted_band(alike, np.zeros((5, 3))) == 1.0
    members = np.stack([[0.0, 1.0, np.nan], [2.0, 1.0, np.nan]])  # of three truths one can be told
    assert fitted_band(members, np.array([3.0, 9.0, 9.0])) == pytest.approx(np.sqrt(2.0))
    said, half = together(alike[:1], 7.0)
    assert half is None and said is not None
