"""`sgns export`: a trained simulator as files that programs without sgns run, ONNX or torch's own `.pt2`.

One file takes a step, one decodes particles: a controller steps at its rate and needs no particles, who draws them may
be another process. The state of a bed is one row of numbers that comes out of a step and goes into the next; a row of
zeros is a bed that has not begun. Normalisation, basis, start, the algebra of poses and the rule for slow tools are
inside.

Letters: d history positions, r modes, n particles.
"""

from __future__ import annotations

import copy
import importlib
import json
import logging
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from sgns import __version__
from sgns.config import UserError
from sgns.data.files import one_line, only_here, require_new, require_replaceable, whole_file
from sgns.model.features import context_of
from sgns.model.traced import Decode, Step
from sgns.rollout import single_thread
from sgns.simulator import Simulator

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)

OPSET, IR_VERSION = 18, 8
"""Of ONNX. Tried with onnxruntime 1.15, 1.20 and 1.32."""
FORMAT_VERSION = 1
STEPS = 30
"""Of the path on which a file is compared with the simulator."""
TOLERANCE = 1e-3
"""Largest difference on that path, in deviations of modes, force and torque in the training windows, else in m."""
_REPEATS = 10  # of the path, when it is timed


# --- What the files say about themselves ------------------------------------------------------------------


class Port(NamedTuple):
    """An input or output: its shape, in which "batch" stands for any number, its unit, and what it is."""

    name: str
    shape: tuple[Any, ...]
    unit: str
    meaning: str
    type: str = "float64"


def ports(simulator: Simulator, step: Step) -> dict[str, tuple[list[Port], list[Port]]]:
    """Inputs and outputs of `step` and `decode`."""
    size, r, keys = sum(step.layout.values()), simulator.num_modes, simulator.context_keys
    told = Port("context", ("batch", len(keys)), "", f"numbers of the scene: {', '.join(keys)}")
    pose = "centre of mass and unit quaternion x, y, z, w, body to world"
    state, modes = ("batch", size), Port("latent", ("batch", r, 3), "m", "coordinates of the soil's modes")
    placed = Port("predicted_pose", ("batch", 7), "m, 1", f"of the tool now: {pose}")
    particles = ("batch", len(simulator.start_positions), 3)
    return {
        "step": (
            [
                Port("state", state, "", "next_state of the step before; zeros: not begun"),
                Port("pose", ("batch", 7), "m, 1", f"of the tool one frame from now: {pose}"),
                *([told] if keys else []),
            ],
            [
                Port("next_state", state, "", "the bed and its tool now"),
                modes,
                Port("force", ("batch", 3), "N", "by the soil on the tool, world frame"),
                Port("torque", ("batch", 3), "N m", "about the tool's centre of mass, world frame"),
                *([placed] if simulator.predicts_body else []),
            ],
        ),
        "decode": ([modes], [Port("soil", particles, "m", "positions of all particles", "float32")]),
    }


def described(simulator: Simulator, step: Step, part: str) -> dict[str, str]:
    """What a file says about itself, as text by name; lists and groups as JSON."""
    inputs, outputs = ports(simulator, step)[part]
    known = context_of(simulator.scene, simulator.context_keys).tolist()
    values = {
        "format": f"sgns-{part}",
        "format_version": FORMAT_VERSION,
        "sgns_version": __version__,
        "frame_rate": simulator.frame_rate,
        "units": "m, s, N, N m; angles as unit quaternions x, y, z, w",
        "axes": "right-handed: x forward, y lateral, z up; z = 0 is the undisturbed surface",
        "inputs": [port._asdict() for port in inputs],
        "outputs": [port._asdict() for port in outputs],
        "state": step.layout,
        "history": simulator.history,
        "modes": simulator.num_modes,
        "particles": len(simulator.start_positions),
        "context": dict(zip(simulator.context_keys, known, strict=True)),
        "rate_independent": step.pace is not None,
        "predicts_pose": simulator.predicts_body,
        "body_points": simulator.body_points.tolist(),
        "arrangement_hash": simulator.arrangement_hash,
        "card": simulator.card,
    }
    return {name: one if isinstance(one, str) else json.dumps(one) for name, one in values.items()}


# --- Files of both formats, written and loaded ------------------------------------------------------------

Function = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]
"""A loaded file: arrays by name in, arrays by name out."""


def require_libraries(suffix: str) -> None:
    """Refuse a format whose libraries are missing."""
    for name in ("onnx", "onnxscript", "onnxruntime") if suffix == ".onnx" else ():
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise UserError(
                f"ONNX files need {name}, which is not there ({one_line(error)}); pip install 'sgns[export]', or take "
                "an output that ends in .pt2, which needs torch alone"
            ) from error


