"""Latent dynamics without a network: the next velocity of the modes and of a free body, the force and the torque are
polynomials of what the network is shown. Their coefficients follow from linear algebra
(`sgns.train.polynomial`).

Letters: B batch, d history positions, r modes, K context numbers, p inputs, m monomials, f free axes of the body (0 or
1), o = 3r + f + 6 outputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sgns.model.dynamics import Dynamics, Standardiser, Step
from sgns.model.features import BodyTrack, free_axes
from sgns.settings import PolynomialSettings


def normalised(statistics: Standardiser, groups: Sequence[Tensor]) -> Tensor:
    """Groups side by side in deviations from the mean [1]; float64, unlike `Standardiser.normalise`, because sums of
    products follow."""
    return (torch.cat(list(groups), dim=1) - statistics.mean) / statistics.scale


def polynomial_terms(inputs: int, degree: int) -> Tensor:
    """Every monomial up to degree 1 or 2 as an ordered pair of inputs, where input 0 stands for the number 1; shape
    (m, 2), the first is the constant, (0, 0)."""
    if degree == 1:
        return torch.stack([torch.zeros(inputs + 1, dtype=torch.long), torch.arange(inputs + 1)], dim=1)
    return torch.combinations(torch.arange(inputs + 1), 2, with_replacement=True)


class PolynomialDynamics(Dynamics):
    """Polynomials with statistics of zero and one, bounds and coefficients of zero, to be filled in.

    Arguments as of `Dynamics`; used: which raw inputs vary in the training windows, p of them (see `raw_inputs`).
    """

    settings: PolynomialSettings
    free: Tensor
    prescribed: Tensor
    used: Tensor
    bounds: Tensor
    terms: Tensor

    def __init__(
        self,
        settings: PolynomialSettings,
        num_modes: int,
        context: tuple[str, ...],
        predicts_body: bool,
        used: Sequence[int],
    ) -> None:
        super().__init__(settings, num_modes, context, predicts_body)
        free = free_axes(predicts_body, "pose") > 0
        self.register_buffer("free", free.nonzero()[:, 0], persistent=False)
        self.register_buffer("prescribed", (~free).nonzero()[:, 0], persistent=False)
        d, r, f = settings.history, num_modes, len(self.free)
        body = 3 + 6 + (3 - f) * d + f * (d - 1) + 3 * d
        self.inputs = Standardiser.empty(3 * r + 3 * r * (d - 1) + body + len(context))
        self.velocity = Standardiser.empty(3 * r)
        self.body_displacement = Standardiser.empty(f)
        self.force = Standardiser.empty(3)
        self.torque = Standardiser.empty(3)
        self.register_buffer("used", torch.tensor(list(used), dtype=torch.long), persistent=False)
        self.register_buffer("bounds", torch.zeros(2, len(used), dtype=torch.float64))
        self.register_buffer("terms", polynomial_terms(len(used), settings.degree), persistent=False)
        weights = torch.zeros(len(self.terms), 3 * r + f + 6, dtype=torch.float64)
        self.weights = nn.Parameter(weights, requires_grad=False)

    @classmethod
    def from_card(cls, card: Mapping[str, Any], state: Mapping[str, Tensor]) -> PolynomialDynamics:
        model, num_modes, used = card["model"], int(card["num_modes"]), card["used"]
        most = len(used) * (len(used) + 1) // 2 if model["degree"] == 2 else len(used)
        groups = len(state["inputs.mean"]) // (3 * num_modes)
        if model["history"] > groups or most > len(state["weights"]):
            raise ValueError("its card describes other polynomials")
        told = tuple(map(str, card["context"])), bool(card["predicts_body"])
        return cls(PolynomialSettings(**model), num_modes, *told, used)

    def card(self) -> dict[str, Any]:
        return super().card() | {"used": self.used.tolist()}

    @property
    def num_terms(self) -> int:
        """Coefficients that are not zero, over all outputs."""
        return int(self.weights.count_nonzero())

    def with_modes(self, num_modes: int) -> PolynomialDynamics:
        """As for all `Dynamics`: the other modes stay at their mean place, their terms are dropped."""
        self.check_modes(num_modes)
        d, r = self.history, self.num_modes
        # Modes come first in each of the d groups of raw inputs that belong to modes.
        place = torch.arange(len(self.inputs.mean))
        kept = (place >= 3 * r * d) | (place % (3 * r) < 3 * num_modes)
        number = torch.cumsum(kept, 0) - 1
        held = kept[self.used]
        fewer = PolynomialDynamics(
            self.settings, num_modes, self.context_keys, self.predicts_body, number[self.used[held]].tolist()
        )
        fewer.inputs, fewer.velocity = self.inputs[kept], self.velocity[: 3 * num_modes]
        fewer.body_displacement, fewer.force, fewer.torque = self.body_displacement, self.force, self.torque
        fewer.bounds = self.bounds[:, held]
        fewer.lowest, fewer.highest = self.lowest, self.highest
        monomials = torch.nn.functional.pad(held, (1, 0), value=True)[self.terms].all(1)
        columns = torch.cat([self.weights[:, : 3 * num_modes], self.weights[:, 3 * r :]], dim=1)
        fewer.weights.copy_(columns[monomials])
        return fewer

    def raw_inputs(self, latent: Tensor, body: BodyTrack, context: Tensor | None) -> list[Tensor]:
        """What a step is computed from, in groups of one quantity each, shape (B, width); arguments as for `advance`.

        Newest latent position [m], d - 1 latent velocities [m]; of the body, one frame before the one to be predicted,
        its position along the prescribed axes [m] and its orientation [1], then its d displacements along these axes
        [m] and its d rotations [rad]; along the free axes its position and its d - 1 past displacements [m]; context.
        """
        place, moved = body.position[:, -2], body.motion[..., :3]
        groups = [
            latent[:, -1],
            latent[:, 1:] - latent[:, :-1],
            place[..., self.prescribed],
            body.orientation[:, -2],
            moved[..., self.prescribed],
            body.motion[..., 3:],
            place[..., self.free],
            moved[:, :-1][..., self.free],
            self.known_context(context) if self.context_keys else latent.new_zeros(latent.shape[0], 0),
        ]
        return [group.flatten(1) for group in groups]

    def monomials(self, latent: Tensor, body: BodyTrack, context: Tensor | None) -> Tensor:
        """The library's values for a batch of windows [1], float64, shape (B, m); arguments as for `advance`.

        Inputs are held to the range of the training windows: squares grow without end outside it, and a rollout that
        leaves it would run away.
        """
        varying = normalised(self.inputs, self.raw_inputs(latent, body, context))[:, self.used]
        held = torch.minimum(torch.maximum(varying, self.bounds[0]), self.bounds[1])
        factors = torch.nn.functional.pad(held, (1, 0), value=1.0)
        return factors[:, self.terms[:, 0]] * factors[:, self.terms[:, 1]]

    def latent_statistics(self) -> tuple[Tensor, Tensor]:
        """As for all `Dynamics`: the newest latent position is the first of the inputs."""
        modes = slice(0, 3 * self.num_modes)
        mean, scale = self.inputs.mean[modes], self.inputs.scale[modes]
        return mean.unflatten(0, (-1, 3)), scale.unflatten(0, (-1, 3))

    def outputs(self) -> list[Standardiser]:
        """Statistics of the outputs in their order."""
        return [self.velocity, self.body_displacement, self.force, self.torque]

    def advance(self, latent: Tensor, body: BodyTrack, context: Tensor | None = None) -> Step:
        """As for all `Dynamics`: z+ = z + v."""
        found = self.monomials(latent, body, context) @ self.weights
        parts = found.split([len(part.mean) for part in self.outputs()], dim=1)
        velocity, rise, force, torque = (
            part.denormalise(value) for part, value in zip(self.outputs(), parts, strict=True)
        )
        displacement = body.motion[:, -1, :, :3].clone()
        displacement[..., self.free] = rise[:, None]
        following = latent[:, -1] + velocity.unflatten(1, (self.num_modes, 3))
        following = torch.clamp(following, *self.reach())
        return Step(following, force, torque, displacement)
