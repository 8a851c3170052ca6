"""Nothing that is read from a person or a file is executed, and no file makes another one be read or written.

Every hostile file tries to leave a canary; none may appear.
"""

import contextlib
import copy
import io
import json
import math
import os
import pickle
import re
import shutil
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
import yaml

from mpm_warp import SceneError
from mpm_warp.mesh_files import read_mesh
from sgns.config import UserError, parse_yaml
from sgns.data.check import check_run
from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.evaluate.command import read_log
from sgns.evaluate.costs import network_costs
from sgns.frontier.observation import read_observation
from sgns.frontier.point import read_points
from sgns.frontier.study import Study
from sgns.model.checkpoint import load_surrogate
from sgns.reduction.basis import Basis
from sgns.reduction.published import read_published
from sgns.reduction.reduce import ReducedDataset, read_reduced, reduce_dataset
from sgns.simulate.scene import read_path
from sgns.train.command import train
from sgns_testing.commands import refused
from sgns_testing.runs import make_run
from sgns_testing.tiny import BRIEF, MODEL, REDUCTION, make_dataset, reduced

SECRET = "canary-in-another-file"


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    """A file that appears when something was executed."""
    return tmp_path / "canary"


@pytest.fixture
def trained(trained_briefly) -> Path:
    """A good checkpoint."""
    return trained_briefly.output / "best.ckpt"


class Touch:
    """Leaves the canary when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self):
        return (Path.touch, (self.canary,))


# --- checkpoints ------------------------------------------------------------------------------------------


def archived(content: object, **how: Any) -> bytes:
    """What `torch.save` writes."""
    file = io.BytesIO()
    torch.save(content, file, **how)
    return file.getvalue()


def with_card(content: dict[str, Any], **changes: Any) -> bytes:
    """A checkpoint with other values in its card."""
    return archived(content | {"hyper_parameters": content["hyper_parameters"] | changes})


def with_weights(content: dict[str, Any], name: str, value: Any) -> bytes:
    return archived(content | {"state_dict": content["state_dict"] | {name: value}})


def deflated(content: dict[str, Any]) -> bytes:
    """Parts that are packed: small files that may unfold to anything."""
    packed = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(archived(content))) as old,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for part in old.infolist():
            new.writestr(part.filename, old.read(part))
    return packed.getvalue()


def overlapping() -> bytes:
    """A part that is named many times is read many times."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a/x", b"x" * 10_000)
        for number in range(10):
            twin = copy.copy(archive.infolist()[0])
            twin.filename = f"a/{number}"
            archive.filelist.append(twin)
            archive.NameToInfo[twin.filename] = twin
    return file.getvalue()


def endless() -> list:
    """A list that holds itself."""
    found: list = []
    found.append(found)
    return found


def doubled(value: object, times: int = 40) -> object:
    """A value that stands for 2 ** times of what it holds."""
    for _ in range(times):
        value = [value, value]
    return value


UNREADABLE = "cannot be read as a checkpoint"
ODD_CARD = r"a\.ckpt has a card that cannot be used"
HOSTILE: dict[str, list[Callable[[dict[str, Any], Touch], bytes]]] = {
    UNREADABLE: [
        lambda good, touch: with_weights(good, "x", touch),
        lambda good, touch: with_card(good, x=touch),
        lambda good, touch: pickle.dumps({"state_dict": touch}),
        lambda good, touch: archived(good | {"callbacks": touch}, _use_new_zipfile_serialization=False),
        lambda good, _: deflated(good),
    ],
    f"{UNREADABLE}.*overlap": [lambda good, _: overlapping()],
    "claims more values": [lambda good, _: with_weights(good, "surrogate.x", torch.zeros(1).expand(10**12))],
    "holds torch.int32": [
        lambda good, _: with_weights(good, name := max(good["state_dict"]), good["state_dict"][name].int())
    ],
    "do not fit together": [
        lambda good, _, key=key: with_card(good, model=good["hyper_parameters"]["model"] | {key: 90})
        for key in ("message_passing_steps", "hidden_width", "history")
    ],
    ODD_CARD: [
        lambda good, _: with_card(good, x=endless()),
        lambda good, _: with_card(good, x=doubled("x")),
        lambda good, _: with_card(good, x=doubled("x" * 1000, 16)),
        lambda good, _: with_card(good, x=1 << 100),
        lambda good, _: with_card(good, x=torch.ones(1)),
        *(
            lambda good, _, settings=settings: with_card(good, settings=settings)
            for settings in (3, {"training": []}, {"validation_runs": [3]}, {"training": {"batch_size": "x"}})
        ),
    ],
}
"""Words of a refusal -> files, made of a good checkpoint and what leaves the canary."""


