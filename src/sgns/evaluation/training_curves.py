"""How a network was trained: loss and skill by step, from the log beside its checkpoint."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mpm_warp.inputs import open_file
from sgns.errors import UserError
from sgns.evaluation.figures import ACCENT, BASELINE, NETWORK, PICTURE_WIDTH, TRUTH, new_figure, styled

__all__ = ["read_log", "training_figure"]

VALIDATION = {
    "skill/validation": ("position skill", NETWORK),
    "force_nrmse/validation": ("force NRMSE", ACCENT),
}
# Of the losses; what a model predicts decides which there are.
COLOURS = {"total": TRUTH, "force": ACCENT, "torque": BASELINE}
# Skill and NRMSE beyond these say only that a rollout ran away.
LOWEST, HIGHEST = -0.5, 1.5
MOST_BYTES = 1 << 26  # of a log, all files together; a day of training writes a tenth of that


def read_log(folder: Path) -> dict[str, np.ndarray]:
    """Scalars of a TensorBoard folder: name → steps and values, shape (k, 2); empty if there is no log.

    Raises:
        UserError: It holds what is no log.
    """
    if not folder.is_dir():
        return {}
    advice = "remove it: only a figure of the report needs it"
    left = MOST_BYTES
    for file in sorted(folder.iterdir()):
        if "tfevents" in file.name:  # what TensorBoard would read
            try:
                with open_file(file, left) as content:
                    left -= os.fstat(content.fileno()).st_size
            except (OSError, ValueError) as error:
                raise UserError(f"{file} is no log of TensorBoard ({error}); {advice}") from error
    try:
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    except Exception as error:  # whatever bytes do to a reader that is not ours
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{folder} holds no log of TensorBoard ({reason:.200}); {advice}") from error
    # A training that was killed logs some steps again, and its files are out of order if the clock went back.
    return {
        name: np.array(sorted({e.step: e.value for e in events.Scalars(name)}.items()), dtype=np.float64)
        for name in events.Tags()["scalars"]
        if name.startswith("loss/") or name in VALIDATION
    }


@styled
def training_figure(log: Mapping[str, np.ndarray]) -> Figure:
    """Training losses above, the rollouts of the validation runs below."""
    figure = new_figure(PICTURE_WIDTH, 4.4)
    losses, rollouts = figure.subplots(2, 1, sharex=True)
    for name in sorted(name for name in log if name.startswith("loss/")):
        label = name.removeprefix("loss/")
        losses.plot(*log[name].T, color=COLOURS.get(label, NETWORK), label=label, linewidth=1.2)
        losses.set_yscale("log")
        losses.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
        losses.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        losses.yaxis.set_minor_formatter(NullFormatter())
    for name, (label, colour) in VALIDATION.items():
        if name in log:
            rollouts.plot(*log[name].T, color=colour, label=label, marker=".")
    values = np.concatenate([[0.0, 1.0], *(log[name][:, 1] for name in VALIDATION if name in log)])
    values = np.clip(values[np.isfinite(values)], LOWEST, HIGHEST)
    rollouts.set_ylim(values.min() - 0.05 * (values.min() < 0.0), values.max() + 0.05)
    for axis, label in ((losses, "loss"), (rollouts, "validation rollouts")):
        axis.set_ylabel(label)
        axis.grid(alpha=0.25, linewidth=0.6)
        if axis.lines:
            axis.legend(ncols=2, fontsize=8.5)
    rollouts.set_xlabel("training step")
    return figure
