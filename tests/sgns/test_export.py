"""`sgns export`: files that onnxruntime and torch run, and what they say about themselves."""

from __future__ import annotations

import copy
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch

from sgns import export as exporting
from sgns.config import UserError
from sgns.export import Port, compared, driven_path, export, load, write
from sgns.model.traced import Decode
from sgns.reduction.closure import Closure
from sgns.simulator import Simulator
from sgns_testing.commands import call, refusal, refused
from sgns_testing.tiny import MODEL, POLYNOMIAL
from sgns_testing.trained import TrainedKinds

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
LATENT = ("batch", 8, 3)


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator.pretrained("excavation")


def closure_of(simulator: Simulator, kind: str) -> Simulator:
    """A copy whose soil follows two more modes."""
    n, rng = len(simulator.start_positions), np.random.default_rng(0)
    k = 20 if kind == "kernel" else 25 * 26 // 2
    parts = (
        rng.normal(size=(n, 2)),
        rng.normal(size=(8, 3)),
        np.ones(1),
        rng.normal(size=(k, 6)),
        np.ones((2, 3)),
    )
    centres = torch.from_numpy(rng.normal(size=(k, 24))) if kind == "kernel" else None
    other = copy.copy(simulator)
    closure = Closure(*(torch.from_numpy(part) for part in parts), centres)
    other.basis = copy.copy(simulator.basis)
    object.__setattr__(other.basis, "closure", closure)
    return other


@pytest.mark.parametrize("kind", ["kernel", pytest.param("quadratic", marks=pytest.mark.long)])
def test_a_decoder_runs_in_onnxruntime_for_any_number_of_beds(simulator, kind, tmp_path) -> None:
    simulator = closure_of(simulator, kind)
    ports = [Port("latent", LATENT, "m", "modes")], [Port("soil", ("batch", 21200, 3), "m", "particles")]
    write(Decode(simulator.basis), ports, {"format": "sgns-decode"}, tmp_path / "a.onnx", ".onnx")
    decode = load(tmp_path / "a.onnx", ".onnx", ports)
    start = simulator.reset().latent
    for count in (1, 3):
        latent = start + 0.1 * np.random.default_rng(count).normal(size=(count, 8, 3))
        soil = decode({"latent": latent})["soil"]
        assert soil.dtype == np.float32
        np.testing.assert_allclose(soil, simulator.basis.inverse(latent), rtol=1e-6, atol=1e-5)


def test_a_file_that_says_something_else_is_not_kept(simulator, tmp_path, monkeypatch) -> None:
    def other(*arguments: Any) -> Any:
        found = compared_step(simulator)
        return lambda arrays: {name: 1.01 * part for name, part in found(arrays).items()}

    monkeypatch.setattr(exporting, "write", lambda *arguments: arguments[3].write_bytes(b"some"))
    monkeypatch.setattr(exporting, "load", other)
    with pytest.raises(UserError, match=r"^the exported files differ from the simulator: .*no file is kept"):
        export(simulator, tmp_path / "a.pt2")
    assert list(tmp_path.iterdir()) == []


