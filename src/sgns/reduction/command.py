"""`sgns reduce`: the basis of a dataset, its errors for every number of modes, and reduced runs."""

from __future__ import annotations

import csv
import logging
import math
from pathlib import Path

from omegaconf import DictConfig

from sgns.config import UserError
from sgns.data.dataset import Dataset
from sgns.data.files import only_here, whole_file
from sgns.reduction.basis import ReductionCurves, reduction_curves
from sgns.reduction.packed import pack
from sgns.reduction.reduce import reduce_dataset

log = logging.getLogger(__name__)


def main(cfg: DictConfig) -> float:
    """The `sgns reduce` command; returns the mean squared reconstruction error on the training runs [m²]."""
    if "format" in cfg.dataset:
        raise UserError(f"dataset={cfg.dataset.name} is reduced already; train with it")
    dataset = Dataset.open(cfg.dataset.path, cfg.dataset.get("where"))
    table = Path(cfg.output) / "energy.csv"
    with only_here(table):
        reduced = reduce_dataset(dataset, cfg.reduction, device=cfg.device)
        basis, used = reduced.basis, reduced.num_modes
        validation = dataset.runs("validation")
        curves = reduction_curves(basis, validation)
        write_energy_table(curves, table)
    log.info("%s", "\n".join(energy_lines(curves, used)))
    log.info("errors on %d training and %d validation runs", len(basis.fitted_on), len(validation))
    log.info("every number of modes: %s; basis and reduced runs: %s", table, reduced.folder)
    if cfg.get("pack") is not None:
        log.info("%s", pack(reduced, Path(cfg.pack)))
    return float(basis.residual_mse(used))


def energy_lines(curves: ReductionCurves, used: int) -> list[str]:
    """A table for the terminal: powers of two, all modes, and the number in use."""
    last = len(curves.energy)
    lines = ["modes  energy     displacement energy  training RMSE [mm]  validation RMSE [mm]"]
    for r in sorted({2**k for k in range(last.bit_length())} | {used, last}):
        training, held_out = (1e3 * math.sqrt(mse) for mse in (curves.training[r - 1], curves.held_out[r]))
        lines.append(
            f"{r:5d}  {curves.energy[r - 1]:.6f}  {curves.displacement_energy[r - 1]:19.6f}  {training:18.3f}  "
            f"{held_out:20.3f}" + ("  <- reduction.num_modes" if r == used else "")
        )
    return lines


def write_energy_table(curves: ReductionCurves, path: Path) -> None:
    """`energy.csv`: a line for every number of modes; the validation column is empty without such runs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["modes", "energy", "displacement_energy", "mse_training_m2", "mse_validation_m2"])
        columns = (curves.energy, curves.displacement_energy, curves.training, curves.held_out[1:])
        for r, values in enumerate(zip(*columns, strict=True), start=1):
            writer.writerow([r, *("" if math.isnan(value) else float(value) for value in values)])
