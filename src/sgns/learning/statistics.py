"""Scales of all quantities, from the training windows, and of the noise that is added to them.

Shapes: r modes, N body nodes, F stacked frames of all runs.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgns.learning.body import free_axes
from sgns.learning.data import NoiseScales, TrainingWindows
from sgns.learning.dynamics import LatentDynamics
from sgns.learning.normalisation import Standardiser

__all__ = ["NOISE_UNITS", "SCALES", "fit_normalisation"]

SCALES = ("per_mode", "pooled")
NOISE_UNITS = ("velocity", "metre")


def fit_normalisation(
    dynamics: LatentDynamics,
    windows: TrainingWindows,
    noise: float,
    noise_unit: str,
    scales: str,
    floor: float,
) -> NoiseScales:
    """Give the dynamics the statistics of the training windows.

    Modes differ by more than an order of magnitude. "per_mode" gives every mode and axis its scale; velocities and
    their changes keep their zero, which means rest. "pooled" has a mean and a scale for each axis, over all modes and
    points of the body together, as the paper does.

    Args:
        dynamics: Filled in place.
        windows: The training windows.
        noise: Deviation of the velocity noise.
        noise_unit: "velocity": as a share of the velocity scale of each mode and axis; "metre": [m].
        scales: "per_mode" or "pooled".
        floor: Smallest scale as a share of the quantity's largest.

    Returns:
        Deviations of the velocity noise.
    """
    rows = windows.targets
    position, velocity, change = motions(windows.latent, rows)
    body_position, body_velocity, body_change = map(nodes, motions(windows.body.position, rows))
    free = free_axes(dynamics.predicts_body, dynamics.settings.body_nodes)
    motion = nodes(windows.body.motion[rows])

    if scales == "pooled":
        # Rigid points and modes together; the pose node's rotation has a scale of its own.
        pose = dynamics.settings.body_nodes == "pose"
        dynamics.position, dynamics.body_position = pooled(position, body_position)
        dynamics.velocity, moved = pooled(velocity, body_velocity)
        turned = Standardiser.fit(motion[:, 3:], floor, centred=True)
        dynamics.body_motion = joined(moved, turned) if pose else moved
        clean, body_clean = pooled(change, body_change)
    else:
        dynamics.position = Standardiser.fit(position, floor)
        dynamics.velocity = Standardiser.fit(velocity, floor, centred=False)
        dynamics.body_position = Standardiser.fit(body_position, floor)
        # Displacement [m] and rotation [rad] have their own largest scale each.
        parts = motion.split(3, dim=-1)
        dynamics.body_motion = joined(*(Standardiser.fit(part, floor, centred=False) for part in parts))
        clean = Standardiser.fit(change, floor, centred=False)
        # No floor here: a wheel rises and sinks far less than it drives, and that little is to be predicted.
        body_clean = Standardiser.fit(body_change, centred=False)
        moved = Standardiser.fit(body_velocity, centred=False)

    if noise_unit == "metre":
        scale = NoiseScales(torch.full_like(dynamics.velocity.scale, noise), noise * free)
    else:
        scale = NoiseScales(noise * dynamics.velocity.scale, noise * moved.scale * free)
    if dynamics.settings.predicts == "velocity":
        dynamics.change, dynamics.body_change = dynamics.velocity, moved
    else:
        # The target contains the correction of the velocity's noise; without either it would be constant.
        dynamics.change = widened(clean, scale.latent)
        dynamics.body_change = widened(body_clean, scale.body)
    dynamics.body_orientation = Standardiser.fit(nodes(windows.body.orientation[rows - 1]), floor)
    dynamics.force = Standardiser.fit(windows.force[rows], floor)
    dynamics.torque = Standardiser.fit(windows.torque[rows], floor)
    dynamics.context = Standardiser.fit(windows.context[windows.of_run[rows]])
    return scale


def motions(position: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where things are before the given frames, their velocity into them, and how that changes; (W, r or N, 3)."""
    velocity = position[rows] - position[rows - 1]
    return position[rows - 1], velocity, velocity - (position[rows - 1] - position[rows - 2])


def nodes(values: Tensor) -> Tensor:
    """All body nodes one below the other, those that fill up to the largest number left out; (W N, K)."""
    flat = values.flatten(0, 1)
    return flat[~flat.isnan().any(-1)]


def pooled(modes: Tensor, body: Tensor) -> tuple[Standardiser, Standardiser]:
    """One mean and scale per axis over all nodes, for the modes (r, 3) and for a body node (3,)."""
    both = Standardiser.fit(torch.cat([modes.flatten(0, 1), body]))
    count = modes.shape[1]
    return Standardiser(both.mean.expand(count, 3), both.scale.expand(count, 3)), both


def joined(*parts: Standardiser) -> Standardiser:
    """Of several quantities side by side."""
    return Standardiser(torch.cat([p.mean for p in parts]), torch.cat([p.scale for p in parts]))


def widened(clean: Standardiser, noise: Tensor) -> Standardiser:
    """The scale of a change together with the correction of the noise."""
    return Standardiser(clean.mean, (clean.scale.square() + noise.square()).sqrt())
