"""Training: it learns, it resumes to the bit, it stops in plain words."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from mpm_warp.poses import in_body_frame
from sgns.config import Interrupted, UserError
from sgns.data.dataset import Dataset
from sgns.data.run import Run
from sgns.evaluate.command import evaluate, read_log
from sgns.model.checkpoint import load_surrogate
from sgns.model.dynamics import Path, Standardiser
from sgns.model.features import BodyTrack
from sgns.reduction.reduce import reduce_dataset
from sgns.settings import TrainingSettings, model_settings
from sgns.simulator import Simulator
from sgns.train import lightning_module as module
from sgns.train import validation
from sgns.train.command import main, train
from sgns.train.validation import ValidationRollouts
from sgns.train.windows import Batch
from sgns_testing.commands import TRAIN, call, environment, sgns, small_dataset
from sgns_testing.tiny import BRIEF, MODEL, REDUCTION, TRAINING, make_dataset


def run(data, output, start_from=None, model=MODEL, **changes) -> float:
    training = TRAINING | changes
    return train(
        data, num_modes=4, model=model, training=training, output=output, seed=3, start_from=start_from
    )


def content(path):
    return torch.load(path, weights_only=True)


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """Folder and skill of a complete training, only to be read."""
    folder = tmp_path_factory.mktemp("trained")
    return folder, run(data, folder)


def test_it_learns(data, tmp_path) -> None:
    before = run(data, tmp_path / "short", max_steps=1, validate_every=1)
    after = run(data, tmp_path / "long", max_steps=200, validate_every=100, learning_rate=5e-3, noise=0.3)
    assert after > max(before, 0.5)


def test_resuming_equals_not_stopping(data, trained, tmp_path, monkeypatch) -> None:
    class Interrupted(Exception):
        pass

    def stop(self, trainer, *args) -> None:
        if trainer.global_step == 13:
            raise Interrupted

    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(module.StepProgress, "on_train_batch_end", stop)
        run(data, tmp_path)
    assert not (tmp_path / "training.json").exists()
    assert run(data, tmp_path) == trained[1]
    a, b = (content(folder / "last.ckpt") for folder in (trained[0], tmp_path))
    assert a["state_dict"].keys() == b["state_dict"].keys() and a["first_loss"] == b["first_loss"] > 0
    for name, value in a["state_dict"].items():
        assert torch.equal(value, b["state_dict"][name]), name


def test_an_interruption_stays_one(data, tmp_path, monkeypatch) -> None:
    """Lightning makes an exit with status 1 of it."""

    def interrupt(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module.StepProgress, "on_train_batch_end", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(data, tmp_path)


def test_lightning_says_nothing(data, tmp_path, capfd) -> None:
    run(data, tmp_path, max_steps=2)
    (tmp_path / "training.json").unlink()
    run(data, tmp_path, max_steps=2)  # resumed
    assert capfd.readouterr() == ("", "")


def test_a_complete_training_is_not_repeated(data, trained, monkeypatch) -> None:
    folder, skill = trained
    monkeypatch.setattr(module, "run_trainer", None)
    assert run(data, folder) == skill
    # Speed and reporting do not make it another training.
    assert run(data, folder, threads=1, log_every=7) == skill


def test_other_settings_do_not_mix(data, tmp_path) -> None:
    run(data, tmp_path, max_steps=1, validate_every=1)
    with pytest.raises(UserError) as caught:
        run(data, tmp_path, max_steps=2, validate_every=1, batch_size=4, noise=0.3)
    for words in ("training.max_steps is 1 there and 2 here", "batch_size is 8 there", "noise is 0.1 there"):
        assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    run(data, tmp_path, max_steps=2, validate_every=1, resume=False)


def test_the_last_step_is_judged_even_if_odd(data, tmp_path) -> None:
    run(data, tmp_path, max_steps=7, validate_every=5)
    assert content(tmp_path / "last.ckpt")["global_step"] == 7


def test_a_loss_that_is_not_finite_stops_in_one_line(data, tmp_path) -> None:
    with pytest.raises(UserError, match=r"loss is (nan|inf) at step \d+.*learning_rate") as caught:
        run(data, tmp_path, learning_rate=1e14, final_learning_rate=1e14, gradient_clip=None, warmup_steps=0)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "training.json").exists()


def test_what_tensorboard_shows(trained) -> None:
    folder, skill = trained
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    scalars = sorted(events.Tags()["scalars"])
    groups = [
        "judged",
        "loss",
        "pace",
        "result",
    ]  # the useful ones first, no constant ones
    assert list(dict.fromkeys(name.partition("/")[0] for name in scalars)) == groups
    assert events.Tags()["images"] == [
        "best checkpoint/force along a path",
        "best checkpoint/soil at the end",
    ]
    titles = [name.partition("/")[2] for name in scalars if not name.startswith("result/")]
    assert len(set(titles)) == len(titles) == 12
    assert {"loss/change", "loss/force", "loss/torque", "loss/total"} <= set(scalars)
    assert events.Scalars("result/skill")[0].value == pytest.approx(skill)


def test_the_jobs_of_a_sweep_have_names_and_their_keys_in_tensorboard(tmp_path) -> None:
    small_dataset(tmp_path / "data")
    few = [word for word in TRAIN if "num_modes" not in word]
    sweep = ["-m", "reduction.num_modes=2,3", "dataset=quick", "dataset.path=data", *few, "output=out"]
    done = sgns(tmp_path, "train", *sweep)
    assert done.returncode == 0, done.stderr
    for job, modes in enumerate((2, 3)):
        folder = tmp_path / f"out/{job}/num_modes={modes}"
        events = EventAccumulator(str(folder)).Reload()
        plugin = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
        told = HParamsPluginData.FromString(plugin).session_start_info.hparams
        assert {key: value.number_value for key, value in told.items()} == {"reduction.num_modes": modes}
        assert len(read_log(folder)) == 2


class Known(torch.nn.Linear):
    """Gives the answers instead of learning them."""

    predicts_body, members = False, 1

    def __init__(self, *answers) -> None:
        super().__init__(1, 1)
        self.answers = answers
        self.force = Standardiser(torch.zeros(3), torch.ones(3))

    def unroll(self, latent, body, context):
        pad = body.position.shape[1] - self.answers[0].shape[1]
        answers = [torch.cat([a[:, :1].expand(-1, pad, *a.shape[2:]), a], 1) for a in self.answers]
        return Path(*answers, None, body)


def test_the_training_says_the_error_of_the_report(data, trained, tmp_path, caplog) -> None:
    folder, skill = trained
    dataset = Dataset.open(data.folder.parent.parent)
    checkpoint = folder / "best.ckpt"
    evaluation = evaluate(
        Simulator.load(checkpoint), dataset, tmp_path, split="validation", checkpoint=checkpoint
    )
    summary = json.loads((folder / "training.json").read_text())
    assert summary["skill"] == skill == pytest.approx(evaluation.total.skill(), abs=1e-4)
    assert 1e3 * summary["position_rmse"] == pytest.approx(evaluation.total.rmse_mm("total"), rel=1e-3)
    assert summary["skill_in_subspace"] > skill
    with caplog.at_level("INFO"):
        run(data, tmp_path / "again", max_steps=1, validate_every=1)
    number = r"[\d.e+]+"
    soil = rf"on 2 validation runs: soil error {number} mm \({number} mm if the soil did not move\)"
    force = rf"force NRMSE {number} \({number} if it were always the mean force"
    assert re.search(f"{soil}, {force}", caplog.text)


def test_a_score_holds_the_plainest_guesses(data) -> None:
    rollouts = ValidationRollouts(data.runs("validation"), 4, 3, "pose", basis=data.basis)
    still = rollouts.latent.clone()
    still[:, 3:] = still[:, 2:3]
    guessed = Known(still, torch.full_like(rollouts.force, 2.0))
    guessed.force = Standardiser(torch.full((3,), 2.0), torch.ones(3))
    soil, frozen, force, mean_force = rollouts.measure(guessed).errors
    assert soil == pytest.approx(frozen, rel=1e-3) and frozen > 0.0 and force == pytest.approx(mean_force)


def test_more_modes_are_compared_in_full_space(data) -> None:
    """Both numbers of modes predict their own subspace perfectly; only in full space the larger one is better."""
    runs = data.runs("validation")
    scores = []
    for modes in (2, 4):
        rollouts = ValidationRollouts(runs, modes, 3, "pose", basis=data.basis)
        scores.append(rollouts.measure(Known(rollouts.latent, rollouts.force)))
    two, four = scores
    assert two.skill_in_subspace == four.skill_in_subspace == pytest.approx(1.0)
    assert two.skill < four.skill < 1.0 and two.position_rmse > four.position_rmse > 0.0
    left = reconstruction_of(runs, data.basis.sliced(2))
    assert two.position_rmse == pytest.approx(left, rel=1e-6)
    # Where there are no particles, as in published data, it says so.
    alone = ValidationRollouts([replace(one, path=None) for one in runs], 2, 3, "pose", basis=data.basis)
    found = alone.measure(Known(alone.latent, alone.force))
    assert np.isnan(found.position_rmse) and found.words().startswith("soil in the modes 1.000 (1: perfect")


def reconstruction_of(runs, basis) -> float:
    """RMS over axes [m] that the modes leave out after the first 3 frames, mean square over frames, then over runs."""
    squares = []
    for one in runs:
        with Run(one.path) as run:
            positions = run.positions(slice(3, None))
            rest = basis.inverse(basis.transform(positions)).numpy() - positions
            squares.append(np.mean(rest**2))
    return float(np.sqrt(np.mean(squares)))


def test_start_from_another_checkpoint(data, trained, tmp_path) -> None:
    first = trained[0] / "last.ckpt"
    run(data, tmp_path, first, max_steps=1, learning_rate=1e-12, final_learning_rate=1e-12)
    a, b = (content(path)["state_dict"] for path in (first, tmp_path / "last.ckpt"))
    for name in a:
        torch.testing.assert_close(a[name], b[name], rtol=0, atol=1e-9)


def test_a_checkpoint_of_another_model_or_basis_is_refused(data, trained, tmp_path) -> None:
    first = trained[0] / "last.ckpt"
    with pytest.raises(UserError, match="another model"):
        run(data, tmp_path, first, MODEL | {"hidden_width": 8})
    other = replace(data, basis=replace(data.basis, modes=data.basis.modes.flip(1)))
    with pytest.raises(UserError, match="belongs to another basis"):
        run(other, tmp_path, first)


def test_skill_of_truth_and_of_a_frozen_bed(data) -> None:
    rollouts = ValidationRollouts(data.runs("validation"), 4, 3, "pose")

    perfect = rollouts.measure(Known(rollouts.latent, rollouts.force))
    assert perfect.skill == pytest.approx(1.0) and perfect.force_nrmse == 0.0
    frozen = rollouts.latent.clone()
    frozen[:, 3:] = frozen[:, 2:3]
    still = rollouts.measure(Known(frozen, 0 * rollouts.force))
    assert still.skill == pytest.approx(0.0, abs=1e-12) and still.force_nrmse == pytest.approx(1.0)
    lost = rollouts.measure(Known(rollouts.latent * np.nan, rollouts.force))
    assert lost.skill == -np.inf


def test_schedule() -> None:
    for schedule in ("cosine", "exponential"):
        settings = TrainingSettings.from_dict(TRAINING | {"schedule": schedule, "max_steps": 50})
        rates = [settings.rate(step) for step in range(51)]
        assert rates[2] == pytest.approx(1.0) and rates[0] < rates[1] < rates[2]
        assert all(a >= b for a, b in itertools.pairwise(rates[2:]))
        assert rates[50] == pytest.approx(1e-2)


def test_the_command_trains_with_the_number_of_modes_that_was_chosen(tmp_path) -> None:
    three = reduce_dataset(make_dataset(tmp_path / "data"), REDUCTION).basis.energy(3)
    cfg = {
        "dataset": {"name": "tiny", "path": str(tmp_path / "data")},
        "reduction": REDUCTION | {"num_modes": "auto", "choose": "energy", "share": three},
        "model": MODEL,
        "training": BRIEF,
        "preset": {"name": "default"},
        "output": str(tmp_path / "out"),
        "checkpoint": None,
        "seed": 0,
        "device": "cpu",
    }
    skill = main(OmegaConf.create(cfg))
    assert json.loads((tmp_path / "out" / "training.json").read_text())["skill"] == skill
    surrogate = load_surrogate(tmp_path / "out" / "best.ckpt")
    assert surrogate.dynamics.num_modes == 3
    settings = surrogate.card["settings"]
    assert settings["preset"] == "default"
    assert settings["dataset"] == "data"  # its folder has another name than its settings


def poisoned(data, split: str, what: str):
    """The data with one number that is none in the second run of a split."""
    runs = {name: data.runs(name) for name in ("train", "validation", "test")}
    values = getattr(runs[split][1], what).copy()
    values[7].flat[-1] = np.nan
    runs[split][1] = replace(runs[split][1], **{what: values})
    return replace(data, _runs=runs)


@pytest.mark.parametrize("what", ["latent", "pose", "body_points", "force", "torque"])
@pytest.mark.parametrize(("split", "name"), [("train", "b"), ("validation", "f")])
def test_one_poisoned_number_is_named(data, tmp_path, what, split, name) -> None:
    with pytest.raises(
        UserError, match=rf"not finite at frame 7 of the reduced run {name};.*sgns check {name}\.h5"
    ):
        run(poisoned(data, split, what), tmp_path)


def test_a_training_that_diverges_stops_and_keeps_its_best(data, tmp_path, monkeypatch) -> None:
    """From step 12 on the rate is a thousand times what it should be; step 10 was judged and saved."""
    rate = TrainingSettings.rate
    monkeypatch.setattr(
        TrainingSettings, "rate", lambda self, step: rate(self, step) * (1e3 if step > 11 else 1)
    )
    with pytest.raises(
        UserError, match=r"diverges: the loss is .* at step 1\d and was .*best\.ckpt"
    ) as caught:
        run(data, tmp_path / "ill", max_steps=60, validate_every=10)
    assert "\n" not in str(caught.value)
    assert content(tmp_path / "ill" / "best.ckpt")["global_step"] == 10
    assert np.isfinite(Simulator.load(tmp_path / "ill" / "best.ckpt").mean_force).all()
    assert not (tmp_path / "ill" / "training.json").exists()


def test_weights_that_are_not_finite_are_not_saved(data, tmp_path, monkeypatch) -> None:
    """Gradients that are not finite spoil the weights though the loss was finite: step 10 is saved, step 20 is not."""
    clip = module.SurrogateTraining.configure_gradient_clipping

    def spoil(self, optimizer, *args, **kw) -> None:
        clip(self, optimizer, *args, **kw)
        if self.global_step == 19:
            next(self.surrogate.dynamics.network.parameters()).grad[0] = torch.nan

    monkeypatch.setattr(module.SurrogateTraining, "configure_gradient_clipping", spoil)
    with pytest.raises(UserError, match=r"the weights .* are not finite after step 20; .*best\.ckpt"):
        run(data, tmp_path, max_steps=30)
    for name in ("best.ckpt", "last.ckpt"):
        kept = content(tmp_path / name)
        assert kept["global_step"] == 10
        assert all(value.isfinite().all() for value in kept["state_dict"].values())


def test_one_training_at_a_time_in_a_folder(data, tmp_path, monkeypatch) -> None:
    """The second one's settings do not matter: neither result would be whole."""
    before = module.run_trainer

    def fit(*args) -> None:
        with pytest.raises(UserError, match=r"best\.ckpt is being made by process"):
            run(data, tmp_path, learning_rate=2e-3)
        before(*args)

    monkeypatch.setattr(module, "run_trainer", fit)
    run(data, tmp_path, max_steps=1, validate_every=1)
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["best.ckpt", "last.ckpt", "tensorboard", "training.json"]


