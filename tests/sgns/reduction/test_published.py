"""Reader of the authors' files, on records written here."""

from __future__ import annotations

import json
import runpy
import struct
from pathlib import Path

import numpy as np
import pytest

from mpm_warp import Excavation, Wheel
from sgns.config import UserError
from sgns.reduction.published import PublishedRun, fingerprint, published_dataset, read_published
from sgns_testing.commands import refusal, sgns
from sgns_testing.published import record

SCRIPT = runpy.run_path(str(Path(__file__).parents[3] / "experiments" / "published_forces" / "run.py"))
excavation_case, wheel_case = SCRIPT["excavation_case"], SCRIPT["wheel_case"]


def write(folder, records, cases, split="valid"):
    (folder / "metadata.json").write_text(json.dumps({"dataset_split": {split: cases}}))
    data = b"".join(struct.pack("<Q", len(r)) + b"crc!" + r + b"crc!" for r in records)
    (folder / f"{split}.tfrecord").write_bytes(data)


def test_axes_signs_and_the_doubled_first_frame(tmp_path):
    # One body node, one mode; there: y up, x backwards, the bin from 0.1 on.
    first = [[0.82, 0.30, 0.50], [1.0, 2.0, 3.0]]
    frames = [first, first, [[0.72, 0.20, 0.55], [4.0, 5.0, 6.0]]]
    write(tmp_path, [record(frames, [3, 6], [[9, 9, 9], [10, 20, 30], [11, 21, 31]])], [186])
    (run,) = read_published(tmp_path)
    assert run.case == 186
    np.testing.assert_allclose(run.body_points[:, 0], [[0.08, 0.40, 0.05], [0.18, 0.45, -0.05]], atol=1e-6)
    np.testing.assert_allclose(run.latent[:, 0], [[1, 2, 3], [4, 5, 6]])
    # A force that resists the blade is positive there and negative here.
    np.testing.assert_allclose(run.force, [[-10, 30, 20], [-11, 31, 21]])
    assert run.context.shape == (2, 0)


@pytest.mark.parametrize(
    "text", ["[]", "{}", '{"dataset_split": "x"}', '{"dataset_split": {"valid": ["a"]}}']
)
def test_metadata_that_do_not_name_the_runs(tmp_path, text):
    (tmp_path / "metadata.json").write_text(text)
    with pytest.raises(
        UserError, match=r"metadata\.json does not name the valid runs by their numbers; it needs"
    ):
        read_published(tmp_path)


def test_wheel_runs_say_their_gravity_friction_and_load(tmp_path):
    # A wheel is predicted there (type 0); a force against its motion is positive there, a drawbar pull negative.
    frames = [[[0.38, 0.31, 0.195], [1.0, 2.0, 3.0]]] * 3
    context = [[1.62, 37.0, 164.0]] * 3
    write(tmp_path, [record(frames, [0, 6], [[-14, 41, -0.6]] * 3, context)], [44])
    (run,) = read_published(tmp_path)
    np.testing.assert_allclose(run.body_points[0, 0], [0.12, 0.095, 0.1517], atol=1e-6)
    np.testing.assert_allclose(run.force[0], [14, -0.6, 41], atol=1e-6)
    np.testing.assert_allclose(run.context, [[1.62, 37.0, 164.0]] * 2, rtol=1e-6)
    case = wheel_case(run.case)
    assert [case[key] for key in ("gravity", "friction_angle", "load")] == [1.62, 37.0, 164.0]


@pytest.mark.parametrize(
    ("values_of", "case", "values"),
    [
        (excavation_case, 186, (0.08, 0.10, 10.0, "curved")),
        (excavation_case, 1, (0.02, 0.01, 0.0, "ramp")),
        (wheel_case, 1, (1.62, 0.2, 100 / 9, 0.05, 30.0, 0.25 / 3)),
        (wheel_case, 203, (9.81, 5 / 13, 164.0, 0.15, 37.0, 0.25 / 3)),
        (wheel_case, 243, (9.81, 0.7, 225.0, 0.30, 43.0, 0.125)),
    ],
)
def test_case_numbers(values_of, case, values):
    assert tuple(values_of(case).values()) == values


def test_a_wheel_of_a_case_and_cases_that_are_not_there():
    assert 1e3 * Wheel(**wheel_case(203)).speed == pytest.approx(12.0)
    with pytest.raises(UserError, match="1 to 250"):
        excavation_case(251)
    with pytest.raises(UserError, match="1 to 243"):
        wheel_case(0)


