"""How much of the soil do modes hold that follow from the first few, and what does decoding them cost?

    python experiments/reduction/closure.py data/quick

True coordinates of the test runs, no network. Decode times are processor times of single frames on one thread, in turn.
Writes closure.csv.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from common import write_rows
from torch import Tensor

from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.data.surface import height_map, surface_grid
from sgns.evaluate.metrics import height_error
from sgns.reduction.basis import Basis
from sgns.reduction.closure import fit_closure
from sgns.reduction.reduce import reduce_dataset
from sgns.settings import ReductionSettings

EVERY = 12  # of the test runs' frames every twelfth counts
Latents = Sequence[np.ndarray]
Decoder = Callable[[Tensor], Tensor]


def kernel(r: int, last: int) -> Callable[[Basis, Latents, Latents], Decoder]:
    def fitted(basis: Basis, train: Latents, validation: Latents) -> Decoder:
        closure = fit_closure(basis.modes[:, :last], r, train, validation).closure
        return replace(basis.sliced(r), closure=closure).inverse

    return fitted


def linear(r: int) -> Callable[[Basis, Latents, Latents], Decoder]:
    return lambda basis, train, validation: basis.sliced(r).inverse


def quadratic(r: int, last: int) -> Callable[[Basis, Latents, Latents], Decoder]:
    """Ridge regression on products of two standardised coordinates; validation runs choose the penalty."""

    def fitted(basis: Basis, train: Latents, validation: Latents) -> Decoder:
        known, other = (torch.from_numpy(np.concatenate(runs))[:, :last] for runs in (train, validation))
        mean, scale = known[:, :r].mean(0), known[:, :r].std(0)
        scale = scale.clamp_min(0.01 * float(scale.max()))

        def terms(z: Tensor) -> Tensor:
            x = ((z - mean) / scale).flatten(-2)
            x = torch.nn.functional.pad(x, (1, 0), value=1.0)
            i, j = torch.triu_indices(x.shape[-1], x.shape[-1])
            return x[..., i] * x[..., j]

        a, target = terms(known[:, :r]), known[:, r:].flatten(1)
        free = torch.eye(a.shape[1], dtype=a.dtype)
        free[0, 0] = 0.0

        def weights(penalty: float) -> Tensor:
            return torch.linalg.solve(a.T @ a / len(a) + penalty * free, a.T @ target / len(a))

        seen = terms(other[:, :r])
        best = min(
            (weights(10.0**k) for k in range(-3, 4)),
            key=lambda w: float((seen @ w - other[:, r:].flatten(1)).square().sum()),
        )
        whole = basis.sliced(last)
        return lambda z: whole.inverse(torch.cat([z, (terms(z) @ best).unflatten(-1, (last - r, 3))], dim=-2))

    return fitted


METHODS = {f"linear {r}": (r, linear(r)) for r in (8, 16, 32, 64)}
METHODS |= {f"quadratic {r} to {last}": (r, quadratic(r, last)) for r, last in ((8, 32),)}
METHODS |= {f"kernel {r} to {last}": (r, kernel(r, last)) for r, last in ((8, 32), (16, 64))}


def decoded(paths: Sequence[Path], basis: Basis, decoders: dict[str, Decoder]) -> dict[str, np.ndarray]:
    """By method, of every frame, (t, 3): mean squares of positions and of the surface [m^2], and decode time [s]."""
    found: dict[str, list[list[float]]] = {name: [] for name in decoders}
    for path in paths:
        with Run(path) as run:
            frames = run.positions(slice(0, None, EVERY)).astype(np.float64)
        grid = surface_grid(frames[0])
        for frame in frames:
            latent, heights = basis.transform(frame), height_map(frame, grid)
            for name, decode in decoders.items():
                began = time.process_time()
                soil = decode(latent[: METHODS[name][0]]).numpy()
                seconds = time.process_time() - began
                surface = height_error(height_map(soil, grid), heights)
                found[name].append([float(np.mean((soil - frame) ** 2)), surface, seconds])
    return {name: np.array(values) for name, values in found.items()}


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    dataset = Dataset.open(folder)
    reduced = reduce_dataset(dataset, ReductionSettings().to_dict(), progress=False)
    basis = reduced.basis
    train, validation = ([run.latent for run in reduced.runs(split)] for split in ("train", "validation"))
    decoders = {name: fit(basis, train, validation) for name, (_, fit) in METHODS.items()}
    tested = decoded(dataset.runs("test"), basis, decoders)
    rows = []
    for name in METHODS:
        position, surface, _ = tested[name].mean(axis=0)
        rows.append(
            {
                "method": name,
                "test_position_rmse_mm": 1e3 * float(position) ** 0.5,
                "test_surface_rmse_mm": 1e3 * float(surface) ** 0.5,
                "decode_ms_per_frame": 1e3 * float(np.median(tested[name][:, 2])),
            }
        )
    write_rows(Path(__file__).with_name("closure.csv"), rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
