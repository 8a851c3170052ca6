import csv
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from matplotlib.text import Text
from torch.utils.tensorboard import SummaryWriter

from mpm_warp.poses import in_body_frame, in_world_frame
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.evaluate import command as evaluate_module
from sgns.evaluate import report as report_module
from sgns.evaluate.command import full_basis, single_thread, training_means
from sgns.evaluate.figures import png
from sgns.evaluate.report import render_report, write_report
from sgns.reduction.closure import Closure
from sgns.rollout import write_rollout
from sgns_testing.pictures import SMALLEST_TEXT
from sgns_testing.runs import make_run
from sgns_testing.surrogates import FakeSimulator, fitted, frozen_latent, small_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def basis(dataset):
    return fitted(dataset.runs("train"), 6)


def evaluate(*args, **kw):
    return evaluate_module.evaluate(*args, **{"checkpoint": Path("best.ckpt"), **kw})


def simulator(dataset, basis, **kw):
    return FakeSimulator(basis, dataset.runs("train") + dataset.runs("test"), **kw)


def test_whole_evaluation(dataset, basis, tmp_path, monkeypatch):
    known = simulator(dataset, basis, mistake=lambda z, d: z + 0.001 * np.arange(len(z))[:, None, None])
    with Run(dataset.runs("test")[0]) as run:
        rollout = known.rollout(run.pose, in_body_frame(run.pose[0], run.body_points[0]))
        new = write_rollout(tmp_path / "new path.h5", known, run.scene, rollout)
    output, split = tmp_path / "out", dataset.runs("train")[2:] + dataset.runs("test")
    judged = replace(dataset, splits=dataset.splits | {"test": split})
    with SummaryWriter(tmp_path / "tensorboard") as log:
        log.add_scalar("loss/total", 0.5, 10)
    result = evaluate(
        known,
        judged,
        output,
        checkpoint=tmp_path / "best.ckpt",
        new_rollouts=[new],
        made={"command": "sgns evaluate"},
    )
    sizes = []

    def measured(figure):
        sizes.extend(text.get_fontsize() for text in figure.findobj(Text) if text.get_text().strip())
        return png(figure)

    monkeypatch.setattr(report_module, "png", measured)
    report = write_report(result, output)
    assert min(sizes) >= SMALLEST_TEXT

    with (output / "metrics.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(split) + 1
    summary = json.loads((output / "metrics.json").read_text())
    assert summary["aggregate"]["skill_frozen"] == pytest.approx(result.total.skill())
    assert summary["wall_s_per_simulated_s"]["solver_in_run_files"] == pytest.approx(60.0 / 19.0)
    assert summary["wall_s_per_simulated_s"]["network_pose_by_pose"] == result.timing.stepped > 0.0
    with (output / "examples.csv").open(newline="", encoding="utf-8") as file:
        examples = list(csv.DictReader(file))
    assert [row["run"] for row in examples] == [row["run"] for row in rows]
    assert float(examples[-1]["mse_network_m2"]) == pytest.approx(result.total.mse["network"])
    assert result.timing.repeats >= 3
    assert result.timing.decoded > result.timing.rollout > 0.0
    for run in result.runs:
        assert check_run(run.rollout) == []
        with Run(run.rollout) as written:
            assert written.extra["checkpoint"] == str(tmp_path / "best.ckpt")
            assert written.extra["checkpoint_settings"] == known.card["settings"]
            assert written.extra["history"] == known.history
        assert run.scores.mse["total"] == pytest.approx(
            run.scores.mse["network"] + run.scores.mse["reduction"], rel=1e-3
        )
    text = report.read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == len(list((output / "figures").glob("*.png"))) >= 25
    headings = (
        "More runs",
        "Force through time",
        "Torque through time",
        "Error by particle",
        "The whole bed",
    )
    for heading in (*headings, "How it was trained", "A path that was never simulated"):
        assert f">{heading}" in text


def test_perfect_network_is_limited_by_the_reduction_alone(dataset, basis, tmp_path, caplog):
    result = evaluate(simulator(dataset, basis), dataset, tmp_path)
    assert result.total.mse["network"] == pytest.approx(0.0, abs=1e-14)
    assert result.total.mse["total"] == pytest.approx(result.total.mse["reduction"], rel=1e-4)
    assert result.total.force.overall_nrmse == pytest.approx(0.0, abs=1e-6)
    assert result.total.skill() == pytest.approx(
        1 - result.total.mse["reduction"] / result.total.mse["frozen"], rel=1e-4
    )
    assert result.curves.held_out[basis.num_modes] > 0.0
    again = evaluate(simulator(dataset, basis), dataset, tmp_path)
    assert again.total.row() == pytest.approx(result.total.row(), nan_ok=True)
    with caplog.at_level("INFO"):
        evaluate_module.log_summary(result, tmp_path / "report.html")
    for words in (
        "if the soil did not move",
        "mean force of the training runs",
        "no soil error can be below",
        "report.html",
    ):
        assert words in caplog.text
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    r, n = basis.num_modes, basis.num_particles
    shapes = (n, 1), (r, 3), (1,), (1, 3), (1, 3), (1, 3 * r)
    closed = replace(result, basis=replace(basis, closure=Closure(*map(torch.ones, shapes))))
    with caplog.at_level("INFO"):
        evaluate_module.log_summary(closed, tmp_path / "report.html")
    assert "the true modes and the closure leave a soil error of" in caplog.text


def test_frozen_network_has_no_skill(dataset, tmp_path, caplog):
    # With nearly all variance in the subspace, a network that freezes is the frozen baseline.
    basis = fitted(dataset.runs("train"), 10)
    result = evaluate(simulator(dataset, basis, mistake=frozen_latent), dataset, tmp_path)
    assert result.total.skill() == pytest.approx(0.0, abs=0.05)
    worse = replace(result, total=replace(result.total, mse=result.total.mse | {"frozen": 0.0}))
    with caplog.at_level("INFO"):
        evaluate_module.log_summary(worse, tmp_path / "report.html")
    assert "hint: the soil is predicted no better than if nothing moved; what helps" in caplog.text


def test_network_that_always_answers_the_mean_equals_the_baseline(dataset, basis, tmp_path):
    known = simulator(dataset, basis)
    mean, _ = training_means(dataset.runs("train"), known.history)
    known.known = [(p, z, np.broadcast_to(mean, f.shape), t) for p, z, f, t in known.known]
    result = evaluate(known, dataset, tmp_path)
    assert result.total.force.overall_nrmse == pytest.approx(result.total.mean_force.overall_nrmse, rel=1e-5)


def test_runs_that_it_was_trained_on_are_no_test(dataset, basis, tmp_path, caplog):
    seen = [path.stem for path in dataset.runs("train")]
    again = replace(
        dataset, splits=dataset.splits | {"test": [*dataset.runs("train")[:1], *dataset.runs("test")]}
    )
    result = evaluate(simulator(dataset, basis), again, tmp_path)
    assert result.trained_on == seen[:1] and result.chosen_by == []
    assert json.loads((tmp_path / "metrics.json").read_text())["evaluated_runs_trained_on"] == seen[:1]
    with caplog.at_level("WARNING"):
        evaluate_module.log_summary(result, tmp_path / "report.html")
    assert "1 of the 3 evaluated runs bear the names" in caplog.text


def test_body_is_taken_from_the_prediction(dataset, basis, tmp_path):
    known = simulator(dataset, basis)
    given = known.rollout

    def sinks(poses, *args, **kw):
        rollout = given(poses, *args, **kw)
        sunk = poses + np.array([0.0, 0.0, -0.002, 0.0, 0.0, 0.0, 0.0])
        return replace(rollout, poses=sunk, body_points=in_world_frame(sunk, kw.get("body_points", args[0])))

    known.rollout = sinks
    result = evaluate(known, dataset, tmp_path)
    assert result.total.body_mse == pytest.approx(4e-6)
    assert np.isnan(result.total.sinkage_mae)  # no wheel
    assert "body misplaced" in render_report(result, [])


def test_damage_beside_the_checkpoint_is_refused_before_anything_is_rolled_out(dataset, basis, tmp_path):
    place = {"checkpoint": tmp_path / "best.ckpt"}
    (tmp_path / "tensorboard").mkdir()
    os.mkfifo(tmp_path / "tensorboard" / "events.out.tfevents.1.x")
    with pytest.raises(UserError, match="no log of TensorBoard"):
        evaluate(simulator(dataset, basis), dataset, tmp_path / "out", **place)
    (tmp_path / "training.json").write_text("{")
    with pytest.raises(UserError, match="not the summary of a training"):
        evaluate(simulator(dataset, basis), dataset, tmp_path / "out", **place)
    assert not (tmp_path / "out").exists()


def test_full_basis_is_found_beside_the_dataset(dataset, tmp_path):
    full = fitted(dataset.runs("train"), 10)
    other = fitted(dataset.runs("test"), 6)
    place = replace(dataset, path=tmp_path)
    assert full_basis(place, full.sliced(4)).num_modes == 4
    for name, cached in (("a", other), ("b", full)):
        (tmp_path / "reduced" / name).mkdir(parents=True)
        cached.save(tmp_path / "reduced" / name / "basis.h5")
    (tmp_path / "reduced" / "c").mkdir()
    (tmp_path / "reduced" / "c" / "basis.h5").write_bytes(b"not a basis")
    found = full_basis(place, full.sliced(4))
    assert found.num_modes == 10
    assert torch.allclose(found.modes, full.modes)


def test_what_cannot_be_evaluated_is_refused_before_anything_is_rolled_out(dataset, basis, tmp_path):
    known, out = simulator(dataset, basis), tmp_path / "out"

    def test_split(*runs):
        return replace(dataset, splits=dataset.splits | {"test": list(runs)})

    def run(name, scene=None, **kw):
        path = make_run(tmp_path / f"{name}.h5", frames=20, n=120, **kw)
        if scene is not None:
            with h5py.File(path, "r+") as file:
                file.attrs["scene"] = json.dumps(scene)
        return path

    foreign, slow = run("foreign", arrangement_hash="other"), run("slow", frame_rate=30.0)
    words, bare = run("words", {"speed": "fast"}), run("bare", {"blade": {"width": None}})
    (tmp_path / "file").write_text("")
    for judged, output, new, told in (
        (test_split(), out, [], "no complete run in its split 'test'"),
        (test_split(foreign), out, [], "another particle arrangement"),
        (dataset, out, [foreign], "another particle arrangement"),
        (dataset, out, [slow], "recorded at 30 Hz"),
        (test_split(words), out, [], "scene.speed is 'fast'"),
        (test_split(bare), out, [], "scene.blade.thickness is None"),
        (dataset, tmp_path / "file", [], "cannot write to output="),
    ):
        with pytest.raises(UserError, match=re.escape(told)):
            evaluate(known, judged, output, new_rollouts=new)
    assert not out.exists()


def test_one_thread_and_back():
    before = torch.get_num_threads()
    with single_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize("name", ["metrics.csv", "report.html", "figures/side.png", "rollouts/a.h5"])
def test_nothing_but_plain_files_is_replaced(dataset, basis, tmp_path, monkeypatch, name):
    place = tmp_path / name
    place.parent.mkdir(exist_ok=True)
    os.mkfifo(place)
    monkeypatch.setattr(evaluate_module, "write_rollout", None)  # it is found before
    with pytest.raises(UserError, match=f"{place.name}: it is a pipe"):
        evaluate(simulator(dataset, basis), dataset, tmp_path)
    assert place.is_fifo()