@pytest.mark.parametrize(("words", "make"), [(words, make) for words in HOSTILE for make in HOSTILE[words]])
def test_hostile_checkpoints(trained, tmp_path, canary, words, make) -> None:
    (tmp_path / "a.ckpt").write_bytes(make(torch.load(trained, weights_only=True), Touch(canary)))
    began = time.process_time()
    with pytest.raises(UserError) as caught:
        load_surrogate(tmp_path / "a.ckpt")
    assert time.process_time() - began < 2.0
    assert re.search(words, f"{caught.value} {caught.value.__cause__}")
    assert not canary.exists()


def test_the_canary_works(canary) -> None:
    pickle.loads(pickle.dumps(Touch(canary)))
    assert canary.exists()


def test_a_hostile_last_checkpoint_is_not_gone_on_from(halfway, canary) -> None:
    data, output = halfway
    content = torch.load(output / "last.ckpt", weights_only=True)
    torch.save(content | {"loops": Touch(canary)}, output / "last.ckpt")
    with pytest.raises(UserError, match=UNREADABLE):
        train(data, num_modes=4, model=MODEL, training=BRIEF, output=output)
    assert not canary.exists()


def test_targets_in_checkpoints(trained, tmp_path, canary) -> None:
    content = torch.load(trained, weights_only=True)
    call = {"_target_": "pathlib.Path.touch", "_args_": [str(canary)]}
    for card in (call, content["hyper_parameters"] | {"model": call}, content["hyper_parameters"] | call):
        torch.save(content | {"hyper_parameters": card}, tmp_path / "a.ckpt")
        with contextlib.suppress(UserError):
            load_surrogate(tmp_path / "a.ckpt")
    assert not canary.exists()


@pytest.fixture
def halfway(trained_briefly, tmp_path) -> tuple[ReducedDataset, Path]:
    """A dataset and a copy of a training of it that was stopped."""
    output = shutil.copytree(trained_briefly.output, tmp_path / "out")
    (output / "training.json").unlink()
    return trained_briefly.data, output


def odd_state(content: dict[str, Any]) -> None:
    first = content["optimizer_states"][0]["state"][0]
    first["exp_avg"] = first["exp_avg"][:1, :1]


def infinite_state(content: dict[str, Any]) -> None:
    content["optimizer_states"][0]["state"][0]["exp_avg_sq"].fill_(torch.inf)


@pytest.mark.parametrize(
    "damage",
    [
        *(
            lambda content, key=key: content.pop(key)
            for key in ("optimizer_states", "loops", "callbacks", "pytorch-lightning_version")
        ),
        lambda content: content.update(optimizer_states=[{"state": {}, "param_groups": []}]),
        lambda content: content["optimizer_states"][0].update(state={}),
        lambda content: content["optimizer_states"][0]["param_groups"][0].update(lr="fast"),
        lambda content: content["lr_schedulers"][0].update(last_epoch=None),
        lambda content: content["loops"]["fit_loop"].update({"epoch_loop.batch_progress": 3}),
        lambda content: content.update(global_step=10**9),
        lambda content: content.update(first_loss="small"),
        lambda content: content["callbacks"].update(RolloutValidation={"best": "x"}),
        odd_state,
        infinite_state,
    ],
)
def test_trainings_that_cannot_be_gone_on_from(halfway, damage) -> None:
    data, output = halfway
    last = output / "last.ckpt"
    content = torch.load(last, weights_only=True)
    damage(content)
    torch.save(content, last)
    before = last.read_bytes()
    with pytest.raises(
        UserError, match=r"last\.ckpt cannot be gone on from .*training\.resume=false"
    ) as caught:
        train(data, num_modes=4, model=MODEL, training=BRIEF, output=output)
    assert "\n" not in str(caught.value) and last.read_bytes() == before


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"skill": "x", "seconds": 1}', "[" * 10**5, "\0" * 100]
)
def test_a_complete_training_whose_summary_is_damaged(halfway, text) -> None:
    data, output = halfway
    (output / "training.json").write_text(text)
    with pytest.raises(UserError, match=r"training\.json is not the summary of a training"):
        train(data, num_modes=4, model=MODEL, training=BRIEF, output=output)


