"""`sgns frontier`: measure what accuracy costs in time, and gather it into a table, figures and a page."""

from __future__ import annotations

import importlib
import logging
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from sgns.claim import claimed_in_turn
from sgns.errors import UserError
from sgns.frontier.gather import gathered
from sgns.frontier.page import PAGE, write_study
from sgns.frontier.study import AXES, Study
from sgns.leftovers import require_replaceable

__all__ = ["main"]

log = logging.getLogger(__name__)

# Axis → module and function that measures the points of a study that are missing.
MEASURES = {
    "solver": ("sgns.frontier.solver_points", "measure_solver"),
    "reduction": ("sgns.frontier.reduction_points", "measure_reduction"),
    "surrogate": ("sgns.frontier.surrogate_points", "measure_surrogates"),
}


def main(cfg: DictConfig) -> None:
    """The command."""
    study = Study.from_settings(OmegaConf.to_container(cfg.study, resolve=True), Path(cfg.output))
    axes = axes_of(cfg.axis)
    folder = study.folder
    measured = (*(folder / "points").glob("*.json"), *(folder / "observations").glob("*.npz"))
    require_replaceable(
        *(folder / name for name in ("study.yaml", "points.csv", PAGE)),
        *(folder / "figures").glob("*.png"),
        *(file for file in measured if not file.is_file()),  # those that are there are read only
    )
    if axes:
        with claimed_in_turn(folder / "study.yaml"):  # what it says is read and added to
            study.record()
    for axis in axes:
        module, function = MEASURES[axis]
        getattr(importlib.import_module(module), function)(study)
    if axes and not any(study.store.has(s.name, "solver", s.reference.label) for s in study.scenes):
        # Another process is still at it; what was measured here is kept.
        log.info("no reference is there yet, so nothing can be judged; later: sgns frontier axis=none")
        return
    with claimed_in_turn(folder / PAGE):  # of several that gather at once the last sees all points
        page = write_study(study, gathered(study))
    log.info("%s and the table and figures beside it", page)


def axes_of(asked: str | None) -> tuple[str, ...]:
    """The axes that one command measures."""
    if asked is None or asked == "all":
        return AXES
    if asked == "none":
        return ()
    if asked not in AXES:
        raise UserError(f"axis is {asked!r}; allowed: {', '.join(AXES)}, all, none (only gather)")
    return (asked,)