@pytest.mark.parametrize("resume", ["auto", False])
@pytest.mark.parametrize("name", ["best.ckpt", "last.ckpt", "training.json"])
def test_a_pipe_stays_a_pipe(data, tmp_path, monkeypatch, name, resume) -> None:
    os.mkfifo(tmp_path / name)
    monkeypatch.setattr(module, "run_trainer", None)  # it is found before
    with pytest.raises(UserError, match=f"{name}: it is a pipe"):
        run(data, tmp_path, resume=resume)
    assert (tmp_path / name).is_fifo()


# --- in a job of a cluster ---------------------------------------------------------------------------------

SECOND_OF_TWO_TASKS = {
    **{"SLURM_JOB_ID": "17", "SLURM_JOB_NAME": "job", "SLURM_NTASKS": "2", "SLURM_NODELIST": "here"},
    **{"SLURM_PROCID": "1", "SLURM_LOCALID": "1", "SLURM_NODEID": "0"},
}


IN_A_JOB = f"""
import sys
from sgns.cli import main
from sgns_testing.commands import call
settings = ["dataset.path=data", *{TRAIN}]
done = call("train", *settings, "output=whole")
print(done.returncode, done.stderr, file=sys.stderr)
sys.argv = ["sgns", "train", *settings, "output=out", "training.max_steps=1000000"]
sys.exit(main())
"""


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
def test_in_an_allocation_of_several_tasks_it_is_one_process_that_a_signal_ends_as_ctrl_c(
    tmp_path, number
) -> None:
    make_dataset(tmp_path / "data", frames=40)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(
        [sys.executable, "-c", IN_A_JOB], cwd=tmp_path, env=environment() | SECOND_OF_TWO_TASKS, **pipes
    )
    deadline = time.monotonic() + 60.0
    while not (tmp_path / "out" / "last.ckpt").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    ended = "sgns train: interrupted; to go on, give the same command with output=out"
    assert said == f"0 \n{ended}\n"
    assert process.returncode == 128 + number
    assert list((tmp_path / "whole" / "tensorboard").glob("events*"))  # it also logs
    # No checkpoint of Lightning's.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "out", "whole"]


