"""How well the dynamics follow the validation runs, all at once: what a checkpoint is chosen by.

Letters: B runs, T frames of the longest run, d history positions, r modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sgns.learning.body import BodyTrack, body_track
from sgns.learning.context import context_of
from sgns.learning.data import filled, pad_start, require_finite
from sgns.learning.stepping import Dynamics

if TYPE_CHECKING:
    from sgns.reduction.reduced import ReducedRun

__all__ = ["RolloutScore", "ValidationRollouts"]


class RolloutScore(NamedTuple):
    """Errors of rollouts over all runs, the history left out.

    Attributes:
        skill: 1 - sum of squared position errors / that of a soil that stays as it is after d true frames
            [1].
        skill_at_rest: The same when only the start at rest is given [1].
        force_nrmse: RMS of the force error's length / RMS of the force's length [1].
        force_nrmse_at_rest: The same when only the start at rest is given [1].
        body_rmse: RMS distance between predicted and true body nodes [m]; 0 for a prescribed body.
        force: Predicted from d true frames [N], shape (B, T, 3), zero in the history.
    """

    skill: float
    skill_at_rest: float
    force_nrmse: float
    force_nrmse_at_rest: float
    body_rmse: float
    force: Tensor


class ValidationRollouts:
    """Runs to be rolled out side by side.

    Args:
        runs: Reduced runs; shorter ones are filled up with their last frame, which is not counted.
        num_modes: r.
        history: d.
        body_nodes: "pose" or "points".
        context: Keys of the scene whose numbers the dynamics are told.
    """

    def __init__(
        self,
        runs: Sequence[ReducedRun],
        num_modes: int,
        history: int,
        body_nodes: str,
        context: Sequence[str] = (),
    ) -> None:
        for run in runs:
            require_finite(run)
        self.names = [run.name for run in runs]
        self.lengths = [len(run.latent) for run in runs]
        longest = max(self.lengths)

        def stacked(parts: Sequence[np.ndarray | Tensor]) -> Tensor:
            full = [torch.as_tensor(part) for part in parts]
            return torch.stack([torch.cat([p, p[-1:].expand(longest - len(p), *p.shape[1:])]) for p in full])

        self.latent = stacked([run.latent[:, :num_modes] for run in runs])
        self.force = stacked([run.force for run in runs])
        tracks = [body_track(run.pose, run.body_points, body_nodes) for run in runs]
        self.body = BodyTrack(*(stacked(filled(parts)) for parts in zip(*tracks, strict=True)))
        self.nodes = torch.tensor([track.position.shape[1] for track in tracks])
        self.context = torch.as_tensor(np.stack([context_of(run.scene, context) for run in runs]))
        self.history = history
        frame = torch.arange(longest)
        self.counted = (frame < torch.tensor(self.lengths)[:, None]) & (frame >= history)
        # The same runs preceded by copies of frame 0: a bed at rest.
        self.padding = history - 1
        self.body_at_rest = BodyTrack(
            *(torch.stack([pad_start(one, self.padding) for one in part]) for part in self.body)
        )

    def measure(self, dynamics: Dynamics) -> RolloutScore:
        """Roll every run out twice, from d true frames and from rest."""
        device = next(dynamics.parameters()).device
        given, start = self.latent[:, : self.history], self.latent[:, :1].expand(-1, self.history, -1, -1)
        with torch.inference_mode():
            latent, force, body = self.rolled(dynamics, given, self.body, device)
            at_rest, force_at_rest, _ = self.rolled(dynamics, start, self.body_at_rest, device)
            at_rest, force_at_rest = at_rest[:, self.padding :], force_at_rest[:, self.padding :]
            frozen = self.squares(given[:, -1:] - self.latent)
            return RolloutScore(
                1 - self.squares(latent - self.latent) / frozen,
                1 - self.squares(at_rest - self.latent) / frozen,
                self.force_error(force),
                self.force_error(force_at_rest),
                self.body_error(body) if dynamics.predicts_body else 0.0,
                force,
            )

    def squares(self, error: Tensor) -> float:
        """Sum over runs of the mean square over a run's counted frames; infinite where a rollout is not
        finite."""
        per_frame = error.square().sum((-1, -2))
        per_run = torch.where(self.counted, per_frame, 0.0).sum(1) / self.counted.sum(1).clamp_min(1)
        total = float(per_run.sum())
        return max(total, 1e-30) if np.isfinite(total) else float("inf")

    def force_error(self, force: Tensor) -> float:
        """NRMSE of the force vector over all counted frames of all runs."""
        error, truth = (
            float(torch.where(self.counted, part.square().sum(-1), 0.0).sum())
            for part in (force - self.force, self.force)
        )
        return (error / max(truth, 1e-30)) ** 0.5 if np.isfinite(error) else float("inf")

    def body_error(self, body: BodyTrack) -> float:
        """RMS distance of body nodes from where they are in truth, over all counted frames [m]."""
        squares = (body.position - self.body.position).square().sum(-1).nanmean(-1)
        error = float(torch.where(self.counted, squares, 0.0).sum() / self.counted.sum())
        return error**0.5 if np.isfinite(error) else float("inf")

    def rolled(
        self, dynamics: Dynamics, latent: Tensor, body: BodyTrack, device: torch.device
    ) -> tuple[Tensor, Tensor, BodyTrack]:
        """Latent positions [m], force [N] and body of an unrolling, computed on `device`, returned on the CPU."""
        found = BodyTrack(*(part.clone() for part in body))
        states = torch.empty(*body.position.shape[:2], *latent.shape[2:], dtype=latent.dtype)
        force = torch.empty(*body.position.shape[:2], 3, dtype=latent.dtype)
        for count in self.nodes.unique():
            of = torch.nonzero(self.nodes == count)[:, 0]
            track = BodyTrack(*(part[of][:, :, :count].to(device) for part in body))
            path = dynamics.unroll(latent[of].to(device), track, self.context[of].to(device))
            states[of], force[of] = path.latent.cpu(), path.force.cpu()
            found.position[of, :, :count] = path.body.position.cpu()
        return states, force, found
