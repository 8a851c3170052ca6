"""How well dynamics follow the validation runs, all at once: what every kind of model is chosen by.

The error of the positions counts in full space, as in the report: with orthonormal modes it is that in the subspace
plus what the modes leave out, which no training changes. So within a training both choose the same checkpoint; between
numbers of modes only the total is fair.

Letters: B runs, T frames of the longest run, d history positions, r modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from sgns.model.dynamics import Dynamics
from sgns.model.features import BodyTrack, body_track, context_of
from sgns.reduction.basis import left_out
from sgns.train.windows import filled, require_finite

if TYPE_CHECKING:
    from sgns.reduction.basis import Basis
    from sgns.reduction.reduce import ReducedRun


class RolloutScore(NamedTuple):
    """Errors of rollouts over all runs, the history left out; from d true frames, or from the start at rest alone."""

    skill: float
    """1 - sum of squared position errors / that of a soil that stays as it is after d true frames [1]."""
    skill_at_rest: float
    skill_in_subspace: float  # the same of the modes only
    position_rmse: (
        float  # RMS per axis [m]; NaN where only modes are known: then `skill` is that in the subspace
    )
    force_nrmse: float  # RMS of the force error's length / RMS of the force's length [1]
    force_nrmse_at_rest: float
    body_rmse: float  # RMS distance between predicted and true body nodes [m]; 0 for a prescribed body
    force: Tensor  # predicted from d true frames [N], shape (B, T, 3), zero in the history

    def words(self) -> str:
        """The main numbers."""
        if math.isnan(self.position_rmse):
            soil = f"skill in the subspace {self.skill:.3f} (from rest {self.skill_at_rest:.3f})"
        else:
            soil = (
                f"position error {1e3 * self.position_rmse:.3g} mm, skill {self.skill:.3f} (in the subspace alone "
                f"{self.skill_in_subspace:.3f}, from rest {self.skill_at_rest:.3f})"
            )
        return f"{soil}, force NRMSE {self.force_nrmse:.3f}"


class ValidationRollouts:
    """Runs to be rolled out side by side; shorter ones are filled up with their last frame, which is not counted.

    `context` are the keys of the scene whose numbers the dynamics are told. Without the `basis`, or where there are no
    particles, errors are those in the subspace.
    """

    def __init__(
        self,
        runs: Sequence[ReducedRun],
        num_modes: int,
        history: int,
        body_nodes: str,
        context: Sequence[str] = (),
        basis: Basis | None = None,
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
        # Of the positions and of their way since the history's end, what the modes do not see (see `squares`) [m^2].
        self.unseen, self.unseen_way = 0.0, 0.0
        self.coordinates = math.nan  # 3 n
        paths = [run.path for run in runs if run.path is not None]
        if basis is not None and len(paths) == len(runs):
            kept, last = basis.sliced(num_modes), [min(history, length) - 1 for length in self.lengths]
            parts = zip(
                *(left_out(*one) for one in zip(paths, [kept] * len(paths), last, strict=True)), strict=True
            )
            self.unseen, self.unseen_way = (
                self.squares(stacked(part)[..., None, None].sqrt()) for part in parts
            )
            self.coordinates = 3.0 * basis.num_particles
        # The same runs preceded by copies of frame 0: a bed at rest.
        self.padding = history - 1
        self.body_at_rest = BodyTrack(
            *(torch.cat([part[:, :1].expand(-1, self.padding, -1, -1), part], dim=1) for part in self.body)
        )

    def measure(self, dynamics: Dynamics) -> RolloutScore:
        """Roll every run out twice, from d true frames and from rest."""
        given, start = self.latent[:, : self.history], self.latent[:, :1].expand(-1, self.history, -1, -1)
        with torch.inference_mode():
            latent, force, body = self.rolled(dynamics, given, self.body)
            at_rest, force_at_rest, _ = self.rolled(dynamics, start, self.body_at_rest)
            at_rest, force_at_rest = at_rest[:, self.padding :], force_at_rest[:, self.padding :]
            frozen, error, error_at_rest = (
                self.squares(part - self.latent) for part in (given[:, -1:], latent, at_rest)
            )
            all_frozen = frozen + self.unseen_way
            return RolloutScore(
                1 - (error + self.unseen) / all_frozen,
                1 - (error_at_rest + self.unseen) / all_frozen,
                1 - error / frozen,
                ((error + self.unseen) / (len(self.names) * self.coordinates)) ** 0.5,
                self.force_error(force),
                self.force_error(force_at_rest),
                self.body_error(body) if dynamics.predicts_body else 0.0,
                force,
            )

    def squares(self, error: Tensor) -> float:
        """Sum over runs of the mean square over a run's counted frames; infinite where a rollout is not finite."""
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

    def rolled(self, dynamics: Dynamics, latent: Tensor, body: BodyTrack) -> tuple[Tensor, Tensor, BodyTrack]:
        """Latent positions [m], force [N] and body of an unrolling, computed where the dynamics are, on the CPU."""
        device = next(dynamics.parameters()).device
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


def force_figure(rollouts: ValidationRollouts, score: RolloutScore, most: int = 4) -> Figure:
    """Force on the tool along the first validation runs, true and predicted: draft -F_x and vertical F_z [N] over
    frames."""
    count = min(most, len(rollouts.names))
    figure = Figure(figsize=(3.2 * count, 4.4), layout="constrained")
    axes = figure.subplots(2, count, sharex=True, squeeze=False)
    for column in range(count):
        shown = slice(rollouts.history, rollouts.lengths[column])
        frames = np.arange(rollouts.history, rollouts.lengths[column])
        for row, (name, axis, sign) in enumerate((("draft", 0, -1.0), ("vertical", 2, 1.0))):
            panel = axes[row, column]
            for force, colour, label in (
                (rollouts.force, "0.15", "truth"),
                (score.force, "#0072b2", "network"),
            ):
                panel.plot(frames, sign * force[column, shown, axis].numpy(), color=colour, label=label)
            if column == 0:
                panel.set_ylabel(f"{name} [N]")
        axes[0, column].set_title(rollouts.names[column], fontsize=8)
        axes[1, column].set_xlabel("frame")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return figure