def compared_step(simulator: Simulator) -> Any:
    """What a loaded file says, without a file."""
    own = copy.copy(simulator)

    def run(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        if "latent" in arrays:
            return {"soil": own.basis.inverse(arrays["latent"]).numpy()}
        begins = not arrays["state"].any()
        state = own.reset(arrays["pose"][0]) if begins else own.step(arrays["pose"][0])
        parts = {name: getattr(state, name)[None] for name in ("latent", "force", "torque")}
        return parts | {"next_state": np.ones_like(arrays["state"])}

    return run


def test_the_largest_differences_are_told(simulator) -> None:
    run = compared_step(simulator)

    def step(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        found = run(arrays)
        return found | {"force": found["force"] + [0.0, 1e-4, 0.0]}

    differences, times = compared(simulator, step, run, 5)
    assert differences == pytest.approx({"latent": 0.0, "force": 1e-4, "torque": 0.0, "soil": 0.0}, abs=1e-12)
    assert set(times) == {"step", "Simulator.step", "decode", "State.soil"} and min(times.values()) > 0.0


def test_the_path_stays_where_the_training_runs_were(simulator) -> None:
    path = driven_path(simulator, 200)
    assert simulator.rollout(path).excess is not None
    found = simulator.training_range.excess(
        path, simulator.body_points, np.zeros((200, 8, 3)), {}, "the tool's"
    )
    assert found.largest < 0.5
    assert (np.ptp(path[:31, :3], axis=0)[[0, 2]] > 0.01).all()


def test_wrong_names_are_refused_in_one_line(empty_folder, monkeypatch) -> None:
    known = "checkpoint=excavation"
    assert "allowed: a name that ends in .onnx, or in .pt2" in refusal(
        empty_folder, "export", known, "output=a.h5"
    )
    assert "checkpoint" in refused("export", "output=a.onnx")
    assert "with the package ship: excavation" in refused("export", "checkpoint=nothing", "output=a.onnx")
    (empty_folder / "a.decode.onnx").touch()
    line = refusal(empty_folder, "export", known, "output=a.onnx")
    assert "a.decode.onnx is there already; choose another output, or replace it with overwrite=true" in line
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    line = refusal(empty_folder, "export", known, "output=b.onnx")
    assert "ONNX files need onnxscript" in line and "pip install 'sgns[export]'" in line and ".pt2" in line


# --- Whole exports, ten seconds each ------------------------------------------------------------------------


def drive(
    session: onnxruntime.InferenceSession, paths: np.ndarray, **told: np.ndarray
) -> list[list[np.ndarray]]:
    """Answers for all frames of paths (B, T, 7)."""
    state = np.zeros((len(paths), session.get_inputs()[0].shape[1]))
    found = []
    for frame in range(paths.shape[1]):
        state, *answer = session.run(None, {"state": state, "pose": paths[:, frame], **told})
        found.append(answer)
    return found


@pytest.mark.long
def test_an_onnx_file_steps_many_beds_and_says_what_it_is(simulator, empty_folder) -> None:
    done = call("export", "checkpoint=excavation", "output=a.onnx")
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert "a.onnx: 1.06 MB" in done.stdout and "largest differences from the simulator" in done.stdout
    assert sorted(file.name for file in empty_folder.iterdir()) == ["a.decode.onnx", "a.onnx"]
    session = onnxruntime.InferenceSession("a.onnx")
    path = driven_path(simulator, 40)
    paths = np.stack([path, path[::-1], np.repeat(path[:1], 40, axis=0)])
    together = drive(session, paths)
    for row, one in enumerate(paths):
        alone = drive(session, one[None])
        own = copy.copy(simulator)
        states = [own.reset(one[0]), *map(own.step, one[1:])]
        for state, (latent, force, torque), single in zip(states, together, alone, strict=True):
            np.testing.assert_allclose(force[row], single[1][0], rtol=1e-5, atol=1e-3)
            np.testing.assert_allclose(force[row], state.force, rtol=1e-5, atol=1e-3)
            np.testing.assert_allclose(torque[row], state.torque, rtol=1e-5, atol=1e-3)
            np.testing.assert_allclose(latent[row], state.latent, rtol=0, atol=1e-5)
    for name, part in (("a.onnx", "step"), ("a.decode.onnx", "decode")):
        session = onnxruntime.InferenceSession(name)
        about = session.get_modelmeta().custom_metadata_map
        assert about["format"] == f"sgns-{part}" and float(about["frame_rate"]) == simulator.frame_rate
        assert json.loads(about["card"]) == simulator.card
        assert "z up" in about["axes"] and json.loads(about["context"]) == {}
        for key, own in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
            told = [(port["name"], port["shape"], port["type"]) for port in json.loads(about[key])]
            types = {"tensor(double)": "float64", "tensor(float)": "float32"}
            assert told == [(one.name, one.shape, types[one.type]) for one in own]
        assert str(EXAMPLES.parent).encode() not in Path(name).read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
@pytest.mark.parametrize("kind", ["network", "polynomial", "points"])
def test_every_kind_is_exported(kind, suffix, tmp_path) -> None:
    models = {
        "network": MODEL
        | {"context": ["depth", "rake"], "layer_norm": True, "residual": True, "edges": "star"},
        "polynomial": POLYNOMIAL,
        "points": MODEL | {"body_nodes": "points"},
    }
    scene = {"kind": "wheel"} if kind == "points" else {}
    trained = TrainedKinds.of(tmp_path / "data", {kind: models[kind]}, scene=scene)
    own = trained.simulator(kind)
    found = export(own, tmp_path / f"own{suffix}")
    assert ("predicted_pose" in found.comparison.differences) == (kind == "points")
    assert max(found.comparison.differences.values()) < 1e-4
    with pytest.raises(UserError, match="is there already"):
        export(own, tmp_path / f"own{suffix}")


@pytest.mark.long
def test_a_pt2_file_is_loaded_by_torch_alone_and_has_gradients(simulator, tmp_path) -> None:
    export(simulator, tmp_path / "a.pt2")
    path = driven_path(simulator, 3)
    code = """
import sys, numpy as np, torch
about = {"frame_rate": ""}
step = torch.export.load(sys.argv[1], extra_files=about).module()
state = torch.zeros(1, 107, dtype=torch.float64)
pose = torch.tensor([eval(sys.argv[2])], dtype=torch.float64, requires_grad=True)
state, *_ = step(state, pose.detach())
state, latent, force, torque = step(state, pose + 0.001)
force.sum().backward()
assert "sgns" not in sys.modules and pose.grad.abs().sum() > 0
print(float(about["frame_rate"]))
"""
    script = [sys.executable, "-c", code, str(tmp_path / "a.pt2"), str(path[0].tolist())]
    done = subprocess.run(script, capture_output=True, text=True, timeout=100, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == simulator.frame_rate


@pytest.mark.long
def test_the_cpp_example_says_what_python_says(tmp_path) -> None:
    if not (os.environ.get("ONNXRUNTIME_ROOT") and shutil.which("cmake")):
        pytest.skip(
            "needs cmake, a C++ compiler, and ONNXRUNTIME_ROOT: a folder with include/ and lib/ of onnxruntime"
        )

    def run(*command: object) -> str:
        done = subprocess.run(
            list(map(str, command)), cwd=tmp_path, capture_output=True, text=True, timeout=110
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(sys.executable, EXAMPLES / "onnx_run.py")
    run("cmake", "-S", EXAMPLES / "onnx_cpp", "-B", "build")
    run("cmake", "--build", "build")
    said = run("build/soil_step", "excavation.onnx", "excavation.decode.onnx", "path.csv", "cpp.csv")
    assert "60 Hz" in said and "21200 particles" in said
    wanted, found = (
        np.loadtxt(tmp_path / name, delimiter=",", skiprows=1) for name in ("forces.csv", "cpp.csv")
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-5)
