"""Mean and scale of a quantity on the training windows, kept with the model."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["Standardiser"]


class Standardiser(nn.Module):
    """Shift and scale a quantity to zero mean and unit deviation, in float64.

    Latent positions are large and their differences tiny, so the subtraction happens before anything becomes
    float32.

    Args:
        mean: Mean of the quantity [its unit], any shape that broadcasts against the quantity.
        scale: Deviation of the quantity [its unit], same shape, positive.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean.double().clone())
        self.register_buffer("scale", scale.double().clone())

    @classmethod
    def fit(cls, samples: Tensor, floor: float = 0.0, centred: bool = True) -> Standardiser:
        """Statistics over the first dimension.

        Args:
            samples: Training values [unit], shape (samples, ...).
            floor: Smallest allowed scale as a share of the largest one; a direction in which (almost) nothing
                happens, such as the lateral one by symmetry, keeps a small normalised value instead of being
                blown up.
            centred: Whether the mean is subtracted; without it zero stays zero and the scale is the root mean
                square.

        Returns:
            The fitted standardiser; a quantity that never varies gets scale one.
        """
        samples = samples.double()
        if samples[0].numel() == 0:
            return cls.empty(*samples.shape[1:])
        mean = samples.mean(0) if centred else torch.zeros_like(samples[0])
        scale = (samples - mean).square().mean(0).sqrt()
        largest = float(scale.max())
        # Round-off of a constant is not variation: below 1e-12 of the values themselves the scale is one.
        if largest <= 1e-12 * float(samples.abs().max()) or largest == 0.0:
            return cls(mean, torch.ones_like(scale))
        return cls(mean, scale.clamp_min(max(floor, 1e-9) * largest))

    @classmethod
    def empty(cls, *shape: int) -> Standardiser:
        """A neutral one of the given shape, to be filled from a checkpoint."""
        return cls(torch.zeros(shape, dtype=torch.float64), torch.ones(shape, dtype=torch.float64))

    def normalise(self, value: Tensor) -> Tensor:
        """Value in deviations from the mean [1], float32, same shape."""
        return ((value - self.mean) / self.scale).float()

    def denormalise(self, value: Tensor) -> Tensor:
        """Back to the quantity's unit, float64, same shape."""
        return value.double() * self.scale + self.mean
