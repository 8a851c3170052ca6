"""Improve a cut by the gradient of a learned simulator: more soil moved per joule.

python examples/best_path_by_gradient.py
"""

import math

import torch

from sgns import Simulator, TorchSimulator
from sgns.gradients import tool_poses

simulator = TorchSimulator(Simulator.pretrained("excavation"))
time = torch.arange(60, dtype=torch.float64) / simulator.frame_rate  # [s]
upright = torch.zeros(60, 3, dtype=torch.float64)  # rotation vectors [rad]


def cut(depth: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
    """Poses of a plate that goes down along a sine and forward at a speed [m], [m/s]."""
    x = 0.06 + speed * time
    z = 0.1625 - depth * torch.sin(math.pi * time / (2.0 * time[-1]))
    return tool_poses(torch.stack([x, torch.full_like(x, 0.3), z], -1), upright)


def answer(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Soil moved [l], work [J] and how far the path leaves the training range [1]."""
    path = simulator.rollout(cut(*values))
    moved = 1000.0 * simulator.moved_volume(path.latent)
    return moved, simulator.work(path).sum(), simulator.outside(path).square().sum()


values = torch.tensor([0.08, 0.06], dtype=torch.float64, requires_grad=True)  # a poor guess: deep and slow
optimizer = torch.optim.Adam([values], lr=0.015)
worth = []
for _ in range(5):
    optimizer.zero_grad()
    moved, work, outside = answer(values)
    (-torch.log(moved / work) + 10.0 * outside).backward()
    depth, speed = 100.0 * values.detach()
    worth.append((moved / work).item())
    print(f"{depth:.1f} cm deep, {speed:.1f} cm/s: {moved:.2f} l for {work:.1f} J, {worth[-1]:.3f} l/J")
    optimizer.step()

assert worth[-1] > 1.2 * worth[0]
assert outside.item() < 0.01
