"""Does a small autoencoder keep more of the soil in 3 r numbers than PCA does?

    python experiments/reduction/autoencoder.py data/quick

It works on the first 64 PCA coordinates of each axis. Trained on the training runs, stopped by the validation runs;
the test runs have seen neither. Writes autoencoder.csv beside this script; errors are of positions, what the 64
modes leave out included.
"""

from __future__ import annotations

import argparse
import copy
import csv
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_module
from torch import Tensor, nn

from sgns.data.dataset import SPLITS, Dataset
from sgns.reduction.basis import reconstruction_curve
from sgns.reduction.reduce import reduce_dataset

HERE = Path(__file__).parent
SIZES = (2, 4, 8)
SEEDS = (0, 1, 2)
STEPS, VALIDATE_EVERY, BATCH = 1600, 100, 256


class Autoencoder(nn.Module):
    """c -> 3 r numbers -> c: a linear map, PCA at first, and a network beside it that starts at zero."""

    def __init__(self, inputs: int, latent: int, width: int = 128) -> None:
        super().__init__()
        self.narrow = nn.Linear(inputs, latent, bias=False)
        self.widen = nn.Linear(latent, inputs, bias=False)
        with torch.no_grad():
            self.narrow.weight.copy_(torch.eye(latent, inputs))
            self.widen.weight.copy_(torch.eye(inputs, latent))
        self.encoder, self.decoder = (
            nn.Sequential(
                nn.Linear(a, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, b)
            )
            for a, b in ((inputs, latent), (latent, inputs))
        )
        for network in (self.encoder, self.decoder):
            nn.init.zeros_(network[-1].weight)
            nn.init.zeros_(network[-1].bias)

    def forward(self, c: Tensor, scale: Tensor) -> Tensor:
        """Coordinates (B, inputs) [unit of c]; `scale` makes the networks' inputs of order one."""
        z = self.narrow(c) + scale[: self.narrow.out_features] * self.encoder(c / scale)
        return self.widen(z) + scale * self.decoder(z / scale[: self.narrow.out_features])


def error(model: Autoencoder, c: Tensor, scale: Tensor) -> float:
    """Sum over coordinates of the squared error, mean over frames."""
    with torch.no_grad():
        return float((model(c, scale) - c).square().sum(1).mean())


def train(c: dict[str, Tensor], latent: int, scale: Tensor, seed: int) -> Autoencoder:
    """The model with the smallest error on the validation runs."""
    torch.manual_seed(seed)
    model = Autoencoder(c["train"].shape[1], latent)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    best, found = float("inf"), model
    for step in range(STEPS + 1):
        if step % VALIDATE_EVERY == 0 and (now := error(model, c["validation"], scale)) < best:
            best, found = now, copy.deepcopy(model)
        batch = c["train"][torch.randint(len(c["train"]), (BATCH,))]
        loss = (model(batch, scale) - batch).square().sum(1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", nargs="?", default="data/quick", help="folder of a complete campaign")
    dataset = Dataset.open(parser.parse_args().dataset)
    with initialize_config_module("sgns.conf", version_base="1.3"):
        reduced = reduce_dataset(dataset, compose("reduce").reduction)
    curves = {
        split: np.append(np.nan, reduced.basis.residual_mse())
        if split == "train"
        else reconstruction_curve([Path(path) for path in dataset.runs(split)], reduced.basis)
        for split in SPLITS
    }
    latent = {split: np.concatenate([run.latent for run in reduced.runs(split)]) for split in SPLITS}
    # Mode by mode, axes within, so that the first 3 r numbers are the first r modes; in units of the strongest.
    unit = float(latent["train"].std(0).max())
    c = {split: torch.from_numpy(z.reshape(len(z), -1) / unit).float() for split, z in latent.items()}
    # The mirrored bed does not move sideways at all: no number is blown up more than a hundredfold.
    scale = c["train"].std(0).clamp_min(1e-2)

    def row(method: str, r: int, seed: str, mse: dict[str, float]) -> dict[str, str]:
        line = {"method": method, "modes": str(r), "seed": seed}
        line |= {f"rmse_{split}_mm": f"{1e3 * value**0.5:.4f}" for split, value in mse.items()}
        print(*line.values(), sep="  ", flush=True)
        return line

    rows = []
    for r in SIZES:
        rows.append(row("PCA", r, "", {split: float(curve[r]) for split, curve in curves.items()}))
        for seed in SEEDS:
            model = train(c, 3 * r, scale, seed)
            to_mse = unit**2 / (3 * reduced.basis.num_particles)
            mse = {s: error(model, c[s], scale) * to_mse + float(curves[s][-1]) for s in SPLITS}
            rows.append(row("autoencoder", r, str(seed), mse))
    with (HERE / "autoencoder.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
