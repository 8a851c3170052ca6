"""Labels beside the points of a crowded figure: none covers another, a point or the border."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

__all__ = ["place_labels"]

DISTANCES = (7, 14, 22, 32, 44, 58, 74, 92, 112, 136, 164, 196, 230, 270, 320, 380, 450)  # [pixels]
ANGLES = 24
NEAR = 9.0  # a label further away than this gets a line to its point [pixels]


def place_labels(
    axes: Axes,
    x: Sequence[float],
    y: Sequence[float],
    texts: Sequence[str],
    size: float = 7.0,
    line: Sequence[tuple[float, float]] = (),
) -> list[np.ndarray]:
    """Write a text beside each point.

    The limits and scales of the axes must not change afterwards. Points whose surroundings are crowded choose last
    but are given the room further away.

    Args:
        axes: drawn with its final limits.
        x: of the points, data coordinates.
        y: likewise.
        texts: one for each point; an empty one is left out.
        size: of the letters [points].
        line: corners of a line that labels keep off, data coordinates.

    Returns:
        The box of each text in pixels: x0, y0, x1, y1.
    """
    figure = axes.figure
    renderer = figure.canvas.get_renderer()
    border = axes.get_window_extent(renderer)
    points = axes.transData.transform(np.column_stack([x, y]).astype(float))
    taken = [np.array([px - 4, py - 4, px + 4, py + 4]) for px, py in points]
    corners = axes.transData.transform(np.array(line, dtype=float)) if len(line) else []
    lines: list[tuple[np.ndarray, np.ndarray]] = list(itertools.pairwise(corners))
    boxes: dict[int, np.ndarray] = {}
    crowd = [np.sum(np.hypot(*(points - point).T) < 60.0) for point in points]
    for index in sorted(range(len(points)), key=lambda i: crowd[i]):
        if not texts[index]:
            continue
        text = axes.text(
            0, 0, texts[index], fontsize=size, transform=None, va="center", ha="center", zorder=6
        )
        text.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
        extent = text.get_window_extent(renderer)
        half = np.array([extent.width / 2 + 2, extent.height / 2 + 1])
        centre = best_place(points[index], half, border, taken, lines)
        text.set_position(tuple(centre))
        box = np.concatenate([centre - half, centre + half])
        taken.append(box)
        boxes[index] = box
        nearest = np.clip(points[index], centre - half, centre + half)
        if math.dist(nearest, points[index]) > NEAR:
            ends = axes.transData.inverted().transform([points[index], nearest])
            axes.plot(*ends.T, "-", color="0.45", lw=0.6, zorder=3, scalex=False, scaley=False)
            lines.append((points[index], nearest))
    return [boxes[index] for index in sorted(boxes)]


def best_place(
    point: np.ndarray,
    half: np.ndarray,
    border: object,
    taken: Sequence[np.ndarray],
    lines: Sequence[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Middle of the box that is nearest to the point and covers nothing; of those that do the least bad one.

    Args:
        point: [pixels], shape (2,).
        half: half the width and height of the box, margin included [pixels].
        border: window extent of the axes, which the box must not leave.
        taken: boxes that must not be covered.
        lines: from points to labels; a box on one is avoided where there is another place.
    """
    others = np.array(taken)
    best, least = point, math.inf
    for distance in DISTANCES:
        for step in range(ANGLES):
            # Beside the point first: 0, then alternately up and down.
            angle = math.pi * (step + 1) // 2 * (-1) ** step * 2.0 / ANGLES if step else 0.0
            way = np.array([math.cos(angle), math.sin(angle)])
            centre = (
                point + way * distance + half * np.sign(np.round(way, 6)) * np.minimum(1.0, 2 * np.abs(way))
            )
            low, high = centre - half, centre + half
            if (low < [border.x0 + 2, border.y0 + 2]).any() or (high > [border.x1 - 2, border.y1 - 2]).any():
                continue
            overlap = np.minimum(high, others[:, 2:]) - np.maximum(low, others[:, :2])
            covered = np.prod(np.maximum(overlap, 0.0), axis=1).sum()
            crossed = sum(crosses(low, high, *line) for line in lines)
            if not covered and not crossed:
                return centre
            bad = covered + 30.0 * crossed + 0.05 * distance
            if bad < least:
                best, least = centre, bad
    return best


def crosses(low: np.ndarray, high: np.ndarray, start: np.ndarray, end: np.ndarray) -> bool:
    """Whether the line from start to end meets the box."""
    count = 2 + int(math.dist(start, end) / 4)
    between = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return bool(((between > low) & (between < high)).all(axis=1).any())
