"""Time of a step and of decoding: exported files beside the simulator, in turn in one process on one thread, and the
C++ example in turn with it. Writes latency.csv and docs/guides/export.png.

python experiments/export/latency.py FOLDER  # of excavation.onnx, .pt2, path.csv, and maybe soil_step
"""

import csv
import subprocess
import sys
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
import onnxruntime
import torch
from matplotlib import pyplot as plt

import sgns

HERE = Path(__file__).parent
ROUNDS = 12


def measured(folder: Path) -> dict[str, np.ndarray]:
    """Times of all steps by name [s]."""
    torch.set_num_threads(1)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session, decoder = (
        onnxruntime.InferenceSession(str(folder / f"excavation{part}.onnx"), options)
        for part in ("", ".decode")
    )
    module = torch.export.load(str(folder / "excavation.pt2")).module()
    simulator = sgns.Simulator.pretrained("excavation")
    path = np.loadtxt(folder / "path.csv", delimiter=",", skiprows=1)
    tensors = torch.from_numpy(path)[:, None]
    times: dict[str, list[float]] = {}

    def timed(name, action):
        began = time.perf_counter()
        found = action()
        times.setdefault(name, []).append(time.perf_counter() - began)
        return found

    for _ in range(ROUNDS):
        known, state = simulator.reset(path[0]), np.zeros((1, session.get_inputs()[0].shape[1]))
        state_pt2 = torch.from_numpy(state)
        for frame, pose in enumerate(path):
            if frame:
                known = timed("Simulator.step", lambda pose=pose: simulator.step(pose))
            feed = {"state": state, "pose": pose[None]}
            state, latent, *_ = timed("ONNX, Python", lambda feed=feed: session.run(None, feed))
            with torch.inference_mode():
                arguments = state_pt2, tensors[frame]
                state_pt2, *_ = timed(".pt2, eager torch", lambda arguments=arguments: module(*arguments))
            if frame % 20 == 0:
                timed("State.soil", known.soil)
                feed = {"latent": latent}
                timed("ONNX, decode", lambda feed=feed: decoder.run(None, feed))
        if (folder / "soil_step").exists():
            files = "excavation.onnx", "excavation.decode.onnx", "path.csv", "cpp.csv", "times.csv"
            subprocess.run(["./soil_step", *files], cwd=folder, check=True, capture_output=True)
            times.setdefault("ONNX, C++", []).extend(1e-6 * np.loadtxt(folder / "times.csv"))
    return {name: np.array(each) for name, each in times.items()}


def draw(times: dict[str, np.ndarray], file: Path) -> None:
    """The two files as boxes, and below the times of a step."""
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7.6, 5.0), height_ratios=[1.0, 1.1], layout="constrained"
    )
    above.set(xlim=(0, 10), ylim=(0, 4.4))
    above.axis("off")
    for x, label in (
        (3.1, "excavation.onnx\none step, 1/60 s"),
        (7.3, "excavation.decode.onnx\nwhen particles are wanted"),
    ):
        above.text(
            x,
            2.4,
            label,
            ha="center",
            va="center",
            bbox={"boxstyle": "round,pad=0.8", "fc": "#dfe9f3", "ec": "#30638e"},
        )

    def arrow(start, end, label, place, **kw):
        above.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": "#444444"} | kw)
        above.text(*place, label, ha="center", va="center", fontsize=9)

    arrow((0.3, 2.75), (1.8, 2.75), "pose", (0.85, 3.0))
    arrow((0.3, 2.1), (1.8, 2.1), "state", (0.85, 1.8))
    arrow((4.4, 2.4), (5.75, 2.4), "latent", (5.05, 2.65))
    arrow((8.85, 2.4), (9.7, 2.4), "soil", (9.25, 2.65))
    arrow((3.1, 3.1), (3.1, 4.1), "force, torque", (4.05, 3.85))
    above.plot([3.1, 3.1, 0.3, 0.3], [1.7, 0.6, 0.6, 2.1], color="#444444", lw=1.0)
    above.text(1.7, 0.25, "next_state goes in again; zeros begin", ha="center", fontsize=9)
    names = [
        name for name in ("ONNX, C++", "ONNX, Python", "Simulator.step", ".pt2, eager torch") if name in times
    ]
    for row, name in enumerate(reversed(names)):
        low, middle, high = 1e3 * np.quantile(times[name], [0.05, 0.5, 0.95])
        below.plot([low, high], [row, row], color="#9db7d0", lw=7, solid_capstyle="butt")
        below.plot(middle, row, "o", color="#30638e")
        below.text(middle, row + 0.27, f"{middle:.2f} ms", ha="center", fontsize=9)
    below.set_yticks(range(len(names)), reversed(names))
    below.set(
        xscale="log", xlabel="time of a step [ms]: median, and the middle 90 %", ylim=(-0.5, len(names) - 0.3)
    )
    below.spines[["top", "right"]].set_visible(False)
    figure.savefig(file, dpi=130)


if __name__ == "__main__":
    found = measured(Path(sys.argv[1]))
    with (HERE / "latency.csv").open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["what", "calls", "p05_ms", "median_ms", "p95_ms", "p99_ms"])
        for name, each in found.items():
            quantiles = 1e3 * np.quantile(each, [0.05, 0.5, 0.95, 0.99])
            table.writerow([name, len(each), *(f"{value:.3g}" for value in quantiles)])
    draw(found, HERE.parent.parent / "docs" / "guides" / "export.png")
