"""What both commands read and where they write: a run that can be drawn, the name of its picture."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from sgns.config import UserError
from sgns.data.files import require_replaceable
from sgns.data.run import Run
from sgns.evaluate.views import view_times


def picture_place(cfg: DictConfig, suffix: str) -> Path:
    """Where the picture goes: `cfg.output`, else beside the run with its name.

    Raises:
        UserError: it has another suffix, or is there and `cfg.overwrite` is false.
    """
    path = Path(cfg.run).with_suffix(suffix) if cfg.output is None else Path(cfg.output)
    if path.suffix.lower() != suffix:
        raise UserError(
            f"output is {path}; the picture is a {suffix} file: output={path.with_suffix(suffix)}"
        )
    if path.is_file() and not cfg.overwrite:
        raise UserError(f"{path} is there already; choose another output, or replace it with overwrite=true")
    require_replaceable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def shown_times(run: Run, count: int = 3) -> list[int]:
    """Frames for side views: fewer than `count` of a run that has fewer."""
    return sorted(set(view_times(run, min(int(run.extra.get("history") or 0), run.frame_count - 1), count)))


def require_finite(run: Run, frames: Iterable[int]) -> None:
    """Refuses a run whose body, or whose soil at some frames, has no place that could be drawn.

    Raises:
        UserError: it names the frame.
    """
    body = np.isfinite(np.hstack([run.pose, run.force, run.torque])).all(axis=1)
    for frame in frames:
        soil = run.positions(frame), run.velocities(frame)
        if not (body[frame] and all(np.isfinite(part).all() for part in soil)):
            raise UserError(
                f"{run.path}: frame {frame} is not finite; `sgns check {run.path}` lists everything"
            )
