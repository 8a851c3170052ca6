"""`sgns train`: windows, loss, validation, and the fit of every kind of model.

A kind of model is its settings (`sgns.settings`), its `Dynamics` (`sgns.model`), a file here with a `Fit`, and a line
in `command.FITS`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from lightning.pytorch.loggers import TensorBoardLogger

    from sgns.model.checkpoint import Surrogate
    from sgns.reduction.reduce import ReducedDataset, ReducedRun
    from sgns.train.callbacks import RolloutScore


class Task(NamedTuple):
    """What is to be fitted, to what, and where the result goes.

    Attributes:
        reduced: The dataset in its basis.
        validation_runs: What the result is chosen by.
        num_modes: r, modes used of the basis.
        model: Settings of the model.
        settings: Of the training.
        output: Folder, there, in which `best.ckpt` is to be written.
        seed: Of weights, noise and order.
        device: "cpu" or "cuda".
        start_from: Checkpoint to start from.
        resumed: Whether `last.ckpt` is there to go on from.
        card: Plain values for the checkpoint.
        logger: For what is to be seen on the way.
    """

    reduced: ReducedDataset
    validation_runs: list[ReducedRun]
    num_modes: int
    model: Any
    settings: Any
    output: Path
    seed: int
    device: str
    start_from: str | Path | None
    resumed: bool
    card: dict[str, Any]
    logger: TensorBoardLogger


class Fitted(NamedTuple):
    """A fit whose checkpoint is written.

    Attributes:
        surrogate: The result.
        score: On the validation runs.
        seconds: Wall time [s].
        about: What training.json says of it besides.
    """

    surrogate: Surrogate
    score: RolloutScore
    seconds: float
    about: dict[str, Any]


class Fit(NamedTuple):
    """How one kind of model is fitted.

    Attributes:
        stand_ins: Training runs that do what validation runs would.
        run: Fits; raises a UserError for bad settings and losses that are not finite.
    """

    stand_ins: Callable[[list[ReducedRun]], list[ReducedRun]]
    run: Callable[[Task], Fitted]