# --- settings ---------------------------------------------------------------------------------------------


TOUCH = "_target_: pathlib.Path.touch, _args_: [CANARY]"
LAUNCHER = """
import pathlib
from hydra.core.config_store import ConfigStore
from hydra.plugins.launcher import Launcher


class Elsewhere(Launcher):
    def setup(self, **settings):
        pass

    def launch(self, job_overrides, initial_job_idx):
        pathlib.Path("launched").touch()
        return []


target = {"_target_": "hydra_plugins.elsewhere.Elsewhere"}
ConfigStore.instance().store(group="hydra/launcher", name="elsewhere", node=target, provider="elsewhere")
"""


FILES = {
    "good": "seed: 3",
    "bad": f"scene: {{x: {{{TOUCH}}}}}",
    "callback": f"hydra: {{callbacks: {{x: {{{TOUCH}}}}}}}",
    "sweep": f"hydra: {{sweeper: {{params: {{+x: '1,{{{TOUCH}}}'}}}}}}",
    "tag": "scene: {name: !!python/object/apply:pathlib.Path.touch [CANARY]}",
    "class": "scene: {name: !!python/object/new:pathlib.Path [CANARY]}",
}
"""Files of settings; the first is a good one."""


@pytest.fixture
def experiments(empty_folder, canary) -> Path:
    """Folder of the files."""
    folder = empty_folder / "conf" / "experiment"
    folder.mkdir(parents=True)
    for name, text in FILES.items():
        (folder / f"{name}.yaml").write_text(f"# @package _global_\n{text}\n".replace("CANARY", str(canary)))
    return empty_folder / "conf"


NAMED, SWEPT = "cannot name Python objects", "Sweeping over Hydra's configuration is not supported"
TAGGED = "could not determine a constructor"


@pytest.mark.parametrize(
    ("words", "arguments"),
    [
        (NAMED, [f"+scene.x={{{TOUCH}}}"]),
        (NAMED, ["++hydra.sweeper._target_=pathlib.Path.touch"]),
        (TAGGED, ["experiment=tag"]),
        (TAGGED, ["experiment=class"]),
        (NAMED, ["-m", "seed=1,2", "+x._target_=os.system"]),
        ("x: no such key", ["-m", f"+x={{a: 1}},[{{{TOUCH}}}]"]),
        (NAMED, ["-m", "seed=1,2", f"+hydra.callbacks.x={{{TOUCH}}}"]),
        (NAMED, ["-m", "seed=1,2", "hydra.launcher._target_=pathlib.Path.touch"]),
        (NAMED, ["-m", "experiment=sweep"]),
        (NAMED, ["-m", "experiment=good,callback"]),
        (NAMED, ["-m", "experiment=good,bad", "hydra.sweeper.max_batch_size=2"]),
        (SWEPT, ["-m", f"+hydra.callbacks.x={{a: 1}},{{{TOUCH}}}"]),
        (SWEPT, ["-m", "hydra.launcher._target_=os.system,pathlib.Path.touch"]),
    ],
)
def test_targets_in_settings(experiments, canary, words, arguments, monkeypatch) -> None:
    """Refused before the first job; single commands are in tests/sgns/cli/test_settings.py."""
    monkeypatch.setattr("sgns.simulate.command.main", lambda cfg: canary.touch())
    given = [argument.replace("CANARY", str(canary)) for argument in arguments]
    assert words in refused("simulate", "--config-dir", str(experiments), *given)
    assert not canary.exists()


def test_targets_in_a_later_batch_of_a_sweep(experiments, canary, monkeypatch) -> None:
    seeds = []
    monkeypatch.setattr("sgns.simulate.command.main", lambda cfg: seeds.append(cfg.seed))
    batches = "hydra.sweeper.max_batch_size=1"  # all are looked at before the first begins
    sweep = ["-m", "--config-dir", str(experiments), "experiment=good,bad", batches]
    assert "cannot name Python objects" in refused("simulate", *sweep).splitlines()[-1]
    assert seeds == [] and not canary.exists()


