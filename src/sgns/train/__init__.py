"""`sgns train`: windows, loss, validation, and the fit of every kind of model.

A kind of model is its settings (`sgns.settings`), its `Dynamics` (`sgns.model`), a file here with a `Fit`, and a line
in `command.FITS`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from lightning.fabric.plugins.environments import ClusterEnvironment
    from lightning.pytorch.loggers import TensorBoardLogger

    from sgns.model.checkpoint import Surrogate
    from sgns.reduction.reduce import ReducedDataset, ReducedRun
    from sgns.train.validation import RolloutScore


class Task(NamedTuple):
    """What is to be fitted, to what, and where the result goes."""

    reduced: ReducedDataset  # the dataset in its basis
    validation_runs: list[ReducedRun]  # what the result is chosen by
    num_modes: int  # r, modes used of the basis
    model: Any  # settings of the model
    settings: Any  # of the training
    output: Path  # folder, there, in which `best.ckpt` is to be written
    seed: int  # of weights, noise and order
    device: str  # cpu or cuda
    start_from: str | Path | None  # checkpoint to start from
    resumed: bool  # whether `last.ckpt` is there to go on from
    card: dict[str, Any]  # plain values for the checkpoint
    logger: TensorBoardLogger  # for what is to be seen on the way
    environment: ClusterEnvironment  # which of the training's processes this is


class Fitted(NamedTuple):
    """A fit whose checkpoint is written."""

    surrogate: Surrogate
    score: RolloutScore  # on the validation runs
    seconds: float  # wall time [s]
    about: dict[str, Any]  # what training.json says of it besides


class Fit(NamedTuple):
    """How one kind of model is fitted."""

    stand_ins: slice  # training runs that do what validation runs would, where there are none
    stand_ins_do: str  # what these then do, in words
    run: Callable[[Task], Fitted]  # fits; raises a UserError for bad settings and losses that are not finite
