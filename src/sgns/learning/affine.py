"""A linear layer, with or without ReLU, through the faster of the two matrix libraries that torch has on a CPU.

torch multiplies float32 matrices on the CPU with the BLAS it was built with. oneDNN, which it also holds, is as
fast on some processors and twice as fast on others (experiments/rollout_speed), and applies bias and ReLU on
the way.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

__all__ = ["affine", "prefers_onednn"]

# Below this many multiplications a product is over before oneDNN has begun.
_WORTH_IT = 2**22
# Rows whose products with each other are summed at once: more fall out of the cache, and take many times as long.
_ROWS_AT_ONCE = 2048
_AVAILABLE = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def affine(x: Tensor, weight: Tensor, bias: Tensor, relu: bool = False) -> Tensor:
    """x Wᵀ + b, then ReLU if asked for; the function of `torch.nn.functional.linear`, to rounding.

    Args:
        x: Shape (..., inputs).
        weight: Shape (outputs, inputs).
        bias: Shape (outputs,).
        relu: Whether negative values become zero.

    Returns:
        Shape (..., outputs).
    """
    if prefers_onednn(x, weight):
        if torch.is_grad_enabled():
            return _Affine.apply(x, weight, bias, relu)
        return product(x, weight, bias, relu)
    y = nn.functional.linear(x, weight, bias)
    return y.relu_() if relu else y


def prefers_onednn(x: Tensor, weight: Tensor) -> bool:
    """Whether oneDNN is there for this product and worth its start."""
    return (
        _AVAILABLE
        and x.dtype == torch.float32
        and x.device.type == "cpu"
        and x.numel() * weight.shape[0] >= _WORTH_IT
    )


def product(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """oneDNN's x Wᵀ + b with its ReLU; float32 on the CPU only."""
    # Of a matrix with gaps between its rows, such as a part of another one, oneDNN takes a thousand times as long.
    if not (weight.is_contiguous() or weight.t().is_contiguous()):
        weight = weight.contiguous()
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu" if relu else "none", [], "")


class _Affine(torch.autograd.Function):
    """oneDNN's product with its gradient, which torch does not define."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, relu: bool) -> Tensor:
        y = product(x.reshape(-1, x.shape[-1]), weight, bias, relu)
        # Not a view to autograd, which would forbid whoever comes next to work in place.
        y = torch.ops.aten._unsafe_view(y, [*x.shape[:-1], len(weight)])
        ctx.relu = relu
        ctx.save_for_backward(x, weight, *([y] if relu else []))
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, Tensor, None]:
        x, weight, *y = ctx.saved_tensors
        if ctx.relu:
            gradient = torch.ops.aten.threshold_backward(gradient, y[0], 0)
        rows, inputs = gradient.reshape(-1, gradient.shape[-1]), x.reshape(-1, x.shape[-1])
        to_x = product(gradient, weight.t().contiguous()) if ctx.needs_input_grad[0] else None
        blocks = zip(rows.split(_ROWS_AT_ONCE), inputs.split(_ROWS_AT_ONCE), strict=True)
        to_weight = sum(product(row.t(), value.t()) for row, value in blocks)
        return to_x, to_weight, rows.sum(0), None
