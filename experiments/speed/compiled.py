"""Would a compiled step be faster than ours?

    python experiments/speed/compiled.py

The step of the network that ships, written without kept memory, by each compiler that torch has; one thread, processor
time, all in turn in one process. Needs a C++ compiler and takes two minutes. Writes compiled.csv beside this script.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import torch
from common import write_rows
from torch import Tensor
from torch.nn.functional import linear

from mpm_warp import Scene
from sgns import Simulator
from sgns.model.fast_step import Layer
from sgns.model.network_dynamics import PathStepper

ROUNDS, STEPS = 40, 30
Step = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


class Plain(torch.nn.Module):
    """`PathStepper.decoded` and `outcome` of one body node and a complete graph, as one function of tensors."""

    def __init__(self, stepper: PathStepper) -> None:
        super().__init__()
        self.of, graph = stepper, stepper.graph
        assert graph is not None
        self.modes, (sender, receiver) = stepper.dynamics.num_modes, stepper.edge_index
        self.sender, self.receiver, self.told = sender.clone(), receiver.clone(), stepper.nodes.clone()
        parts = graph.encode_nodes, graph.encode_edges, graph.update_edges, graph.rest_of_nodes
        self.parts = [[self.weights(layer) for layer in part] for part in parts]

    @staticmethod
    def weights(layer: Layer) -> tuple[Tensor, Tensor, bool]:
        weight = layer.weight if layer.onednn else layer.weight.t()
        return weight.contiguous(), layer.bias, layer.relu or layer.activate is not None

    @staticmethod
    def through(layers: list[tuple[Tensor, Tensor, bool]], x: Tensor) -> Tensor:
        for weight, bias, relu in layers:
            x = linear(x, weight, bias)
            x = torch.relu(x) if relu else x
        return x

    def forward(self, latent: Tensor, features: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        of, graph, r = self.of, self.of.graph, self.modes
        assert graph is not None
        velocity = ((latent[1:] - latent[:-1] - of.velocity_mean) / of.velocity_scale).float()
        position = ((latent[-1] - of.position_mean) / of.position_scale).float()
        modes = torch.cat([position, velocity.transpose(0, 1).reshape(r, -1)], 1)
        modes = torch.cat([modes, self.told[:r, modes.shape[1] :]], 1)
        nodes = torch.cat([modes, torch.cat([features, self.told[r:, features.shape[1] :]], 1)])
        scaled = position if of.edge_scale is None else (latent[-1] / of.edge_scale).float()
        at = torch.cat([scaled, places.float()])
        edges = at[self.sender] - at[self.receiver]
        if of.edge_length:
            edges = torch.cat([edges, edges.square().sum(1, keepdim=True).sqrt()], 1)
        encode, encode_edges, update, rest = self.parts
        receiver, sender, kept = self.through(encode, nodes).split(graph.width, 1)
        first = self.through(encode_edges, edges) + receiver[self.receiver] + sender[self.sender]
        summed = self.through(update, torch.relu(first)).view(len(nodes), -1, graph.width).sum(1)
        found = self.through(rest, torch.relu(kept + graph.update_bias + summed @ graph.summed_weight))
        following = found[:r, :3] * of.change_scale + of.change_mean + latent[-1]
        if of.accelerates:
            following = following + (latent[-1] - latent[-2])
        load = found[:, 3:].sum(0, dtype=torch.float64) * of.load_scale + of.load_mean
        return torch.clamp(following, of.nearest, of.furthest), load


def main() -> None:
    torch.set_num_threads(1)
    simulator = Simulator.pretrained("excavation")
    dynamics, poses = simulator.dynamics, Scene.from_dict(simulator.scene).body_poses()
    points, d = simulator.body_points, simulator.history
    stepper = dynamics.stepper(len(points), torch.zeros(1, 0))
    latent = torch.as_tensor(simulator.rollout(poses).latent[60 - d : 60])
    features, places = (
        part[0] for part in stepper.windows(dynamics.track_of(dynamics.rows(poses[61 - d : 61], points)))
    )
    given = latent, features.clone(), places.clone()
    plain = Plain(stepper).eval()
    steps: dict[str, Step] = {
        "ours": lambda *x: stepper.outcome(stepper.decoded(*x), x[0]),
        "the same without kept memory": plain,
        "torch.compile": torch.compile(plain, dynamic=False),
        "torch.compile, max-autotune": torch.compile(plain, dynamic=False, mode="max-autotune-no-cudagraphs"),
        "TorchScript": torch.jit.freeze(torch.jit.trace(plain, given)),
    }
    seconds = dict.fromkeys(steps, 0.0)
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        exported = torch.export.export(plain, given)
        package = torch._inductor.aoti_compile_and_package(exported, package_path=f"{folder}/step.pt2")
        steps["torch.export, AOTInductor"] = torch._inductor.aoti_load_package(package)
        seconds["torch.export, AOTInductor"] = time.perf_counter() - began
        answers: dict[str, list[Tensor]] = {}
        times: dict[str, list[float]] = {name: [] for name in steps}
        with torch.inference_mode():
            for name, step in steps.items():
                began = time.perf_counter()
                answers[name] = [part.clone() for part in step(*given)]
                seconds[name] += time.perf_counter() - began
            for _ in range(ROUNDS):
                for name, step in steps.items():
                    began = time.process_time()
                    for _ in range(STEPS):
                        step(*given)
                    times[name].append((time.process_time() - began) / STEPS)
    rows = []
    for name in steps:
        difference = max(
            float((a - b).abs().max()) for a, b in zip(answers[name], answers["ours"], strict=True)
        )
        faster = statistics.median(a / b for a, b in zip(times["ours"], times[name], strict=True))
        step_ms = 1e3 * statistics.median(times[name])
        rows.append(
            {"step": name, "step_ms": step_ms, "times_faster": faster, "compiled_in_s": seconds[name]}
        )
        print(*rows[-1].values(), f"differs by {difference:.1e}")
    write_rows(Path(__file__).parent / "compiled.csv", rows, 3)


if __name__ == "__main__":
    main()