def test_it_says_once_how_long_it_takes(monkeypatch, caplog) -> None:
    clock = itertools.count(0.0, 4.0)  # a step takes 4 s
    monkeypatch.setattr(validation.time, "perf_counter", lambda: next(clock))
    progress = validation.StepProgress(validation.tqdm(total=33, disable=True))
    with caplog.at_level("INFO"):
        for step in range(1, 11):
            progress.on_train_batch_end(SimpleNamespace(global_step=step))
    assert caplog.messages == ["0.25 steps a second: about 2 min more"]


def test_before_the_first_checkpoint_an_interruption_says_that_nothing_is_kept(
    data, tmp_path, monkeypatch
) -> None:
    def stop(task) -> None:
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(module, "NETWORK", module.NETWORK._replace(run=stop))
    with pytest.raises(Interrupted) as caught:
        run(data, tmp_path, validate_every=70)
    assert (
        caught.value.said == "nothing of the training is kept yet; the first checkpoint comes after 70 steps"
    )
    assert caught.value.number == signal.SIGTERM
    (tmp_path / "last.ckpt").touch()
    monkeypatch.setattr("sgns.train.command.what_is_there", lambda *_: "partial")
    with pytest.raises(Interrupted) as caught:
        run(data, tmp_path, validate_every=70)
    assert caught.value.said == ""