def write(
    module: nn.Module, files: tuple[list[Port], list[Port]], about: dict[str, str], path: Path, suffix: str
) -> None:
    """Write a module with these inputs and outputs in the format of the suffix, for any number of beds."""
    inputs, outputs = files
    shown = [torch.zeros((2, *port.shape[1:]), dtype=torch.float64) for port in inputs]
    batch = torch.export.Dim("batch")
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of torch, about itself
        module(*shown)  # what is made at first use is there then
        program = torch.export.export(module, tuple(shown), dynamic_shapes=tuple({0: batch} for _ in shown))
        if suffix == ".pt2":
            with path.open("wb") as stream:
                torch.export.save(program, stream, extra_files=about)
            return
        import onnx

        before = logging.root.manager.disable
        logging.disable(logging.WARNING)  # of what is done with every node
        try:
            made = torch.onnx.export(
                program,
                tuple(shown),
                dynamo=True,
                input_names=[port.name for port in inputs],
                output_names=[port.name for port in outputs],
                opset_version=OPSET,
                verbose=False,
            )
        finally:
            logging.disable(before)
    assert made is not None
    model = made.model_proto
    model.ir_version = IR_VERSION
    # What torch notes about every node are lines of this package, with the folders it lies in.
    model.graph.ClearField("value_info")
    for one in (
        *model.graph.node,
        *model.graph.initializer,
        *model.graph.input,
        *model.graph.output,
        model.graph,
    ):
        one.ClearField("metadata_props")
    for value, port in zip((*model.graph.input, *model.graph.output), (*inputs, *outputs), strict=True):
        value.doc_string = f"{port.meaning} [{port.unit or '-'}]"
        value.type.tensor_type.shape.dim[0].dim_param = port.shape[0]
    model.producer_name, model.producer_version = "sgns", __version__
    onnx.helper.set_model_props(model, about)
    onnx.checker.check_model(model, full_check=True)
    path.write_bytes(model.SerializeToString())


def load(path: Path, suffix: str, files: tuple[list[Port], list[Port]]) -> Function:
    """A file as a function, on one thread."""
    inputs, outputs = files
    if suffix == ".onnx":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        names = [port.name for port in outputs]
        return lambda arrays: dict(zip(names, session.run(names, arrays), strict=True))
    with path.open("rb") as stream:
        module = torch.export.load(stream).module()

    def run(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        with torch.inference_mode():
            found = module(*(torch.from_numpy(arrays[port.name]) for port in inputs))
        parts = found if isinstance(found, (tuple, list)) else [found]
        return {port.name: part.numpy() for port, part in zip(outputs, parts, strict=True)}

    return run


# --- Compared with the simulator ---------------------------------------------------------------------------


def driven_path(simulator: Simulator, frames: int = STEPS + 1) -> np.ndarray:
    """Poses (frames, 7) that wind through what the training runs covered."""
    known = simulator.training_range
    (low, high), (slowest, fastest), (left, right), columns = (
        (known.low[f"the tool's {name}"], known.high[f"the tool's {name}"])
        for name in ("position", "displacement per frame", "rotation per frame", "orientation")
    )
    first, second = np.mean(columns, axis=0).reshape(2, 3)
    first = first / np.linalg.norm(first)
    second = second - (second @ first) * first
    second = second / np.linalg.norm(second)
    turn = Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=1))
    place, poses = 0.5 * (low + high), []
    for frame in range(frames):
        poses.append(np.concatenate([place, turn.as_quat()]))
        share = 0.5 + 0.5 * np.sin(0.4 * frame + np.arange(3))
        place = np.clip(place + slowest + share * (fastest - slowest), low, high)
        turn = Rotation.from_rotvec(left + share * (right - left)) * turn
    return np.stack(poses)


class Comparison(NamedTuple):
    """Largest differences on the path, by name in units [N, N m, m], and median times of a call [s] by name."""

    differences: dict[str, float]
    times: dict[str, float]


