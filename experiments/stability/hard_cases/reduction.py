"""Hard cases of the reduction.

Letters: t frames, n particles, r modes.
"""

from __future__ import annotations

from functools import partial

import h5py
import numpy as np
import torch
import yaml

from sgns.data.dataset import Dataset
from sgns.reduction.basis import Basis
from sgns.reduction.pca import IncrementalPCA
from sgns.reduction.reduce import reduce_dataset
from sgns_testing.tiny import REDUCTION, make_dataset

from .measures import unsaid
from .networks import new_folder


def soil(t: int = 40, n: int = 60, rank: int | None = None, offset: float = 0.0, seed: int = 0) -> np.ndarray:
    """A bed of 1 m whose particles move by 0.1 m in `rank` ways; (t, n, 3) [m]."""
    chance = np.random.default_rng(seed)
    rank = min(3 * t, n) if rank is None else rank
    ways = chance.normal(size=(rank, n)) * 0.8 ** np.arange(rank)[:, None]
    moved = 0.1 * np.einsum("tak,kn->tna", chance.normal(size=(t, 3, rank)), ways) / np.linalg.norm(ways[0])
    return chance.uniform(size=(n, 3)) + moved + offset


def fitted(positions: np.ndarray, modes: int, batch: int = 7, centring: str = "particle_axis") -> Basis:
    """All modes up to a number, of frames given in batches."""
    pca = IncrementalPCA(modes)
    for first in range(0, len(positions), batch):
        pca.partial_fit(positions[first : first + batch])
    return pca.basis(centring, pca.rank(centring))


def askew(basis: Basis) -> float:
    """Largest entry of |U'U - 1|."""
    gram = basis.modes.T @ basis.modes
    return float((gram - torch.eye(len(gram))).abs().max())


def missed(basis: Basis, positions: np.ndarray) -> float:
    """Largest error of projecting and reconstructing [m]."""
    return float((basis.inverse(basis.transform(positions)) - torch.as_tensor(positions)).abs().max())


def turned(a: Basis, b: Basis) -> float:
    """Sine of the largest angle between two subspaces."""
    rest = b.modes - a.modes @ (a.modes.T @ b.modes)
    return float(torch.linalg.matrix_norm(rest, ord=2))


def rank_deficient() -> tuple[float, str]:
    positions = soil(rank=5)
    basis = fitted(positions, 16)
    return abs(basis.num_modes - 5), f"reconstruction to {missed(basis, positions):.1e} m"


def constant() -> float:
    pca = IncrementalPCA(8)
    pca.partial_fit(np.repeat(soil(t=1), 50, axis=0))
    return pca.rank()


def constant_dataset() -> tuple[float, str]:
    folder = new_folder()
    dataset = make_dataset(folder)
    for path in (folder / "runs").iterdir():
        with h5py.File(path, "r+") as file:
            values = file["particles/soil/position/value"]
            values[...] = values[:1].repeat(len(values), axis=0)
    return unsaid(lambda: reduce_dataset(dataset, REDUCTION), "nothing moves", "rank 0", "simulate")


def duplicates() -> float:
    positions = soil(t=30, n=40)
    twice = np.concatenate([np.repeat(positions, 3, axis=0)] * 2, axis=1)
    basis = fitted(twice, 24)
    return max(askew(basis), float((basis.modes[:40] - basis.modes[40:]).abs().max()))


def huge_offset() -> float:
    positions = soil(rank=6)
    return turned(fitted(positions, 6), fitted(positions + 1e6, 6))


def huge_offset_in_float32() -> tuple[float, str]:
    """float32 keeps 6 cm at 1e6 m, and nothing moves more than that: all there is to be seen is rounding."""
    pca = IncrementalPCA(16)
    pca.partial_fit((0.01 * soil(rank=6) + 1e6).astype(np.float32))
    return pca.rank(), ""


def offset_in_float32() -> tuple[float, str]:
    """float32 keeps 8 um at 100 m, which resolves the six ways of moving and makes none of its own."""
    pca = IncrementalPCA(16)
    pca.partial_fit((soil(t=100, rank=6) + 100.0).astype(np.float32))
    return abs(pca.rank() - 6), ""


def wide() -> float:
    return askew(fitted(soil(t=4, n=100_000), 12))


def tall() -> float:
    positions = soil(t=20_000, n=3)
    return missed(fitted(positions, 3, batch=997), positions[::100])


def one_particle() -> float:
    positions = soil(t=50, n=1)
    return missed(fitted(positions, 4), positions)


def one_frame() -> tuple[float, str]:
    pca = IncrementalPCA(4)
    pca.partial_fit(soil(t=1))
    return unsaid(lambda: pca.basis(num_modes=2), "rank 0", "1 frames", "add runs")