# --- several members ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ensemble(data, tmp_path_factory):
    """Folder of a training of two members, only to be read."""
    folder = tmp_path_factory.mktemp("ensemble")
    run(data, folder, members=2)
    return folder


def test_members_differ_and_share_their_scales(ensemble) -> None:
    dynamics = load_surrogate(ensemble / "best.ckpt").dynamics
    assert dynamics.members == 2 and (dynamics.band > 0.0).all() and not (dynamics.band == 1.0).all()
    first, second = (dynamics.member(index) for index in range(2))
    assert first.members == 1 and torch.equal(first.force.scale, second.force.scale)
    pairs = zip(first.parameters(), second.parameters(), strict=True)
    assert not any(torch.equal(a, b) for a, b in pairs)


def test_each_member_learns_from_its_own_windows_alone(data) -> None:
    how = TrainingSettings.from_dict(TRAINING | {"members": 2, "batch_size": 6})
    card = {"settings": {}, "frame_rate": 60.0, "scene": data.runs("train")[0].scene}
    surrogate, loader = module.prepared(data, 4, model_settings(MODEL), how, 0, card, None)
    batch = next(iter(loader))
    assert len(batch.latent) == 6  # three each
    trained = module.SurrogateTraining(surrogate, how)
    halves = [
        Batch(
            *(
                BodyTrack(*(p[rows] for p in part)) if isinstance(part, BodyTrack) else part[rows]
                for part in batch
            )
        )
        for rows in (slice(3), slice(3, None))
    ]
    whole, dynamics = trained.losses(batch), surrogate.dynamics
    each = []
    for index, half in enumerate(halves):
        surrogate.dynamics = dynamics.member(index)
        each.append(trained.losses(half))
    for name, value in whole.items():
        mean = sum(float(one[name].detach()) for one in each) / 2
        assert float(value.detach()) == pytest.approx(mean, rel=1e-5)


