"""A small autoencoder on PCA coordinates, beside PCA with as many numbers."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor, nn

SIZES = (2, 4, 8)
SEEDS = (0, 1, 2)
STEPS, VALIDATE_EVERY, BATCH = 4000, 200, 256


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


def train(c: dict[str, Tensor], latent: int, seed: int) -> Autoencoder:
    """The model with the smallest error on the validation runs."""
    torch.manual_seed(seed)
    scale = c["train"].std(0)
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


def compare(latent: dict[str, tuple[np.ndarray, float]], particles: int) -> list[dict[str, str]]:
    """RMSE [mm] of PCA and autoencoders with 3 r numbers, in every split.

    Args:
        latent: For every split, PCA coordinates (T, 64, 3) [m] and the variance outside them [m²].
        particles: n, to turn errors of coordinates into errors of positions.
    """
    # Mode by mode, axes within, so that the first 3 r numbers are the first r modes; in units of the strongest.
    unit = float(latent["train"][0].std(0).max())
    c = {
        split: torch.from_numpy(values.reshape(len(values), -1) / unit).float()
        for split, (values, _) in latent.items()
    }
    scale = c["train"].std(0)

    def rmse(split: str, squared: float) -> float:
        return 1e3 * (squared * unit**2 / (3 * particles) + latent[split][1]) ** 0.5

    rows = []
    for r in SIZES:
        pca = {split: rmse(split, float(x[:, 3 * r :].square().sum(1).mean())) for split, x in c.items()}
        rows.append(
            {
                "method": "PCA",
                "modes": str(r),
                "seed": "",
                **{f"rmse_{s}_mm": f"{v:.4f}" for s, v in pca.items()},
            }
        )
        for seed in SEEDS:
            model = train(c, 3 * r, seed)
            found = {split: rmse(split, error(model, x, scale)) for split, x in c.items()}
            rows.append(
                {
                    "method": "autoencoder",
                    "modes": str(r),
                    "seed": str(seed),
                    **{f"rmse_{s}_mm": f"{v:.4f}" for s, v in found.items()},
                }
            )
            print(rows[-1], flush=True)
    return rows
