"""The network on every particle: body nodes, neighbours, symmetries, windows, and the training of the experiment."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from mpm_warp.poses import in_world_frame
from sgns.config import UserError
from sgns.data.run import Run
from sgns.evaluate.full_space import (
    FullSpaceDynamics,
    FullSpaceRun,
    FullSpaceWindows,
    box_surface,
    losses,
    radius_graph,
)
from sgns.model.features import BodyTrack
from sgns.settings import ModelSettings, TrainingSettings
from sgns_testing.runs import PLATE, make_run
from sgns_testing.tiny import MODEL, TRAINING

SCRIPT = runpy.run_path(str(Path(__file__).parents[3] / "experiments" / "full_space" / "run.py"))
fit_normalisation, train, unroll = (SCRIPT[name] for name in ("fit_normalisation", "train", "unroll"))

# --- Body nodes lie on the surface, none twice, no hole wider than asked --------------------------------


@pytest.mark.parametrize("spacing", [0.015, 0.04, 1.0])
def test_the_surface_is_covered(spacing):
    half = np.array([0.021, 0.10, 0.06])
    points = box_surface(half, spacing)
    np.testing.assert_allclose(np.max(np.abs(points) / half, axis=1), 1.0)
    assert len(np.unique(points.round(9), axis=0)) == len(points)
    for axis in range(3):
        places = np.unique(points[:, axis].round(9))
        assert places[[0, -1]] == pytest.approx([-half[axis], half[axis]])
        assert np.diff(places).max() <= spacing + 1e-9 or len(places) == 2
    # Wherever a point sits on the surface, a node is within half a cell's diagonal.
    rng = np.random.default_rng(0)
    probes = rng.uniform(-half, half, (300, 3))
    axis = rng.integers(3, size=300)
    probes[np.arange(300), axis] = np.sign(probes[np.arange(300), axis]) * half[axis]
    nearest = np.linalg.norm(probes[:, None] - points, axis=-1).min(axis=1)
    assert nearest.max() <= min(spacing, 2 * half.max()) / np.sqrt(2) + 1e-9
    assert (len(points) == 8) == (spacing == 1.0)  # a coarse spacing leaves the corners


# --- Neighbours are exactly what comparing every pair finds ----------------------------------------------


@pytest.mark.parametrize(("size", "radius"), [(1.0, 0.15), (1.0, 0.9), (0.01, 0.002)])
def test_neighbours_equal_brute_force(size, radius):
    points = (torch.rand((400, 3), generator=torch.Generator().manual_seed(1)) - 0.5) * size
    points[:3] = points[3]  # in one place
    edges = radius_graph(points, radius)
    near = (points[:, None].double() - points[None].double()).square().sum(-1) <= radius**2
    near.fill_diagonal_(False)
    found = list(map(tuple, edges.T.tolist()))
    assert len(found) == len(set(found))
    assert set(found) == set(map(tuple, near.nonzero().tolist()))
    assert edges.dtype == torch.int64 and bool((edges[1].diff() >= 0).all())


@pytest.mark.parametrize("count", [0, 1, 5])
def test_lonely_points_have_no_edges(count):
    points = torch.arange(count)[:, None].double().expand(-1, 3)
    assert radius_graph(points, 0.5).shape == (2, 0)


# --- Full space: order of particles does not matter, the tool is felt where it is, forces add up, training

SETTINGS = ModelSettings(
    **(MODEL | {"body_nodes": "points", "message_passing_steps": 2, "layer_norm": True, "residual": True})
)
RADIUS = 0.08


@pytest.fixture(scope="module")
def windows(tmp_path_factory) -> FullSpaceWindows:
    folder = tmp_path_factory.mktemp("runs")
    nodes = box_surface(PLATE / 2, 0.1)
    runs = [
        FullSpaceRun(make_run(folder / f"{seed}.h5", frames=12, n=150, seed=seed), nodes) for seed in range(3)
    ]
    return FullSpaceWindows(runs, SETTINGS.history)


def untrained(windows: FullSpaceWindows) -> FullSpaceDynamics:
    torch.manual_seed(0)
    dynamics = FullSpaceDynamics(SETTINGS, RADIUS, windows.runs[0].bin_size)
    fit_normalisation(dynamics, windows, 0.1, 0.01)
    return dynamics


def test_order_of_particles_and_of_body_nodes_does_not_matter(windows):
    dynamics, window = untrained(windows), windows.window(8)
    order = torch.randperm(window.position.shape[2], generator=torch.Generator().manual_seed(0))
    turned = BodyTrack(*(part.flip(2) for part in window.body))
    with torch.inference_mode():
        following, force = dynamics.advance(window.history, window.body)
        shuffled, force_shuffled = dynamics.advance(window.history[:, :, order], turned)
    torch.testing.assert_close(shuffled, following[:, order], atol=1e-9, rtol=0)
    torch.testing.assert_close(force_shuffled, force, rtol=1e-4, atol=1e-4)


def test_a_batch_is_its_windows_one_by_one(windows):
    dynamics = untrained(windows)
    batch = windows.batch(0, 3, torch.full((3,), 1e-5, dtype=torch.float64))
    with torch.inference_mode():
        together = dynamics.advance(batch.history, batch.body)
        for b in range(3):
            alone = dynamics.advance(
                batch.history[b : b + 1], BodyTrack(*(part[b : b + 1] for part in batch.body))
            )
            torch.testing.assert_close(together[0][b : b + 1], alone[0], atol=1e-9, rtol=0)
            torch.testing.assert_close(together[1][b : b + 1], alone[1], rtol=1e-4, atol=1e-4)


def test_away_from_the_walls_the_place_does_not_matter():
    torch.manual_seed(0)
    dynamics = FullSpaceDynamics(SETTINGS, RADIUS, torch.tensor([10.0, 10.0, 10.0]))
    soil = torch.rand((1, 1, 60, 3), dtype=torch.float64) * 0.2 + torch.tensor([5.0, 5.0, -5.0])
    soil = soil.expand(-1, 3, -1, -1)
    where = soil[:, :, :4] + 0.01
    body = BodyTrack(where, where[..., :0], torch.full_like(where, 1e-3))
    shift = torch.tensor([0.5, -0.25, 0.125], dtype=torch.float64)
    moved = BodyTrack(where + shift, body.orientation, body.motion)
    with torch.inference_mode():
        one, other = dynamics(soil, body), dynamics(soil + shift, moved)
    torch.testing.assert_close(other, one, atol=1e-4, rtol=1e-4)


def test_the_tool_is_felt_within_reach_and_nowhere_else():
    torch.manual_seed(0)
    dynamics = FullSpaceDynamics(SETTINGS, 0.1, torch.tensor([2.0, 2.0, 2.0])).requires_grad_(False)
    # A row of particles 0.08 m apart; two message-passing steps reach two neighbours along it.
    row = torch.zeros((1, 3, 10, 3), dtype=torch.float64) + torch.tensor([0.5, 1.0, -1.0])
    row[..., 0] += 0.08 * torch.arange(10)

    def accelerations(x: float, motion: float = 1.0) -> torch.Tensor:
        where = torch.zeros((1, 3, 1, 3), dtype=torch.float64) + torch.tensor([x, 1.0, -1.0])
        return dynamics(row, BodyTrack(where, where[..., :0], torch.full_like(where, motion)))[0][0]

    far, near, faster = accelerations(0.0), accelerations(0.42), accelerations(0.42, 2.0)
    assert bool((far != near).any(-1)[:2].all()) and torch.equal(far[2:], near[2:])
    # Its next motion is seen as well as its presence.
    assert bool((near != faster).any(-1)[:2].all()) and torch.equal(near[2:], faster[2:])


def test_a_step_by_its_definition(windows):
    dynamics, window = untrained(windows), windows.window(8)
    with torch.inference_mode():
        acceleration, forces = dynamics(window.history, window.body)
        following, force = dynamics.advance(window.history, window.body)
    assert forces.shape[1] == acceleration.shape[1] + window.body.position.shape[2]
    torch.testing.assert_close(forces.sum(1), force)
    x = window.history
    expected = 2 * x[:, -1] - x[:, -2] + dynamics.acceleration.denormalise(acceleration)
    torch.testing.assert_close(following, expected)
    # Without predictions the sum of the forces is their mean, whatever the number of nodes.
    with torch.no_grad():
        for parameter in dynamics.network.decode.linears[-1].parameters():
            parameter.zero_()
        _, force = dynamics.advance(window.history, window.body)
    torch.testing.assert_close(force, dynamics.force.mean[None])


def trained(windows, steps: int) -> tuple[FullSpaceDynamics, torch.Tensor]:
    """After some steps, and the scale of the noise."""
    # With noise of the size of the motion most of the target is the correction of what is seen.
    changes = {"max_steps": steps, "batch_size": 2, "learning_rate": 3e-3, "noise": 1.0}
    settings = TrainingSettings.from_dict(TRAINING | changes)
    dynamics = untrained(windows)
    scale = fit_normalisation(dynamics, windows, settings.noise, settings.normalisation_floor)
    assert len(train(dynamics, windows, settings, scale)) == steps
    return dynamics, scale


@pytest.mark.long
def test_training_learns(windows):
    errors = []
    for steps in (1, 90):
        dynamics, scale = trained(windows, steps)
        with torch.inference_mode():
            errors.append(float(losses(dynamics, windows.batch(1000, 20, scale))[0]))
    assert errors[1] < 0.8 * errors[0]


def test_training_repeats_to_the_bit(windows):
    first, second = (trained(windows, 3)[0] for _ in range(2))
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_rollout_is_steps_and_stays_finite(windows):
    dynamics, run = untrained(windows), windows.runs[0]
    soil = run.soil()[None]
    body = BodyTrack(*(part[None] for part in run.track))
    with torch.inference_mode():
        positions, force = unroll(dynamics, soil[:, :3], body)
        assert positions.shape == soil.shape and force.shape == (1, len(run), 3)
        assert bool(torch.isfinite(positions).all()) and bool(torch.isfinite(force).all())
        assert torch.equal(positions[:, :3], soil[:, :3]) and float(force[:, :3].abs().max()) == 0.0
        following, pushed = dynamics.advance(positions[:, 4:7], body.frames(slice(5, 8)))
    torch.testing.assert_close(positions[:, 7], following)
    torch.testing.assert_close(force[:, 7], pushed)


# --- Windows hold what the files hold ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return [make_run(folder / f"{seed}.h5", frames=6 + seed, n=20, seed=seed) for seed in range(2)]


def test_a_window_is_frames_of_the_file_and_a_run_starts_from_rest(paths):
    windows = FullSpaceWindows([FullSpaceRun(path) for path in paths], history=3)
    assert len(windows) == 5 + 6
    window, first = windows.window(5 + 3), windows.window(0)  # the second run's frame 4
    with Run(paths[1]) as run:
        torch.testing.assert_close(window.position[0], torch.from_numpy(run.positions(slice(1, 5))).double())
        torch.testing.assert_close(window.force[0], torch.from_numpy(run.force[4]))
        points = torch.from_numpy(run.body_points)
    torch.testing.assert_close(window.body.position[0], points[2:5])
    torch.testing.assert_close(window.body.motion[0, -1], points[4] - points[3])
    assert bool((first.position[0, :3] == first.position[0, 0]).all())
    assert float(first.body.motion[0, :2].abs().max()) == 0.0


def test_body_nodes_of_ones_own_are_carried_along(paths):
    nodes = np.array([[0.0, 0.0, 0.0], [0.01, 0.1, -0.1]])
    with Run(paths[0]) as file:
        expected = in_world_frame(file.pose, nodes)
    np.testing.assert_allclose(FullSpaceRun(paths[0], nodes).track.position, expected)


def test_a_batch_depends_on_seed_and_step_only(paths):
    runs = [FullSpaceRun(path) for path in paths]
    scale = torch.tensor([1e-4, 1e-5, 1e-4], dtype=torch.float64)
    a, b, other, seeded = (
        FullSpaceWindows(runs, 3, seed).batch(step, 4, scale)
        for step, seed in ((7, 0), (7, 0), (8, 0), (7, 1))
    )
    assert torch.equal(a.history, b.history) and torch.equal(a.force, b.force)
    assert not torch.equal(a.history, other.history) and not torch.equal(a.history, seeded.history)
    # The oldest position is exact, the newest velocity's noise has the stated size.
    assert float(a.noise[:, 0].abs().max()) == 0.0
    found = (a.noise[:, -1] - a.noise[:, -2]).square().mean((0, 1)).sqrt()
    torch.testing.assert_close(found / scale, torch.ones(3, dtype=torch.float64), atol=0.35, rtol=0)


def test_a_run_without_body_points_needs_body_nodes(tmp_path):
    with pytest.raises(UserError, match="no body points"):
        FullSpaceRun(make_run(tmp_path / "bare.h5", frames=3, n=5, m=0))
