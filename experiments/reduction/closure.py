"""How much of the soil do modes hold that follow from the first few, and what does decoding them cost?

    python experiments/reduction/closure.py data/quick --checkpoint outputs/demo/best.ckpt
    python experiments/reduction/closure.py data/paper_excavation --runs 25 50 100 200

True coordinates of the test runs; with `--checkpoint`, of a training on this dataset, also those of its rollouts from
rest, which have errors. The basis is always that of all training runs; with `--runs` closures
are fitted to so many of them, drawn at random, once for each number. Decode times are processor times of single frames
on one thread, in turn. Puts the rows of this dataset into closure.csv, in place of those of the same name.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from common import read_rows, write_rows

from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.data.surface import height_map, surface_grid
from sgns.evaluate.metrics import height_error
from sgns.reduction.basis import Basis
from sgns.reduction.closure import fit_closure
from sgns.reduction.reduce import ReducedDataset, reduce_dataset
from sgns.settings import ReductionSettings
from sgns.simulator import Simulator

EVERY = 12  # of the test runs' frames every twelfth counts
LINEAR = (8, 16, 32, 64)
CLOSURES = [(kind, *modes) for kind in ("kernel", "quadratic") for modes in ((8, 32), (8, 64), (16, 64))]
TABLE = Path(__file__).with_name("closure.csv")


class Method(NamedTuple):
    """A way to decode the soil."""

    name: str
    training_runs: int
    basis: Basis


def methods(reduced: ReducedDataset, counts: Sequence[int]) -> list[Method]:
    """All that the basis has modes for; closures of so many training runs each."""
    basis, known = reduced.basis, reduced.runs("train")
    found = [Method(f"linear {r}", len(known), basis.sliced(r)) for r in LINEAR if r <= basis.num_modes]
    order = np.random.default_rng(0).permutation(len(known))
    validation = [run.latent for run in reduced.runs("validation")]
    for count in counts or [len(known)]:
        if not 0 < count <= len(known):
            raise SystemExit(f"--runs {count}: there are {len(known)} training runs")
        train = [known[i].latent for i in sorted(order[:count])]
        for kind, r, last in CLOSURES:
            if last <= basis.num_modes:
                closure = fit_closure(kind, basis.modes[:, :last], r, train, validation).closure
                closed = replace(basis.sliced(r), closure=closure)
                found.append(Method(f"{kind} {r} to {last}", count, closed))
    return found


def decoded(
    paths: Sequence[Path], basis: Basis, ways: Sequence[Method], simulator: Simulator | None
) -> np.ndarray:
    """Of every way and frame: mean squares of positions and of the surface [m^2], decode time [s], and both mean
    squares after a rollout or NaN, (m, t, 5)."""
    found: list[list[tuple[float, ...]]] = []
    for path in paths:
        with Run(path) as run:
            grid = surface_grid(run.positions(slice(0, 1))[0])
            frames = run.positions(slice(EVERY, None, EVERY)).astype(np.float64)
            rolled = torch.as_tensor(simulator.rollout(run.pose).latent)[EVERY::EVERY] if simulator else None
        for index, frame in enumerate(frames):
            latent, heights = basis.transform(frame), height_map(frame, grid)

            def errors(soil: np.ndarray, frame=frame, heights=heights, grid=grid) -> tuple[float, float]:
                return float(np.mean((soil - frame) ** 2)), height_error(height_map(soil, grid), heights)

            found.append([])
            for way in ways:
                began = time.process_time()
                soil = way.basis.inverse(latent[: way.basis.num_modes]).numpy()
                seconds = time.process_time() - began
                after = np.nan, np.nan
                if rolled is not None and rolled.shape[1] == way.basis.num_modes:
                    after = errors(way.basis.inverse(rolled[index]).numpy())
                found[-1].append((*errors(soil), seconds, *after))
    return np.array(found).swapaxes(0, 1)


def measured(
    folder: Path, counts: Sequence[int], checkpoint: Path | None = None, table: Path = TABLE
) -> None:
    """Write the rows of a dataset."""
    torch.set_num_threads(1)
    dataset = Dataset.open(folder)
    reduced = reduce_dataset(dataset, ReductionSettings().to_dict())
    simulator = Simulator.load(checkpoint) if checkpoint else None
    if simulator and not torch.equal(simulator.basis.modes, reduced.basis.modes[:, : simulator.num_modes]):
        raise SystemExit(f"{checkpoint} belongs to another basis; train it on {folder}")
    ways = methods(reduced, counts)
    rows = [row for row in read_rows(table) if row["dataset"] != dataset.title]
    found = decoded(dataset.runs("test"), reduced.basis, ways, simulator)
    for way, errors in zip(ways, found, strict=True):
        position, surface, _, *after = (float(value) for value in errors.mean(axis=0))
        row: dict[str, object] = {
            "dataset": dataset.title,
            "method": way.name,
            "training_runs": way.training_runs,
            "test_position_rmse_mm": 1e3 * position**0.5,
            "test_surface_rmse_mm": 1e3 * surface**0.5,
            "decode_ms_per_frame": 1e3 * float(np.median(errors[:, 2])),
        }
        if not np.isnan(after[0]):
            row["rollout_position_rmse_mm"], row["rollout_surface_rmse_mm"] = (1e3 * x**0.5 for x in after)
        rows.append(row)
    write_rows(table, rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="folder of a dataset")
    parser.add_argument("--runs", type=int, nargs="+", default=[], help="training runs of the closures")
    parser.add_argument("--checkpoint", type=Path, help="a training on this dataset, to roll out")
    given = parser.parse_args()
    measured(given.dataset, given.runs, given.checkpoint)
