"""The interface of all latent dynamics, the network's and the polynomials': steps, and paths of them.

Shapes: B batch, d history positions, r modes, N body nodes, V = r + N nodes, K context numbers, T frames.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sgns.config import UserError
from sgns.model.features import BodyTrack
from sgns.model.network import Standardiser
from sgns.model.settings import ModelSettings, PolynomialSettings
from sgns.numbers import is_whole

# No latent position goes further than this from its mean, in deviations; training runs stay within about half of it. It
# keeps a rollout finite that has left everything the dynamics know.
_REACH = 10.0


class Prediction(NamedTuple):
    """What the network says of one step, normalised.

    Attributes:
        change: Of every node's position: its second difference, or with `model.predicts=velocity` its first [1], shape
            (B, V, 3). Modes first; of a body node only what is free counts.
        force: Contribution of every node [1], shape (B, V, 3).
        torque: Contribution of every node [1], shape (B, V, 3).
    """

    change: Tensor
    force: Tensor
    torque: Tensor


class Step(NamedTuple):
    """One step in physical units, float64.

    Attributes:
        latent: Next latent positions [m], shape (B, r, 3).
        force: On the body [N], shape (B, 3).
        torque: On the body [N m], shape (B, 3).
        displacement: Of the body nodes [m], shape (B, N, 3): the prescribed one, with what the network predicts in
            its place along the free axes.
    """

    latent: Tensor
    force: Tensor
    torque: Tensor
    displacement: Tensor


class Path(NamedTuple):
    """A whole path, float64.

    Attributes:
        latent: Latent positions [m], shape (B, T, r, 3); the first d frames are the given ones.
        force: [N], shape (B, T, 3), zero in the first d frames.
        torque: [N m], shape (B, T, 3), zero in the first d frames.
        body: The body at all frames, predicted where it is free.
    """

    latent: Tensor
    force: Tensor
    torque: Tensor
    body: BodyTrack


class Stepper:
    """Takes the steps of one path without gradients.

    Args:
        dynamics: Whose.
        context: Numbers of the run, shape (1, K); not needed when K is 0.

    Attributes:
        memory: All that a step depends on of those before it, besides what it is given; put back, it undoes them.
    """

    memory: Any = None

    def __init__(self, dynamics: Dynamics, context: Tensor | None) -> None:
        self.dynamics = dynamics
        self.context = context

    def advance(self, latent: Tensor, body: BodyTrack) -> Step:
        """One step; latent (1, d, r, 3) and body (1, d, N, ...) as for `Dynamics.advance`."""
        with torch.inference_mode():
            return self.dynamics.advance(latent, body, self.context)


class Dynamics(nn.Module):
    """History of the modes and motion of the body in, next state and force out.

    Args:
        settings: What was built.
        num_modes: r.
        context: Keys of the scene whose numbers are told, K of them.
        predicts_body: Whether the body moves as the soil lets it (see `free_axes`).

    Attributes:
        lowest: Latent positions that no step goes below [m], shape (r, 3) or those of more modes; without bound until
            the surrogate that it is a part of tells it.
        highest: Likewise.
    """

    settings: ModelSettings | PolynomialSettings
    force: Standardiser
    lowest: Tensor
    highest: Tensor

    def __init__(
        self,
        settings: ModelSettings | PolynomialSettings,
        num_modes: int,
        context: tuple[str, ...],
        predicts_body: bool,
    ) -> None:
        super().__init__()
        self.settings = settings
        self.num_modes = num_modes
        self.context_keys = tuple(context)
        self.predicts_body = predicts_body
        unbounded = torch.full((num_modes, 3), math.inf, dtype=torch.float64)
        self.register_buffer("lowest", -unbounded, persistent=False)
        self.register_buffer("highest", unbounded, persistent=False)

    @property
    def history(self) -> int:
        """d, positions of history."""
        return self.settings.history

    def card(self) -> dict[str, Any]:
        """Plain values from which the same dynamics can be built, to be filled from a state dict."""
        return {
            "model": self.settings.to_dict(),
            "num_modes": self.num_modes,
            "context": list(self.context_keys),
            "predicts_body": self.predicts_body,
        }

    @classmethod
    @abstractmethod
    def from_card(cls, card: Mapping[str, Any], state: Mapping[str, Tensor]) -> Dynamics:
        """What a card describes (see `card`), to be filled from a state dict.

        Raises:
            KeyError, TypeError, ValueError, UserError: It is no such card, or describes more than the state holds; this
                is found out before anything is built.
        """

    @abstractmethod
    def with_modes(self, num_modes: int) -> Dynamics:
        """The same dynamics of the first modes only.

        Raises:
            UserError: More modes than it was trained with.
        """

    @abstractmethod
    def latent_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the latent positions in the training windows [m], shape (r, 3) each."""

    def reach(self) -> tuple[Tensor, Tensor]:
        """Smallest and largest latent positions that a step leads to [m], shape (r, 3) each."""
        mean, scale = self.latent_statistics()
        return (
            torch.maximum(mean - _REACH * scale, self.lowest[: self.num_modes]),
            torch.minimum(mean + _REACH * scale, self.highest[: self.num_modes]),
        )

    @abstractmethod
    def advance(self, latent: Tensor, body: BodyTrack, context: Tensor | None = None) -> Step:
        """Take one step of every window in a batch.

        Args:
            latent: The last d latent positions, oldest first [m], float64, shape (B, d, r, 3).
            body: The d frames that end with the *next* one, the frame to be predicted; (B, d, N, ...). Where it is
                then, and how it gets there along the free axes, is not looked at.
            context: Numbers of the runs, shape (B, K); not needed when K is 0.
        """

    def stepper(self, body_points: int, context: Tensor | None = None) -> Stepper:
        """Takes the steps of one path without gradients, with the weights as they are now.

        Args:
            body_points: M.
            context: Numbers of the run, shape (1, K); not needed when K is 0.
        """
        return Stepper(self, context)

    def unroll(self, latent: Tensor, body: BodyTrack, context: Tensor | None = None) -> Path:
        """Follow whole tool paths from a given history, feeding predictions back.

        Args:
            latent: The first d latent positions of each path [m], shape (B, d, r, 3).
            body: The body at all T frames, (B, T, N, ...); what is predicted of it is read in the first d frames only.
            context: As for `advance`.
        """
        return unrolled(
            lambda history, window: self.advance(history, window, context), latent, body, self.predicts_body
        )

    def check_modes(self, num_modes: int) -> None:
        """For `with_modes`."""
        if not is_whole(num_modes) or not 1 <= num_modes <= self.num_modes:
            raise UserError(
                f"the {self.settings.kind} was trained with {self.num_modes} modes and cannot have {num_modes!r}; "
                f"allowed: 1 to {self.num_modes}"
            )

    def known_context(self, context: Tensor | None) -> Tensor:
        """The context, where there is one to be known."""
        if context is None:
            raise UserError(
                f"this {self.settings.kind} needs the scene's {', '.join(self.context_keys)}; give it a scene"
            )
        return context


def unrolled(
    advance: Callable[[Tensor, BodyTrack], Step], latent: Tensor, body: BodyTrack, predicts_body: bool
) -> Path:
    """Whole paths by steps that see what the steps before said.

    `advance` takes a step from d latent positions (B, d, r, 3) and the body (B, d, N, ...), which goes where the steps
    say if it is predicted; the others as for `Dynamics.unroll`.
    """
    d, frames = latent.shape[1], body.position.shape[1]
    states = latent.new_empty((latent.shape[0], frames, *latent.shape[2:]), dtype=torch.float64)
    states[:, :d] = latent
    force = latent.new_zeros((latent.shape[0], frames, 3), dtype=torch.float64)
    torque = torch.zeros_like(force)
    if predicts_body:
        body = body._replace(position=body.position.clone(), motion=body.motion.clone())
    for t in range(d, frames):
        step = advance(states[:, t - d : t], body.frames(slice(t - d + 1, t + 1)))
        states[:, t], force[:, t], torque[:, t] = step.latent, step.force, step.torque
        if predicts_body:
            body.motion[:, t, :, :3] = step.displacement
            body.position[:, t] = body.position[:, t - 1] + step.displacement
    return Path(states, force, torque, body)
