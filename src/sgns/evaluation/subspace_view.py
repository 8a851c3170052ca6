"""What the network itself steps: the r modes as points in space, with the points of the body.

Letters: T frames, r modes, M body points.
"""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from sgns.evaluation.figures import BASELINE, NETWORK, PICTURE_WIDTH, TRUTH, new_figure, styled
from sgns.reduction import Basis
from sgns.runs import Run, frame_chunks

__all__ = ["latent_path", "subspace_view"]

# The longest force arrow is this share of the picture's longest side long.
ARROW_SHARE = 0.3


def latent_path(run: Run, basis: Basis) -> np.ndarray:
    """The modes of a run at every frame [m], shape (T, r, 3)."""
    parts = [
        basis.transform(torch.from_numpy(run.positions(frames)))
        for frames in frame_chunks(run.particle_count, run.frame_count)
    ]
    return torch.cat(parts).numpy()


@styled
def subspace_view(truth: Run, prediction: Run, paths: tuple[np.ndarray, np.ndarray], frame: int) -> Figure:
    """Modes, body points and force at one frame, with the way that the modes have come.

    Args:
        truth: the simulated run.
        prediction: the predicted run, whose body is drawn.
        paths: `latent_path` of the two [m], shape (T, r, 3) each.
        frame: to draw.
    """
    figure = new_figure(PICTURE_WIDTH, 4.3)
    axis = figure.add_subplot(projection="3d")
    body = prediction.body_points[frame]
    everything = np.concatenate(
        [*(path.reshape(-1, 3) for path in paths), prediction.body_points.reshape(-1, 3)]
    )
    low, high = everything.min(axis=0), everything.max(axis=0)
    width = float((high - low).max())
    for path, colour, filled in ((paths[0], TRUTH, "none"), (paths[1], NETWORK, NETWORK)):
        for mode in range(path.shape[1]):
            axis.plot(*path[: frame + 1, mode].T, color=colour, linewidth=0.8, alpha=0.6)
        axis.scatter(
            *path[frame].T, s=34, facecolors=filled, edgecolors=colour, linewidths=1.2, depthshade=False
        )
    axis.scatter(*body.T, s=6, color=BASELINE, marker="s", depthshade=False)
    for mode, place in enumerate(paths[0][frame], start=1):
        axis.text(place[0], place[1], place[2] + 0.03 * width, str(mode), fontsize=8)
    strongest = max(float(np.linalg.norm(run.force, axis=1).max()) for run in (truth, prediction))
    if strongest > 0.0:
        for run, colour in ((truth, TRUTH), (prediction, NETWORK)):
            arrow = ARROW_SHARE * width / strongest * run.force[frame]
            axis.quiver(*body.mean(axis=0), *arrow, color=colour, linewidth=1.4)
    decorate(axis, low, high)
    axis.set_title(f"t = {prediction.time[frame]:.2f} s")
    marks = [
        Line2D(
            [], [], color=TRUTH, marker="o", markerfacecolor="none", linewidth=0.8, label="simulated (MPM)"
        ),
        Line2D([], [], color=NETWORK, marker="o", linewidth=0.8, label="network"),
        Line2D([], [], color=BASELINE, marker="s", markersize=3, linewidth=0.0, label="body"),
    ]
    figure.legend(handles=marks, loc="outside upper center", ncols=3, fontsize=8.5)
    return figure


def decorate(axis: Axes3D, low: np.ndarray, high: np.ndarray) -> None:
    """Room around what is drawn [m], and few ticks, so that their numbers stay apart.

    Modes are no places: a short side is stretched, so that what lies close together can be told apart.
    """
    room = 0.05 * float((high - low).max())
    low, high = low - room, high + room
    for name, start, end in zip("xyz", low, high, strict=True):
        getattr(axis, f"set_{name}lim")(start, end)
        getattr(axis, f"set_{name}label")(f"{name} [m]", fontsize=9, labelpad=-1.0)
    axis.set_box_aspect(np.maximum(high - low, 0.6 * float((high - low).max())), zoom=0.95)
    for part in (axis.xaxis, axis.yaxis, axis.zaxis):
        part.set_major_locator(MaxNLocator(4))
    axis.tick_params(labelsize=8, pad=0)
    axis.view_init(elev=18, azim=-65)