@pytest.mark.parametrize(("swept", "launched"), [("good,good", True), ("good,bad", False)])
def test_launchers_that_put_settings_together_in_other_processes(
    experiments, canary, swept, launched, tmp_path
) -> None:
    """The first process has put the settings of all jobs together before it gives them away."""
    plugin = tmp_path / "path" / "hydra_plugins" / "elsewhere"
    plugin.mkdir(parents=True)
    (plugin / "__init__.py").write_text(LAUNCHER)
    command = [sys.executable, "-m", "sgns", "simulate", "-m", "hydra/launcher=elsewhere"]
    done = subprocess.run(
        [*command, "--config-dir", str(experiments), f"experiment={swept}"],
        capture_output=True,
        text=True,
        timeout=100,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "path")},
    )
    assert done.returncode == (0 if launched else 2), done.stderr
    assert (experiments.parent / "launched").exists() == launched
    assert launched or "cannot name Python objects" in done.stderr
    assert not canary.exists()


# --- YAML in data -----------------------------------------------------------------------------------------

TAGS = ["!!python/object/apply:pathlib.Path.touch [{}]", "!!python/name:os.system", "!!python/module:this"]


@pytest.mark.parametrize("tag", TAGS)
def test_tags_in_yaml(tmp_path, canary, tag) -> None:
    text = f"a: {tag.format(canary)}"
    with pytest.raises(ValueError, match="could not determine a constructor"):
        parse_yaml(text)
    path = make_run(tmp_path / "a.h5", frames=2, n=3)
    with h5py.File(path, "r+") as file:
        file.attrs["scene"] = np.bytes_(text.encode())
    with Run(path) as run, pytest.raises(UserError, match="scene is damaged"):
        run.scene  # noqa: B018
    assert any("is not YAML" in problem for problem in check_run(path))
    (tmp_path / "dataset.yaml").write_text(text)
    with pytest.raises(UserError, match="cannot read"):
        Dataset.open(tmp_path)
    assert not canary.exists() and "this" not in sys.modules


def test_resolvers_in_data_stay_text(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("SGNS_SECRET", SECRET)
    scene = {"name": "${oc.env:SGNS_SECRET}", "gravity": "${oc.decode:'9.81'}"}
    with Run(make_run(tmp_path / "a.h5", frames=2, n=3, scene=scene)) as run:
        assert run.scene["name"] == scene["name"] and run.scene["gravity"] == scene["gravity"]
    data = make_dataset(tmp_path / "data", scene=scene)
    found = reduce_dataset(data, REDUCTION, progress=False)
    assert found.runs("train")[0].scene["name"] == scene["name"]


def test_aliases_that_stand_for_more_than_fits_in_memory(tmp_path) -> None:
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    bomb += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 15))
    for text in (bomb, "a: &a [*a]", "[" * 10**5):
        (tmp_path / "dataset.yaml").write_text(text)
        with pytest.raises(UserError, match="cannot read"):
            Dataset.open(tmp_path)


# --- HDF5 -------------------------------------------------------------------------------------------------


def hostile_hdf5(path: Path, name: str, kind: str) -> None:
    """Let a dataset show the values of another file."""
    with h5py.File(path, "r+") as file:
        old = file[name]
        shape, dtype = old.shape, old.dtype
        other = path.with_name("other.h5")
        with h5py.File(other, "w") as source:
            source["x"] = old[...]
        raw = path.with_name("raw")
        raw.write_bytes(old[...].tobytes())
        del file[name]
        if kind == "external link":
            file[name] = h5py.ExternalLink(str(other), "/x")
        elif kind == "soft link":
            file["aside"] = h5py.ExternalLink(str(other), "/x")
            file[name] = h5py.SoftLink("/aside")
        elif kind == "virtual":
            layout = h5py.VirtualLayout(shape=shape, dtype=dtype)
            layout[...] = h5py.VirtualSource(str(other), "x", shape=shape, dtype=dtype)
            file.create_virtual_dataset(name, layout)
        elif kind == "raw data elsewhere":
            file.create_dataset(name, shape, dtype, external=[(str(raw), 0, raw.stat().st_size)])
        else:
            file.create_dataset(name, (10**12, *shape[1:]), dtype, chunks=(1, *shape[1:]))


KINDS = ["external link", "soft link", "virtual", "raw data elsewhere", "claims 1e12 rows"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "name", ["particles/soil/position/value", "observables/body/force/value", "VTKHDF/Points"]
)
def test_runs_that_point_elsewhere_or_claim_too_much(tmp_path, kind, name) -> None:
    path = make_run(tmp_path / "a.h5", frames=3, n=4)
    hostile_hdf5(path, name, kind)
    assert check_run(path) != []
    if not name.startswith("VTKHDF"):  # nobody but ParaView reads that
        with pytest.raises(UserError, match="not a complete run"):
            Run(path)