def blade(case, frames=8, points=15):
    """A record of a blade that moves on, with two modes, and its case."""
    rng = np.random.default_rng(case)
    y, z = np.meshgrid(np.linspace(0.3, 0.5, points // 5), np.linspace(0.2, 0.6, 5), indexing="ij")
    plate = np.stack([np.full(points, 0.8), y.ravel(), z.ravel()], axis=1)
    still = rng.normal(size=(2, 3))
    moved = [np.concatenate([plate - [0.01 * t, 0, 0], still + 0.1 * t]) for t in range(frames)]
    force = rng.normal(size=(frames, 3)) + np.array([50.0, 30.0, 0.0])
    return record([moved[0], *moved], [3] * points + [6, 6], np.concatenate([force[:1], force]))


def test_a_folder_becomes_a_dataset(tmp_path):
    cases = [186, 99, 22, 78]
    write(tmp_path, [blade(case, points=15 if case in (99, 78) else 20) for case in cases], cases)
    settings = {"path": str(tmp_path), "folds": None, "fold": 0}
    whole = published_dataset(settings, 2)
    assert [run.name for run in whole.runs("train")] == [f"excavation_{case:03d}" for case in cases]
    assert whole.runs("test") == [] and whole.runs("validation") == []
    assert whole.basis.arrangement_hash == "published-excavation"
    folded = published_dataset(settings | {"folds": 2, "fold": 1}, 2)
    assert [run.name for run in folded.runs("test")] == ["excavation_099", "excavation_078"]
    assert folded.basis.fitted_on == [f"{run.name} {fingerprint(run)}" for run in folded.runs("train")]
    for run in whole.runs("train"):
        # Whatever the number of points, the pose is the middle of the lowest row, which moves along x.
        np.testing.assert_allclose(run.pose[0, :3], [0.1, 0.3, 0.05], atol=1e-6)
        np.testing.assert_allclose(run.pose[:, 0], 0.1 + 0.01 * np.arange(8), atol=1e-6)
        np.testing.assert_allclose(run.latent[1] - run.latent[0], [[-0.1, 0.1, 0.1]] * 2, atol=1e-6)
    for wrong in ({"folds": 5}, {"folds": 2, "fold": 2}):
        with pytest.raises(UserError, match=r"dataset\.fold"):
            published_dataset(settings | wrong, 2)
    with pytest.raises(UserError, match="holds 2 modes"):
        published_dataset(settings, 3)


def test_files_of_the_authors_split_are_kept_apart(tmp_path):
    split = {"train": [1, 2, 2], "valid": [3], "test": [4]}
    for name, cases in split.items():
        write(tmp_path, [blade(case) for case in cases], cases, name)
    (tmp_path / "metadata.json").write_text(json.dumps({"dataset_split": split}))
    found = published_dataset({"path": str(tmp_path)}, 2)
    # Drawn twice with replacement, used once.
    assert [run.name for run in found.runs("train")] == ["excavation_001", "excavation_002"]
    assert [run.name for run in found.runs("validation")] == ["excavation_003"]
    assert [run.name for run in found.runs("test")] == ["excavation_004"]
    with pytest.raises(UserError, match=r"dataset\.folds=null"):
        published_dataset({"path": str(tmp_path), "folds": 2}, 2)


def test_training_and_judging_from_the_command_line(tmp_path):
    train, other = tmp_path / "train", tmp_path / "other"
    for folder, cases in ((train, [5, 6, 7]), (other, [7, 8, 9])):
        folder.mkdir()
        write(folder, [blade(case) for case in cases], cases)
    small = (
        "model.hidden_width=8 training.max_steps=4 training.validate_every=4 reduction.num_modes=2".split()
    )
    done = sgns(tmp_path, "train", "dataset=published", f"dataset.path={train}", "output=t", *small)
    assert done.returncode == 0, done.stderr
    judge = ["evaluate", "dataset=published", "checkpoint=t/best.ckpt", "output=e"]
    done = sgns(tmp_path, *judge, f"dataset.path={other}")
    assert done.returncode == 0, done.stderr
    # Run 7 was trained on: it is left out of the table.
    assert "excavation_008" in done.stdout and "excavation_009" in done.stdout
    assert "excavation_007" not in done.stdout and (tmp_path / "e" / "metrics.csv").exists()
    done = sgns(tmp_path, *judge, f"dataset.path={train}")
    assert done.returncode == 0 and "was trained on all of these runs" in done.stdout + done.stderr
    assert "it needs metadata.json" in refusal(tmp_path, *judge, f"dataset.path={tmp_path}")


def test_the_ripple_of_a_published_force_is_found_where_the_blade_has_its_speed():
    time = np.arange(320) / 60.0
    points = np.zeros((320, 15, 3))
    points[:, :, 0] = (0.08 * np.maximum(time - 1.0, 0.0))[:, None]  # case 123 has 8 cm/s
    force = np.zeros((320, 3))
    force[:, 2] = 50.0 + 20.0 * time + np.where(time < 1.0, 90.0, 5.0) * np.sin(2.0 * np.pi * 7.0 * time)
    force[:60, 2] += 90.0 * np.sin(2.0 * np.pi * 3.0 * time[:60])
    run = PublishedRun("excavation", points, np.zeros((320, 8, 3)), force, np.zeros((320, 0)), 123)
    found = SCRIPT["ripple"](run, Excavation())
    assert found == {"case": 123, "ripple": pytest.approx(7.0, abs=0.05), "nodes": pytest.approx(4.0)}
