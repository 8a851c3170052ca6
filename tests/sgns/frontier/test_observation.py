"""What is kept of a run: the same motion looks the same on every bed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mpm_warp import Bed, Excavation
from sgns.config import UserError
from sgns.frontier.observation import Observation, compare, errors, observe, read_observation

FRAMES = 25


def scene_on(spacing: float, per_cell: float) -> Excavation:
    bed = Bed(size=(0.4, 0.2, 0.1), spacing=spacing, particles_per_cell=per_cell)
    return Excavation(bed=bed, motion="rest", duration=(FRAMES - 1) / 60.0, rake=0.0)


def sheared(start: np.ndarray, time: float) -> np.ndarray:
    """A motion that is linear in space: every particle's displacement follows from where it began."""
    moved = start.copy()
    moved[:, 0] += time * (0.1 + 0.5 * start[:, 2])
    moved[:, 2] += 0.05 * time
    return moved


def observed(spacing: float, per_cell: float, moving=sheared) -> Observation:
    scene = scene_on(spacing, per_cell)
    bed = scene.initial_positions()
    forces = np.outer(np.sin(3.0 * scene.times()), [-100.0, 0.0, 50.0])
    frames = zip(scene.times(), forces, 0.1 * forces, scene.body_poses(), strict=True)
    return observe(scene, ((*values, moving(bed, values[0])) for values in frames))


@pytest.mark.parametrize(("spacing", "per_cell"), [(0.02, 1.0), (0.02, 2.37), (0.025, 1.0), (0.01, 4.0)])
def test_the_same_motion_on_another_bed_differs_by_less_than_the_lattice_can_tell(spacing, per_cell) -> None:
    run, reference = observed(spacing, per_cell), observed(0.0133333333, 4.0)
    found = errors([compare(run, reference)])
    assert np.linalg.norm(reference.moved[-1], axis=1).max() > 0.02  # what there is to see
    assert found["position_rmse_mm"] < 1.0
    assert found["force_nrmse"] == pytest.approx(0.0, abs=1e-12)


def test_a_run_beside_itself_has_no_error() -> None:
    run = observed(0.02, 4.0)
    found = errors([compare(run, run)], free_body=True)
    assert all(value == 0.0 for value in found.values() if not np.isnan(value))


def test_displacements_of_a_uniform_motion_are_exact() -> None:
    moved = observed(0.02, 1.0, lambda bed, time: bed + np.array([0.01, -0.02, 0.03]) * time).moved
    assert moved[-1] == pytest.approx(np.tile([0.004, -0.008, 0.012], (moved.shape[1], 1)), abs=1e-6)


def test_what_a_run_gets_wrong_at_rest_counts() -> None:
    """As a reduction does that cannot express the undisturbed bed."""
    run = observed(0.02, 1.0, lambda bed, _: bed + np.array([0.0, 0.0, 0.004]))
    assert run.moved == pytest.approx(np.broadcast_to([0.0, 0.0, 0.004], run.moved.shape), abs=1e-6)


def test_places_without_soil_are_no_sign_of_a_run_that_left_the_numbers() -> None:
    run = observed(0.02, 1.0)
    run.moved[:, 3] = np.nan
    assert run.finite
    run.moved[1:, 5] = np.nan
    assert not run.finite
    run.moved[:] = np.nan
    assert not run.finite


def test_the_surface_of_a_full_bed_is_flat_at_zero_whatever_the_spacing() -> None:
    for spacing, per_cell in ((0.02, 1.0), (0.01, 4.0)):
        surface = observed(spacing, per_cell).surface[0]
        assert surface[np.isfinite(surface)] == pytest.approx(0.0, abs=2e-3)


def test_errors_are_what_was_put_in() -> None:
    reference = observed(0.02, 4.0)
    moved = reference.moved.copy()
    moved[1:] += np.float32(0.004)  # along every axis
    run = replace(reference, force=1.25 * reference.force, moved=moved, surface=reference.surface + 0.003)
    found = errors([compare(run, reference)])
    assert found["force_nrmse"] == pytest.approx(0.25)
    assert found["draft_mean_error"] == pytest.approx(0.25)
    assert found["vertical_nrmse"] == pytest.approx(0.25)
    assert found["torque_nrmse"] == 0.0
    assert found["position_rmse_mm"] == pytest.approx(4.0, rel=1e-3)
    assert found["surface_rmse_mm"] == pytest.approx(3.0)
    assert found["force_nrmse_q4"] == pytest.approx(0.25)


def test_cases_are_pooled_and_their_range_is_kept() -> None:
    reference = observed(0.02, 4.0)
    good, bad = (replace(reference, force=factor * reference.force) for factor in (1.1, 1.3))
    found = errors([compare(good, reference), compare(bad, reference)])
    assert found["force_nrmse"] == pytest.approx(np.sqrt((0.1**2 + 0.3**2) / 2))
    assert (found["force_nrmse_low"], found["force_nrmse_high"]) == pytest.approx((0.1, 0.3))


def test_a_run_at_half_the_frame_rate_is_compared_at_the_reference_s_times() -> None:
    reference = observed(0.02, 4.0)
    halved = {name: getattr(reference, name)[::2] for name in ("time", "force", "torque", "pose")}
    found = errors([compare(replace(reference, **halved), reference)])
    assert 0.0 < found["force_nrmse"] < 0.01 and found["position_rmse_mm"] == 0.0


def test_a_run_that_is_too_short_or_of_another_bin_is_refused() -> None:
    reference = observed(0.02, 4.0)
    short = replace(reference, time=reference.time[:10], force=reference.force[:10])
    with pytest.raises(UserError, match="ends at"):
        compare(short, reference)
    other = replace(reference, moved=reference.moved[:, :-1])
    with pytest.raises(UserError, match="different sizes"):
        compare(other, reference)


def test_an_observation_is_read_as_it_was_saved(tmp_path: Path) -> None:
    run = observed(0.02, 1.0)
    run.save(tmp_path / "a.npz")
    again = read_observation(tmp_path / "a.npz")
    assert np.array_equal(again.moved, run.moved) and np.array_equal(again.force, run.force)
    (tmp_path / "a.npz").write_bytes(b"nothing")
    with pytest.raises(UserError, match="not an observed run"):
        read_observation(tmp_path / "a.npz")