@pytest.mark.parametrize("kind", KINDS)
def test_bases_and_reduced_runs_that_point_elsewhere_or_claim_too_much(tmp_path, kind) -> None:
    folder = reduced(tmp_path).folder
    hostile_hdf5(folder / "basis.h5", "modes", kind)
    with pytest.raises(UserError, match="not a readable basis"):
        Basis.load(folder / "basis.h5")
    run = next(path for path in folder.glob("*.h5") if path.name not in ("basis.h5", "other.h5"))
    hostile_hdf5(run, "latent", kind)
    with pytest.raises(ValueError, match="latent"):
        read_reduced(run)


PACKED = {"compression": "gzip", "compression_opts": 9}


def bomb(path: Path, name: str, shape: tuple[int, ...]) -> None:
    """Replace a dataset by zeros that are packed as tightly as deflate can."""
    with h5py.File(path, "r+") as file:
        dtype = file[name].dtype
        del file[name]
        made = file.create_dataset(name, shape, dtype, chunks=(1, *shape[1:]), **PACKED)
        packed = zlib.compress(bytes(math.prod(shape[1:]) * dtype.itemsize), 9)
        for row in range(shape[0]):
            made.id.write_direct_chunk((row, *[0] * (len(shape) - 1)), packed)


def test_small_hdf5_files_that_unfold_to_more_than_fits(tmp_path) -> None:
    folder = reduced(tmp_path / "data").folder
    bomb(folder / "basis.h5", "modes", (9, 1_000_000))
    with pytest.raises(UserError, match="would unfold"):
        Basis.load(folder / "basis.h5")
    run = next(path for path in folder.glob("*.h5") if path.name != "basis.h5")
    bomb(run, "pose", (2, 6_000_000))
    with pytest.raises(ValueError, match="would unfold"):
        read_reduced(run)
    path = make_run(tmp_path / "a.h5", frames=2, n=3)
    bomb(path, "particles/soil/position/value", (2, 6_000_000, 3))
    assert any("would unfold" in problem for problem in check_run(path))
    assert path.stat().st_size < 1e6
    with pytest.raises(UserError, match="would unfold"):
        Run(path)


def test_good_runs_may_be_compressed(tmp_path) -> None:
    path = make_run(tmp_path / "a.h5", frames=3, n=4)
    with h5py.File(path, "r+") as file:
        for name in ("particles/soil/velocity/value", "observables/body/pose/value"):
            values = file[name][...]
            del file[name]
            file.create_dataset(name, data=values, chunks=(1, *values.shape[1:]), **PACKED)
    with Run(path) as run:
        assert run.pose.shape == (3, 7) and run.velocities().shape == (3, 4, 3)


def test_texts_that_are_stored_once_and_shown_many_times(tmp_path) -> None:
    path = make_run(tmp_path / "a.h5", frames=2, n=3)
    with h5py.File(path, "r+") as file:
        file.attrs["scene"] = np.array(["x"] * 2000, dtype=object)
    with pytest.raises(UserError, match="holds more than 1000 values"):
        Run(path)
    assert check_run(path) == ["the file is damaged (attribute 'scene' holds more than 1000 values)"]
    basis = reduced(tmp_path / "data").folder / "basis.h5"
    with h5py.File(basis, "r+") as file:
        del file["fitted_on"]
        file["fitted_on"] = ["[]"] * 3
    with pytest.raises(UserError, match="holds many texts"):
        Basis.load(basis)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("latent", np.zeros((14, 5, 3)), "latent has shape"),
        ("time", np.zeros(3), "time has shape"),
        ("pose", np.zeros((14, 6)), "pose has shape"),
        ("force", np.zeros((14, 3), dtype=int), "floating-point"),
        ("torque", np.full((14, 3), np.nan), "not finite"),
        ("body_points", np.zeros((14, 0, 3)), "body_points has shape"),
        ("scene", "[" * 10**5, "nested too deep"),
        ("scene", "[]", "no group of keys"),
    ],
)
def test_reduced_runs_that_do_not_fit_together_are_reduced_again(
    tmp_path, caplog, name, value, words
) -> None:
    data = make_dataset(tmp_path)
    folder = reduce_dataset(data, REDUCTION, progress=False).folder
    run = min(path for path in folder.glob("*.h5") if path.name != "basis.h5")
    with h5py.File(run, "r+") as file:
        del file[name]
        file[name] = value
    caplog.clear()
    again = reduce_dataset(data, REDUCTION, progress=False)
    assert words in caplog.text and "is damaged" in caplog.text
    assert all(np.isfinite(one.torque).all() for one in again.runs("train"))
    read_reduced(run)


