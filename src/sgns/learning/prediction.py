"""What the dynamics say of one step and of a whole path.

Shapes: B batch, r modes, N body nodes, V = r + N nodes, T frames.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from sgns.learning.body import BodyTrack

__all__ = ["Path", "Prediction", "Step"]


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