def test_the_band_holds_nine_tenths_of_the_validation_runs(data, ensemble) -> None:
    simulator = Simulator.load(ensemble / "best.ckpt", spread=True)
    force, soil = [], []
    for one in data.runs("validation"):
        points = in_body_frame(one.pose[0], one.body_points[0])
        found = simulator.rollout(one.pose, points, one.latent[:3, :4])
        force.append((np.abs(found.force - one.force) <= found.force_spread * (1 + 1e-5))[3:])
        soil.append((np.abs(found.latent - one.latent[:, :4]) <= found.latent_spread * (1 + 1e-5))[3:])
    assert np.concatenate(force).mean(axis=0) == pytest.approx(0.9, abs=0.06)  # a value more or less
    assert np.concatenate(soil).mean() == pytest.approx(0.9, abs=0.01)


def test_a_training_of_members_goes_on_and_begins_from_as_many(data, ensemble, tmp_path) -> None:
    run(data, tmp_path, ensemble / "last.ckpt", members=2, max_steps=1, validate_every=1)
    with pytest.raises(
        UserError, match=r"training\.members is 1 and .* has 2; use as many, or checkpoint=null"
    ):
        run(data, tmp_path / "one", ensemble / "last.ckpt")
    with pytest.raises(UserError, match=r"training\.members is 2 there and 3 here"):
        run(data, ensemble, members=3)