def compared(simulator: Simulator, step: Function, decode: Function, size: int) -> Comparison:
    """Loaded files, with a state of so many numbers, beside the simulator along `driven_path`; one thread.

    Raises:
        UserError: They differ.
    """
    simulator, path = copy.copy(simulator), driven_path(simulator)
    context = context_of(simulator.scene, simulator.context_keys)[None]
    told = {"context": context} if context.size else {}
    times: dict[str, list[float]] = {}
    largest: dict[str, float] = {}

    def timed(name: str, action: Callable[..., Any], *arguments: Any) -> Any:
        began = time.perf_counter()
        found = action(*arguments)
        times.setdefault(name, []).append(time.perf_counter() - began)
        return found

    def differ(name: str, found: np.ndarray, wanted: np.ndarray) -> None:
        largest[name] = float(np.maximum(largest.get(name, 0.0), np.abs(found[0] - wanted).max()))

    with single_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # somewhere on the path an answer may be a guess
        for _ in range(_REPEATS):
            state, arrays = simulator.reset(path[0]), {"state": np.zeros((1, size)), **told}
            for frame, pose in enumerate(path):
                arrays["pose"] = pose[None]
                found = timed("step", step, arrays)
                if frame > 0:
                    state = timed("Simulator.step", simulator.step, pose)
                arrays["state"] = found["next_state"]
                for name in ("latent", "force", "torque"):
                    differ(name, found[name], getattr(state, name))
                if "predicted_pose" in found:
                    differ("predicted_pose", found["predicted_pose"], state.pose)
            soil = timed("decode", decode, {"latent": found["latent"]})["soil"]
            differ("soil", soil, timed("State.soil", state.soil))
    dynamics: Any = simulator.dynamics
    scales = {
        "latent": dynamics.latent_statistics()[1],
        "force": dynamics.force.scale,
        "torque": dynamics.torque.scale,
    }
    for name, difference in largest.items():
        allowed = TOLERANCE * (float(scales[name].max()) if name in scales else 1.0)
        if not difference <= allowed:
            raise UserError(
                f"the exported files differ from the simulator: {name} by {difference:.2g}, allowed {allowed:.2g}; no "
                "file is kept. Please report it with the versions of torch and onnxruntime"
            )
    return Comparison(largest, {name: float(np.median(each)) for name, each in times.items()})


# --- The command --------------------------------------------------------------------------------------------


class Exported(NamedTuple):
    """The two files, and how they compare with the simulator."""

    step: Path
    decode: Path
    comparison: Comparison


def export(simulator: Simulator, output: str | Path, overwrite: bool = False) -> Exported:
    """Write a simulator as `<name>.onnx` or `.pt2`, which takes steps, and `<name>.decode.onnx` or `.pt2` beside it,
    which decodes particles. Of an ensemble the first member; the body points are those of the training runs.

    Raises:
        UserError: The name has another ending or is taken, libraries are missing, or what was written does not say the
            same as the simulator, when no file is left.
    """
    path = Path(output)
    suffix = path.suffix.lower()
    if suffix not in (".onnx", ".pt2"):
        raise UserError(
            f"output is {path}; allowed: a name that ends in .onnx, or in .pt2 for torch.export.load"
        )
    require_libraries(suffix)
    paths = path, path.with_suffix(f".decode{suffix}")
    for one in paths:
        require_new(one, overwrite)
        require_replaceable(one)
    simulator = copy.copy(simulator)
    start = simulator.basis.transform(simulator.start_positions)
    step = Step(simulator.dynamics, simulator.body_points, start, simulator.pace).eval()
    files, modules = ports(simulator, step), {"step": step, "decode": Decode(simulator.basis)}
    with only_here(path), ExitStack() as stack:
        functions = []
        for one, (part, module) in zip(paths, modules.items(), strict=True):
            hidden = stack.enter_context(whole_file(one))
            write(module, files[part], described(simulator, step, part), hidden, suffix)
            functions.append(load(hidden, suffix, files[part]))
        comparison = compared(simulator, functions[0], functions[1], sum(step.layout.values()))
    return Exported(*paths, comparison)


def main(cfg: DictConfig) -> float:
    """The `sgns export` command; returns the median time of a step [s]."""
    simulator = Simulator.load(cfg.checkpoint, "cpu", cfg.num_modes, rate_independent=cfg.rate_independent)
    step, decode, (differences, times) = export(simulator, cfg.output, cfg.overwrite)
    units = {"force": "N", "torque": "N m"}
    for path in (step, decode):
        log.info("%s: %.3g MB", path, path.stat().st_size / 1e6)
    said = ", ".join(f"{name} {value:.1e} {units.get(name, 'm')}" for name, value in differences.items())
    log.info("driven %d frames, the largest differences from the simulator are: %s", STEPS, said)
    for name, ours in (("step", "Simulator.step"), ("decode", "State.soil")):
        log.info(
            "%s: %.3g ms; %s: %.3g ms (median, one thread)", name, 1e3 * times[name], ours, 1e3 * times[ours]
        )
    return times["step"]
