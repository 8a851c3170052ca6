"""Full space: order of particles does not matter, the tool is felt where it is, forces add up, training learns."""

from __future__ import annotations

import pytest
import torch
from synthetic import PLATE, make_run
from tiny import MODEL, TRAINING

from sgns.errors import UserError
from sgns.full_space.body_surface import box_surface
from sgns.full_space.dynamics import FullSpaceDynamics
from sgns.full_space.training import fit_normalisation, losses, train
from sgns.full_space.windows import FullSpaceRun, FullSpaceWindows
from sgns.learning.body import BodyTrack
from sgns.learning.dynamics import ModelSettings
from sgns.learning.trainee import TrainingSettings

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


def test_order_of_particles_and_of_body_nodes_does_not_matter(windows) -> None:
    dynamics, window = untrained(windows), windows.window(8)
    order = torch.randperm(window.position.shape[2], generator=torch.Generator().manual_seed(0))
    turned = BodyTrack(*(part.flip(2) for part in window.body))
    with torch.inference_mode():
        following, force = dynamics.advance(window.history, window.body)
        shuffled, force_shuffled = dynamics.advance(window.history[:, :, order], turned)
    torch.testing.assert_close(shuffled, following[:, order], atol=1e-9, rtol=0)
    torch.testing.assert_close(force_shuffled, force, rtol=1e-4, atol=1e-4)


def test_a_batch_is_its_windows_one_by_one(windows) -> None:
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


def test_away_from_the_walls_the_place_does_not_matter() -> None:
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
    torch.testing.assert_close(other.acceleration, one.acceleration, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(other.force, one.force, atol=1e-4, rtol=1e-4)


def test_the_tool_is_felt_within_reach_and_nowhere_else() -> None:
    torch.manual_seed(0)
    dynamics = FullSpaceDynamics(SETTINGS, 0.1, torch.tensor([2.0, 2.0, 2.0])).requires_grad_(False)
    # A row of particles 0.08 m apart; two message-passing steps reach two neighbours along it.
    row = torch.zeros((1, 3, 10, 3), dtype=torch.float64) + torch.tensor([0.5, 1.0, -1.0])
    row[..., 0] += 0.08 * torch.arange(10)

    def accelerations(x: float, motion: float = 1.0) -> torch.Tensor:
        where = torch.zeros((1, 3, 1, 3), dtype=torch.float64) + torch.tensor([x, 1.0, -1.0])
        return dynamics(row, BodyTrack(where, where[..., :0], torch.full_like(where, motion))).acceleration[0]

    far, near, faster = accelerations(0.0), accelerations(0.42), accelerations(0.42, 2.0)
    assert bool((far != near).any(-1)[:2].all()) and torch.equal(far[2:], near[2:])
    # Its next motion is seen as well as its presence.
    assert bool((near != faster).any(-1)[:2].all()) and torch.equal(near[2:], faster[2:])


def test_force_is_the_sum_of_contributions(windows) -> None:
    dynamics, window = untrained(windows), windows.window(8)
    with torch.inference_mode():
        prediction = dynamics(window.history, window.body)
        contributions = dynamics.force_contributions(prediction)
        _, force = dynamics.advance(window.history, window.body)
        assert contributions.shape == prediction.force.shape
        torch.testing.assert_close(contributions.sum(1), force)
        # Without predictions the sum is the mean force, whatever the number of nodes.
        silent = dynamics.force_contributions(prediction._replace(force=torch.zeros_like(prediction.force)))
        torch.testing.assert_close(silent.sum(1), dynamics.force.mean[None])


def test_the_position_update(windows) -> None:
    dynamics, window = untrained(windows), windows.window(8)
    with torch.inference_mode():
        following, _ = dynamics.advance(window.history, window.body)
        acceleration = dynamics.acceleration.denormalise(dynamics(window.history, window.body).acceleration)
    x = window.history
    torch.testing.assert_close(following, 2 * x[:, -1] - x[:, -2] + acceleration)


def test_gradients_reach_every_weight(windows) -> None:
    dynamics = untrained(windows)
    sum(losses(dynamics, windows.window(8))).backward()
    for name, parameter in dynamics.named_parameters():
        assert parameter.grad is not None and float(parameter.grad.abs().max()) > 0, name


def test_an_optimisation_step_reduces_the_loss_on_its_window(windows) -> None:
    dynamics, window = untrained(windows), windows.window(8)
    optimiser = torch.optim.SGD(dynamics.parameters(), lr=1e-4)
    before = sum(losses(dynamics, window))
    before.backward()
    optimiser.step()
    with torch.inference_mode():
        assert float(sum(losses(dynamics, window))) < float(before.detach())


def trained(windows: FullSpaceWindows, steps: int) -> tuple[FullSpaceDynamics, list[float]]:
    """After some steps, with the losses of the acceleration on the same windows before and after."""
    # With noise of the size of the motion most of the target is the correction of what is seen.
    changes = {"max_steps": steps, "batch_size": 2, "learning_rate": 3e-3, "noise": 1.0}
    settings = TrainingSettings.from_dict(TRAINING | changes)
    dynamics = untrained(windows)
    scale = fit_normalisation(dynamics, windows, settings.noise, settings.normalisation_floor)
    asked, found = windows.batch(1000, 20, scale), []
    for act in (lambda: None, lambda: train(dynamics, windows, settings, scale)):
        record = act()
        with torch.inference_mode():
            found.append(float(losses(dynamics, asked)[0]))
    assert len(record.acceleration) == len(record.force) == len(record.seconds) == steps
    return dynamics, found


def test_training_learns(windows) -> None:
    _, (before, after) = trained(windows, 120)
    assert after < 0.7 * before


def test_training_repeats_to_the_bit(windows) -> None:
    first, second = (trained(windows, 5)[0] for _ in range(2))
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_loss_that_is_not_finite_stops_the_training(windows) -> None:
    dynamics = untrained(windows)
    with torch.no_grad():
        dynamics.network.decode.first.weight[0, 0] = torch.nan
    with pytest.raises(UserError, match="learning_rate"):
        train(dynamics, windows, TrainingSettings.from_dict(TRAINING), torch.zeros(3, dtype=torch.float64))


def test_a_rollout_is_steps_and_stays_finite(windows) -> None:
    dynamics, run = untrained(windows), windows.runs[0]
    soil = run.soil()[None]
    body = BodyTrack(*(part[None] for part in run.track))
    with torch.inference_mode():
        positions, force = dynamics.unroll(soil[:, :3], body)
        assert positions.shape == soil.shape and force.shape == (1, len(run), 3)
        assert bool(torch.isfinite(positions).all()) and bool(torch.isfinite(force).all())
        assert torch.equal(positions[:, :3], soil[:, :3]) and float(force[:, :3].abs().max()) == 0.0
        following, pushed = dynamics.advance(positions[:, 4:7], body.frames(slice(5, 8)))
    torch.testing.assert_close(positions[:, 7], following)
    torch.testing.assert_close(force[:, 7], pushed)


def test_a_pose_is_no_body_in_full_space() -> None:
    with pytest.raises(UserError, match="body_nodes=points"):
        FullSpaceDynamics(ModelSettings(**MODEL), 0.1, torch.ones(3))
