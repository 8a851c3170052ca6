"""Latent dynamics without a network: the next velocity of the modes, the force and the torque are polynomials of
what the network is shown. Their coefficients follow from linear algebra (`sgns.learning.closed_form_fit`).

Letters: B batch, d history positions, r modes, T frames, p inputs, m monomials.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sgns.learning.body import BodyTrack
from sgns.learning.normalisation import Standardiser

__all__ = ["ClosedForm", "normalised", "polynomial_terms", "raw_inputs"]


def raw_inputs(latent: Tensor, body: BodyTrack) -> list[Tensor]:
    """What a step is computed from, in groups of one quantity each.

    Args:
        latent: The last d latent positions, oldest first [m], shape (B, d, r, 3).
        body: The d frames that end with the one to be predicted; (B, d, N, ...).

    Returns:
        Newest latent position [m], d - 1 latent velocities [m], the body's position [m] and orientation [1] one
        frame before the one to be predicted, and its d displacements [m] and, for a pose, rotations [rad]; each of
        shape (B, width).
    """
    groups = [
        latent[:, -1],
        latent[:, 1:] - latent[:, :-1],
        body.position[:, -2],
        body.orientation[:, -2],
        *body.motion.split(3, dim=-1),
    ]
    return [group.flatten(1) for group in groups]


def normalised(statistics: Standardiser, groups: Sequence[Tensor]) -> Tensor:
    """Groups side by side in deviations from the mean [1]; float64, unlike `Standardiser.normalise`, because sums of
    products follow."""
    return (torch.cat(list(groups), dim=1) - statistics.mean) / statistics.scale


def polynomial_terms(inputs: int, degree: int) -> Tensor:
    """Every monomial up to degree 1 or 2 as a pair of inputs, where input 0 stands for the number 1.

    Returns:
        Ordered pairs, shape (m, 2); the first is the constant, (0, 0).
    """
    if degree == 1:
        return torch.stack([torch.zeros(inputs + 1, dtype=torch.long), torch.arange(inputs + 1)], dim=1)
    return torch.combinations(torch.arange(inputs + 1), 2, with_replacement=True)


class ClosedForm(nn.Module):
    """Polynomial latent dynamics with the stepping interface of `LatentDynamics`.

    Args:
        history: d.
        num_modes: r.
        inputs: Statistics of all raw inputs, one after another.
        used: Which raw inputs vary at all, shape (p,).
        bounds: Smallest and largest normalised value of those in the training windows, shape (2, p).
        outputs: Statistics of the modes' velocities (3r, mode by mode), force (3) and torque (3).
        terms: Monomials as pairs of used inputs, shape (m, 2); see `polynomial_terms`.
        weights: Coefficients of normalised outputs [1], shape (m, 3r + 6).
    """

    used: Tensor
    bounds: Tensor
    terms: Tensor

    def __init__(
        self,
        history: int,
        num_modes: int,
        inputs: Standardiser,
        used: Tensor,
        bounds: Tensor,
        outputs: Standardiser,
        terms: Tensor,
        weights: Tensor,
    ) -> None:
        super().__init__()
        self.history = history
        self.num_modes = num_modes
        self.inputs = inputs
        self.outputs = outputs
        self.register_buffer("used", used)
        self.register_buffer("bounds", bounds)
        self.register_buffer("terms", terms)
        self.weights = nn.Parameter(weights, requires_grad=False)

    @property
    def num_terms(self) -> int:
        """Coefficients that are not zero, over all outputs."""
        return int(self.weights.count_nonzero())

    def monomials(self, latent: Tensor, body: BodyTrack) -> Tensor:
        """The library's values for a batch of windows [1], float64, shape (B, m); arguments as `raw_inputs`.

        Inputs are held to the range of the training windows: squares grow without end outside it, and a rollout that
        leaves it would run away.
        """
        varying = normalised(self.inputs, raw_inputs(latent, body))[:, self.used]
        held = torch.minimum(torch.maximum(varying, self.bounds[0]), self.bounds[1])
        factors = torch.nn.functional.pad(held, (1, 0), value=1.0)
        return factors[:, self.terms[:, 0]] * factors[:, self.terms[:, 1]]

    def advance(self, latent: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor, Tensor]:
        """Take one step: z+ = z + v.

        Args:
            latent: As for `raw_inputs`, float64.
            body: As for `raw_inputs`.

        Returns:
            Next latent positions [m] (B, r, 3), force [N] (B, 3) and torque [N m] (B, 3), float64.
        """
        found = self.outputs.denormalise(self.monomials(latent, body) @ self.weights)
        velocity, force, torque = found.split([3 * self.num_modes, 3, 3], dim=1)
        return latent[:, -1] + velocity.unflatten(1, (self.num_modes, 3)), force, torque

    def unroll(self, latent: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor, Tensor]:
        """Follow whole tool paths from a given history, feeding predictions back.

        Args:
            latent: The first d latent positions of each path [m], float64, shape (B, d, r, 3).
            body: The tool at all T frames, (B, T, N, ...).

        Returns:
            Latent positions (B, T, r, 3) whose first d frames are the given ones, force [N] and torque [N m],
            both (B, T, 3) and zero in the first d frames; float64.
        """
        d, states = self.history, list(latent.unbind(1))
        forces = [latent.new_zeros(len(latent), 3)] * d
        torques = list(forces)
        for t in range(d, body.position.shape[1]):
            window = body.frames(slice(t - d + 1, t + 1))
            state, force, torque = self.advance(torch.stack(states[-d:], dim=1), window)
            states.append(state)
            forces.append(force)
            torques.append(torque)
        return torch.stack(states, dim=1), torch.stack(forces, dim=1), torch.stack(torques, dim=1)