def test_fewer_modes_of_several_members(data, tmp_path) -> None:
    run(data, tmp_path, members=2, fewer_modes=1.0, max_steps=3, validate_every=3)
    path = data.runs("test")[0].pose
    for spread in (False, True):
        assert (
            Simulator.load(tmp_path / "best.ckpt", num_modes=2, spread=spread).rollout(path).latent.shape[1]
            == 2
        )


@pytest.mark.long
@pytest.mark.timeout(300)  # processes that load torch
@pytest.mark.parametrize("members", [1, 2])
def test_two_processes_train_as_one_does(members, empty_folder) -> None:
    make_dataset(empty_folder / "data")
    words = [
        *TRAIN,
        "dataset.path=data",
        "training.max_steps=6",
        "training.validate_every=3",
        "training.log_every=1",
    ]
    words += ["training.batch_size=8", f"training.members={members}"]
    both = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node=2",
        "-m",
        "sgns",
        "train",
    ]
    done = subprocess.run(
        [*both, *words, "training.devices=2", "output=two"],
        capture_output=True,
        text=True,
        timeout=200,
        env=environment(),
    )
    assert done.returncode == 0, done.stderr
    assert (
        done.stdout.count("next: sgns evaluate") == done.stdout.count("step 6 of 6") == 1
    )  # one of them speaks
    one = call("train", *words, "output=one")
    assert one.returncode == 0, one.stderr
    curves = []
    for name in ("one", "two"):
        events = EventAccumulator(f"{name}/tensorboard").Reload()
        curves.append([event.value for event in events.Scalars("loss/total")])
    assert len(curves[0]) == 6
    np.testing.assert_allclose(curves[1], curves[0], rtol=1e-4)
    a, b = (content(f"{name}/last.ckpt")["state_dict"] for name in ("one", "two"))
    for name, value in a.items():
        torch.testing.assert_close(b[name], value, rtol=1e-3, atol=1e-5)
    # How many processes there were does not make it another training.
    assert "is complete" in call("train", *words, "output=two").stdout


def test_processes_that_are_not_there_are_told(data, tmp_path) -> None:
    with pytest.raises(
        UserError, match=r"devices=2 training.nodes=3 need 6 processes, and this is one: start"
    ):
        run(data, tmp_path, devices=2, nodes=3, batch_size=6)
    with pytest.raises(UserError, match=r"takes the same share of the 8 windows of a step"):
        run(data, tmp_path, devices=3)
