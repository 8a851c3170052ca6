"""Measures of what a run did that it should not have."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .bodies import Tool
from .poses import rotate
from .solver import Frame


def leaked(frames: Iterable[Frame], body: Tool, edge: float = 0.0) -> np.ndarray:
    """How often each particle crossed a thin body, shape (n,), int.

    Counted are crossings of the plane x = 0 of the body frame, half-way through a plate's thickness, where the crossing
    lies within the body's outline in y and z: +1 towards the body's front (+x), -1 towards its back. A particle that
    comes back counts nothing, and one that flows around an edge or over the top does not count either. Between frames
    a particle is taken to move in a straight line relative to the body, so the frames must be close enough
    for that.

    Args:
        frames: of one run, in order.
        body: whose outline counts; its shape is taken as the box around it.
        edge: width of a strip along the outline's edges that does not count [m]. Contact may begin inside the body,
            and then soil flows around an edge that lies that far inside.
    """
    _, half_y, half_z = body.half_size - edge
    before, crossings = None, None
    for frame in frames:
        back = frame.body_pose[3:] * [-1.0, -1.0, -1.0, 1.0]
        now = rotate(back, frame.position.astype(float) - frame.body_pose[:3])
        if before is None:
            crossings = np.zeros(len(now), dtype=int)
        else:
            change = np.sign(now[:, 0]) - np.sign(before[:, 0])
            crossed = np.flatnonzero(before[:, 0] * now[:, 0] < 0.0)
            a, b = before[crossed], now[crossed]
            share = (a[:, 0] / (a[:, 0] - b[:, 0]))[:, None]
            at = a + share * (b - a)
            inside = (np.abs(at[:, 1]) < half_y) & (np.abs(at[:, 2]) < half_z)
            crossings[crossed[inside]] += (change[crossed[inside]] / 2.0).astype(int)
        before = now
    if crossings is None:
        raise ValueError("there are no frames")
    return crossings


def leakage(frames: Iterable[Frame], body: Tool, edge: float = 0.0) -> float:
    """Share of the soil that met a thin body and went through it [-].

    Soil that met it: particles that crossed it, or were in some frame within the box around it widened by its thickness
    to either side. `edge` as in `leaked`.
    """
    frames = list(frames)
    through = leaked(frames, body, edge) != 0
    near = body.half_size * [3.0, 1.0, 1.0]
    met = through.copy()
    for frame in frames:
        back = frame.body_pose[3:] * [-1.0, -1.0, -1.0, 1.0]
        met |= np.all(np.abs(rotate(back, frame.position.astype(float) - frame.body_pose[:3])) < near, axis=1)
    return float(through.sum() / max(1, met.sum()))
