"""Both matrix libraries give the same linear layer and the same gradients."""

from __future__ import annotations

import time

import pytest
import torch

from sgns.learning import affine as module
from sgns.learning.affine import affine


def outcome(shape: tuple[int, ...], relu: bool) -> list[torch.Tensor]:
    torch.manual_seed(0)
    tensors = [torch.randn(*shape, 40), torch.randn(60, 40), torch.randn(60)]
    for tensor in tensors:
        tensor.requires_grad_()
    y = affine(*tensors, relu=relu)
    return [y.detach(), *torch.autograd.grad(y.sin().sum(), tensors)]


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("shape", [(7,), (2, 3, 5), (5000,)])
def test_onednn_is_the_linear_layer(shape, relu, monkeypatch) -> None:
    if not torch.backends.mkldnn.is_available():
        pytest.skip("torch was built without oneDNN")
    monkeypatch.setattr(module, "_WORTH_IT", 2**60)
    expected = outcome(shape, relu)
    monkeypatch.setattr(module, "_WORTH_IT", 0)
    assert module.prefers_onednn(torch.empty(*shape, 40), torch.empty(60, 40))
    for a, b in zip(outcome(shape, relu), expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(b.abs().max()))


def test_without_gradients_it_is_the_same() -> None:
    x, weight, bias = torch.randn(700, 128), torch.randn(128, 128), torch.randn(128)
    with torch.inference_mode():
        found = affine(x, weight, bias, relu=True)
    expected = torch.nn.functional.linear(x.double(), weight.double(), bias.double()).relu()
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-4)


def test_double_precision_stays_double() -> None:
    assert not module.prefers_onednn(torch.empty(5000, 128).double(), torch.empty(128, 128).double())
    y = affine(torch.ones(5000, 128).double(), torch.ones(128, 128).double() / 3, torch.zeros(128).double())
    torch.testing.assert_close(y, torch.full_like(y, 128 / 3), rtol=1e-14, atol=0.0)


def test_a_part_of_a_matrix_is_no_slower() -> None:
    x, whole, bias = torch.randn(1568, 128), torch.randn(128, 384), torch.randn(128)

    def seconds(weight: torch.Tensor) -> float:
        best = float("inf")
        for _ in range(5):
            began = time.perf_counter()
            affine(x, weight, bias)
            best = min(best, time.perf_counter() - began)
        return best

    # Taken as it lies in memory it was a thousand times slower.
    assert seconds(whole[:, :128]) < 20 * seconds(whole[:, :128].contiguous())
