"""Points of reductions and of surrogates, in tiny studies; those of the solver are in test_study.py."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from mpm_warp import effects_for
from sgns.config import UserError
from sgns.data.dataset import Dataset
from sgns.evaluate.command import evaluate
from sgns.frontier import measure as measuring
from sgns.frontier.measure import measure, own_errors, reduction_points, timed_training, training_settings
from sgns.frontier.study import Study, Workload, composed_scene
from sgns.model.checkpoint import read_checkpoint
from sgns.reduction.reduce import reduce_dataset
from sgns.simulate.run import simulate_scene
from sgns_testing.surrogates import FakeSimulator, fitted, small_dataset
from sgns_testing.tiny import FIT, MODEL, POLYNOMIAL, REDUCTION, TRAINING, make_dataset

BED = [
    "scene.bed.spacing=0.05",
    "scene.bed.particles_per_cell=1",
    "scene.duration=0.2",
    "scene.blade.thickness=0.1",
    "scene.blade.edge=square",  # meets soil at once
]
SPLIT = {"train": ["a", "b", "c"], "validation": ["d"], "test": ["e"]}


def study(folder, **scene):
    settings = {"scene": "quick_excavation", "dataset": "quick", "cases": {"a": BED}} | scene
    settings |= {"reference": {"label": "fine"}}
    return Study.from_settings({"name": "tiny", "scenes": {"cut": settings}}, folder)


def surrogates(folder, **scene):
    entries = [
        {"axis": "preset", "label": "whole"},
        {"axis": "preset", "label": "polynomial", "set": ["model=polynomial"]},
    ]
    return study(folder, surrogate=entries, **scene)


@pytest.fixture(autouse=True)
def no_workload(monkeypatch):
    monkeypatch.setattr(Workload, "measure", lambda _: [1.0, 1.0])


# --- Errors against the training data's solver: those of `sgns evaluate` --------------------------------


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("data"))


def simulator(dataset, **kw):
    return FakeSimulator(fitted(dataset.runs("train"), 6), dataset.runs("train") + dataset.runs("test"), **kw)


def test_they_are_those_of_evaluate(dataset, tmp_path):
    known = simulator(
        dataset, mistake=lambda z, d: z + 1e-3 * np.arange(len(z))[:, None, None], force_factor=1.1
    )
    found = own_errors(known, dataset).row()
    told = evaluate(known, dataset, tmp_path, checkpoint=Path("best.ckpt")).total.row()
    assert set(found) == set(told)
    # A run file keeps positions in float32.
    for key in ("rmse_total_mm", "skill_frozen", "surface_rmse_mm", "force_nrmse", "draft_mpe_percent"):
        assert found[key] == pytest.approx(told[key], rel=1e-3)


# --- Surrogates -----------------------------------------------------------------------------------------


def test_overrides_make_settings():
    assert training_settings("quick", "preset=fast").model.hidden_width == 64
    assert training_settings("quick_wheel", "model=polynomial").training.draws == 2


@pytest.fixture(scope="module")
def cuts(tmp_path_factory):
    """Settings of `sgns train`, network and polynomials, on five runs of the smallest bed that a plate cuts."""
    folder = tmp_path_factory.mktemp("data")
    for number, name in enumerate(name for names in SPLIT.values() for name in names):
        scene, _ = composed_scene(["scene=quick_excavation", *BED, f"scene.speed={0.1 + 0.05 * number}"])
        simulate_scene(scene, folder / "runs" / f"{name}.h5", effects=effects_for(scene)[0])
    (folder / "dataset.yaml").write_text(yaml.safe_dump({"name": "tiny", "split": SPLIT}))
    common = {
        "reduction": REDUCTION,
        "preset": {"name": "tiny"},
        "dataset": {"name": "tiny", "path": str(folder)},
        "seed": 3,
        "device": "cpu",
        "checkpoint": None,
    }
    network = OmegaConf.create(common | {"model": MODEL, "training": TRAINING | {"max_steps": 10}})
    return network, OmegaConf.create(common | {"model": POLYNOMIAL, "training": FIT})


@pytest.fixture
def tiny(cuts, monkeypatch):
    monkeypatch.setattr(measuring, "training_settings", lambda _, *changes: cuts[len(changes)])


def test_a_training_takes_the_settings_of_the_command(cuts, tmp_path):
    reduced = reduce_dataset(Dataset.open(cuts[0].dataset.path), cuts[0].reduction, progress=False)
    seconds, samples = timed_training(reduced, cuts[0], tmp_path)
    assert seconds > 0 and samples == 10 * TRAINING["batch_size"]
    settings = read_checkpoint(tmp_path / "best.ckpt")["hyper_parameters"]["settings"]
    assert (settings["training"]["max_steps"], settings["seed"]) == (10, 3)
    frames = [len(run.latent) for run in reduced.runs("train")]
    assert timed_training(reduced, cuts[1], tmp_path)[1] == FIT["draws"] * (
        sum(frames) - 3
    )  # anew, in its place


@pytest.mark.usefixtures("tiny")
def test_points_from_training_to_observation(tmp_path):
    asked = surrogates(tmp_path)
    measure(asked, "surrogate")
    points = {point.label: point for point, _ in asked.points()}
    whole, polynomial = points["whole"], points["polynomial"]
    assert (whole.training_runs, whole.own_runs, whole.note) == (3, 1, "")
    assert whole.training_samples == 10 * TRAINING["batch_size"]
    assert 0 < whole.wall_s_per_simulated_s < whole.decoded_wall_s_per_simulated_s
    assert whole.stepped_cost > whole.cost  # a call for every pose
    assert polynomial.settings == "dataset=quick model=polynomial"
    assert polynomial.parameters > 0 and not math.isnan(polynomial.own_force_nrmse)
    seen = asked.observation(whole, "a")
    assert len(seen.time) == 13
    np.testing.assert_array_equal(seen.force[0], 0)
    assert np.nanmax(np.abs(seen.moved[0])) < 1e-2  # the start, as the basis holds it

    made = asked.file("cut", "surrogate", "whole").stat().st_mtime_ns
    measure(asked, "surrogate")
    assert asked.file("cut", "surrogate", "whole").stat().st_mtime_ns == made


@pytest.mark.usefixtures("tiny")
def test_a_rollout_that_leaves_the_numbers_is_said_and_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(measuring, "finite_frames", lambda _: 7)
    asked = surrogates(tmp_path)
    measure(asked, "surrogate")
    assert [(point.note, cases) for point, cases in asked.points()] == [
        ("a: not finite from frame 7 on", [])
    ] * 2


@pytest.mark.usefixtures("tiny")
def test_another_bed_than_the_data_s_is_one_line(tmp_path):
    with pytest.raises(UserError, match="has another bed of particles than dataset=quick"):
        measure(surrogates(tmp_path, cases={"a": ["scene.duration=0.2"]}), "surrogate")


# --- Reductions -----------------------------------------------------------------------------------------


def reductions(folder, *entries):
    found = [{"axis": "r", "label": entry["centring"], **entry} for entry in entries]
    return study(folder, dataset="tiny", cases={"a": []}, reduction=found)


def test_a_point_for_each_number_of_modes_that_there_is(tmp_path, monkeypatch, caplog):
    make_dataset(tmp_path / "data")
    settings = OmegaConf.create({"dataset": {"path": str(tmp_path / "data")}})
    monkeypatch.setattr(measuring, "training_settings", lambda _: settings)
    modes = {"centring": "particle_axis", "modes": [1, 2, 4, 100]}
    asked = reductions(tmp_path / "out", modes, {"centring": "scalar", "modes": [4]})
    caplog.set_level("INFO")
    measure(asked, "reduction")
    assert "r 100 left out, the data has" in caplog.text
    points = {point.label: point for point, _ in asked.points()}
    assert set(points) == {"particle_axis, r 1", "particle_axis, r 2", "particle_axis, r 4", "scalar, r 4"}
    one, two, four = (points[f"particle_axis, r {r}"] for r in (1, 2, 4))
    assert one.own_position_rmse_mm > two.own_position_rmse_mm > four.own_position_rmse_mm > 0
    assert one.energy < two.energy < four.energy < 1
    assert one.own_runs == 3  # two validation runs and a test run
    assert four.wall_s_per_simulated_s >= four.decoded_wall_s_per_simulated_s > 0
    # With all modes of one centring the energy says what the error says.
    left = (four.own_position_rmse_mm / four.frozen_rmse_mm) ** 2
    assert four.energy == pytest.approx(1 - left, abs=1e-4)

    monkeypatch.setattr(measuring, "fit_runs", lambda *_: pytest.fail("fitted again"))
    measure(reductions(asked.folder, {"centring": "particle_axis", "modes": [1, 2, 4]}), "reduction")


def test_reductions_become_settings_of_the_command(tmp_path):
    asked = reductions(tmp_path, {"centring": "scalar", "modes": [64, 65]}).scenes[0]
    few, many = reduction_points(asked)
    assert few.set == ["reduction.centring=scalar", "reduction.num_modes=64"]
    assert many.label == "scalar, r 65" and many.set[-1] == "reduction.max_modes=65"


@pytest.mark.parametrize(
    "entry, line",
    [
        ({"centring": "mean", "modes": [1]}, "centring is 'mean'; allowed: scalar"),
        ({"centring": "scalar", "modes": [0]}, r"modes is \[0\]; it must be 1 or more"),
        ({"centring": "scalar"}, "modes is missing"),
    ],
)
def test_bad_reductions_are_one_line(tmp_path, entry, line):
    with pytest.raises(UserError, match=line):
        list(reduction_points(reductions(tmp_path, entry).scenes[0]))