def test_a_content_hash_does_not_name_a_file_elsewhere(tmp_path) -> None:
    make_dataset(tmp_path / "data")
    with h5py.File(tmp_path / "data" / "runs" / "a.h5", "r+") as file:
        file.attrs["content_hash"] = np.bytes_(b"../../../canary")
    with pytest.raises(UserError, match="content_hash"):
        reduce_dataset(Dataset.open(tmp_path / "data"), REDUCTION, progress=False)
    assert not list(tmp_path.rglob("canary*"))


def test_names_of_runs_do_not_leave_the_dataset(tmp_path) -> None:
    split = {"train": ["../../elsewhere"], "validation": [], "test": []}
    (tmp_path / "dataset.yaml").write_text(yaml.safe_dump({"split": split}))
    with pytest.raises(UserError, match="has no split"):
        Dataset.open(tmp_path)


# --- everything else that is read -------------------------------------------------------------------------


READERS = {
    "a.stl": (read_mesh, SceneError, None),
    "a.obj": (read_mesh, SceneError, None),
    "a.ply": (read_mesh, SceneError, None),
    "a.off": (read_mesh, SceneError, None),
    "a.glb": (read_mesh, SceneError, None),
    "a.3mf": (read_mesh, SceneError, None),
    "a.csv": (read_path, UserError, "cannot read"),
    "a.ckpt": (load_surrogate, UserError, None),
    "a.h5": (Run, UserError, None),
    "basis.h5": (Basis.load, UserError, None),
    "dataset.yaml": (lambda path: Dataset.open(path.parent), UserError, None),
    "reduced.h5": (read_reduced, (OSError, ValueError), None),  # what makes it be reduced again
    "training.json": (
        lambda path: network_costs(path.with_name("best.ckpt"), {}),
        UserError,
        r"training\.json",
    ),
    "tensorboard/events.out.tfevents.1.x": (lambda path: read_log(path.parent), UserError, "tfevents"),
    "points.csv": (read_points, UserError, r"points\.csv"),
    "observed.npz": (read_observation, UserError, "observed"),
    "points/a.json": (lambda path: Study("x", (), path.parents[1]).points(), UserError, r"a\.json"),
    "valid.tfrecord": (lambda path: read_published(path.parent), UserError, None),
}
"""What is read -> how, how it is refused, and in which words."""


def read(path: Path, name: str) -> None:
    """Have a file refused that is not what its name says."""
    path.with_name("metadata.json").write_text(json.dumps({"dataset_split": {}}))
    reader, error, words = READERS[name]
    with pytest.raises(error, match=words):
        reader(path)


MESHES = ["a.stl", "a.obj", "a.ply", "a.off", "a.glb", "a.3mf"]


@pytest.mark.parametrize("name", ["a.ckpt", "a.h5", "basis.h5", "a.csv", *MESHES, "valid.tfrecord"])
def test_numpy_archives_with_objects_are_nothing_that_is_read(tmp_path, canary, name) -> None:
    with (tmp_path / name).open("wb") as file:
        np.savez(file, x=np.array([Touch(canary)], dtype=object))
    read(tmp_path / name, name)
    assert not canary.exists()


@pytest.mark.parametrize("kind", ["pipe", "device", "too large", "folder"])
@pytest.mark.parametrize("name", READERS)
def test_inputs_that_never_end(tmp_path, name, kind) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as file:
            file.truncate(1 << 40)  # without a block on the disk
    read(path, name)


def test_published_runs_of_nothing_but_one_byte(tmp_path) -> None:
    """Numbers of a record may not grow with it: adding to them took the square of its length."""
    (tmp_path / "metadata.json").write_text(json.dumps({"dataset_split": {}}))
    began = time.monotonic()
    for byte in (b"\x00", b"\x7f", b"\x80", b"\xff"):
        payload = byte * 2_000_000
        record = len(payload).to_bytes(8, "little") + bytes(4) + payload + bytes(4)
        for content in (payload, record):
            (tmp_path / "valid.tfrecord").write_bytes(content)
            with pytest.raises(UserError, match="is not a file of published runs"):
                read_published(tmp_path)
    assert time.monotonic() - began < 5.0