def one_run() -> tuple[float, str]:
    folder = new_folder()
    make_dataset(folder)
    split = {"train": ["a"], "validation": ["e", "f"], "test": ["g"]}
    (folder / "dataset.yaml").write_text(yaml.safe_dump({"name": "tiny", "split": split}))
    dataset = Dataset.open(folder)
    reduced = reduce_dataset(dataset, REDUCTION | {"max_modes": 40, "num_modes": 1})
    return askew(reduced.basis), f"{len(dataset.runs('train'))} run, {reduced.basis.num_modes} modes"


def batches_of_one() -> float:
    positions = soil(t=300, n=50)
    one, many = fitted(positions, 8, batch=1), fitted(positions, 8, batch=300)
    return float((one.modes - many.modes).abs().max())


def modes_of_all_sizes() -> float:
    chance = np.random.default_rng(1)
    ways = np.linalg.qr(chance.normal(size=(80, 24)))[0].T * 10.0 ** -np.linspace(0, 12, 24)[:, None]
    return askew(fitted(np.einsum("tak,kn->tna", chance.normal(size=(60, 3, 24)), ways), 24))


def equal_modes() -> float:
    """All directions alike: any basis is as good, but it has to be one."""
    positions = np.random.default_rng(2).normal(size=(200, 40, 3))
    basis = fitted(positions, 8)
    return max(askew(basis), float(basis.displacement_energy(8) > 1))


def tiny_motion() -> float:
    still, moving = soil(t=1, rank=4), soil(rank=4)
    small = still + 1e-8 * (moving - moving.mean(0))
    return turned(fitted(moving, 4), fitted(small, 4))


def truncated_stream() -> tuple[float, str]:
    """300 directions that hardly fall off, of which 8 + 16 are tracked."""
    chance = np.random.default_rng(3)
    ways = np.linalg.qr(chance.normal(size=(400, 300)))[0].T * 0.995 ** np.arange(300)[:, None]
    positions = np.einsum("tak,kn->tna", chance.normal(size=(400, 3, 300)), ways)
    rows = (positions - positions.mean(0)).transpose(0, 2, 1).reshape(-1, 400)
    best = float((np.linalg.svd(rows, compute_uv=False)[:8] ** 2).sum())
    basis = fitted(positions, 8, batch=11)
    got = float(((rows @ basis.modes.numpy()) ** 2).sum())
    return 100 * (1 - got / best), ""


def poisoned(split: str, value: float) -> tuple[float, str]:
    """One particle of one frame of one run is no number."""
    name = {"train": "b", "validation": "f"}[split]
    folder = new_folder()
    dataset = make_dataset(folder)
    with h5py.File(folder / "runs" / f"{name}.h5", "r+") as file:
        file["particles/soil/position/value"][9, 31, 1] = value
    words = f"{name}.h5", "particle 31", "along y", "frame 9", str(value)
    return unsaid(lambda: reduce_dataset(dataset, REDUCTION), *words)


def beyond_the_rank() -> tuple[float, str]:
    dataset = make_dataset(new_folder(), n=5)
    return unsaid(
        lambda: reduce_dataset(dataset, REDUCTION | {"num_modes": 6}),
        "num_modes is 6",
        "give 3 modes",
        "at most 3",
    )


def mixture_of_beds() -> tuple[float, str]:
    folder = new_folder()
    dataset = make_dataset(folder)
    make_dataset(folder / "other", n=51)
    (folder / "other" / "runs" / "c.h5").replace(folder / "runs" / "c.h5")
    return unsaid(lambda: reduce_dataset(dataset, REDUCTION), "c.h5", "one basis serves one bed")


MEASURES = {
    "rank 5 of 60": rank_deficient,
    "soil that never moves": constant,
    "dataset that never moves": constant_dataset,
    "every particle and frame several times": duplicates,
    "bed 1000 km from the origin": huge_offset,
    "1000 km in float32, motion below rounding": huge_offset_in_float32,
    "100 m from the origin in float32": offset_in_float32,
    "100 000 particles, 4 frames": wide,
    "3 particles, 20 000 frames": tall,
    "one particle": one_particle,
    "one frame": one_frame,
    "one training run, all modes": one_run,
    "batches of one frame": batches_of_one,
    "modes from 1 m down to 1 pm": modes_of_all_sizes,
    "all variances alike": equal_modes,
    "soil moves by a nanometre": tiny_motion,
    "300 alike directions, 24 tracked": truncated_stream,
    "NaN in a training run": partial(poisoned, "train", np.nan),
    "infinity in a training run": partial(poisoned, "train", np.inf),
    "NaN in a validation run": partial(poisoned, "validation", np.nan),
    "more modes than the data has": beyond_the_rank,
    "runs of two beds": mixture_of_beds,
}
