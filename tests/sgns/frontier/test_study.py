"""A whole study, tiny: measured, interrupted, gathered."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra import initialize_config_module
from omegaconf import OmegaConf

from mpm_warp import SolverStopped
from sgns.cli.help import options_of
from sgns.config import UserError
from sgns.data.dataset import SPLITS
from sgns.frontier import measure
from sgns.frontier import study as timing
from sgns.frontier.command import main, points_with_errors, scene_figures, with_errors
from sgns.frontier.point import Point, read_points
from sgns.frontier.study import Study, composed, composed_scene
from sgns.simulate.campaign import plan
from sgns.simulate.scene import asked_effects

TINY = yaml.safe_load("""
name: tiny
scenes:
  cut:
    scene: quick_excavation
    dataset: quick
    cases:
      deep: [scene.duration=0.1, scene.bed.spacing=0.05, scene.clearance=0,
        scene.blade.thickness=0.12, scene.blade.edge=square]
    bands: {force_nrmse: 0.2}
    reference: {label: finer, set: [scene.bed.spacing=0.04]}
    solver:
      - {axis: dx, label: base}
      - {axis: precision, label: float64, set: [solver.precision=float64]}
""")
CUT = TINY["scenes"]["cut"]


def settings(output: Path, axis: str = "solver"):
    return OmegaConf.create({"study": TINY, "axis": axis, "output": str(output)})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as change:
        change.setattr(timing, "FRAMES", 1)
        main(settings(output))
    return output


def test_a_study_gives_a_table_figures_and_a_page(folder: Path) -> None:
    points = {p.label: p for p in read_points(folder / "points.csv")}
    assert set(points) == {"finer", "base", "float64"}
    assert points["finer"].axis == "reference" and math.isnan(points["finer"].force_nrmse)
    base = points["base"]
    assert base.force_nrmse > 0.0 and base.wall_s_per_simulated_s > 0.0
    assert base.ratio == pytest.approx(base.cost / base.workload_wall_s_per_simulated_s, rel=1e-3)
    assert base.wall_s_per_simulated_s_low <= base.wall_s_per_simulated_s <= base.wall_s_per_simulated_s_high
    page = (folder / "frontier.html").read_text()
    for words in ("real time", "base", "Reference: finer", "medians of repeats", "viewport"):
        assert words in page
    assert (folder / "figures" / "cut_force_nrmse.png").exists()
    # Precision changes little beside the grid.
    assert points["float64"].force_nrmse == pytest.approx(base.force_nrmse, rel=0.2)


def test_only_a_missing_point_is_measured(folder, caplog, monkeypatch) -> None:
    monkeypatch.setattr(timing, "FRAMES", 1)
    before = (folder / "points.csv").read_text().splitlines()
    (folder / "points" / "cut_solver_float64.json").unlink()
    caplog.set_level("INFO")
    main(settings(folder))
    measured = [line for line in caplog.messages if "solver:" in line]
    assert len(measured) == 1 and "float64" in measured[0]
    after = (folder / "points.csv").read_text().splitlines()
    assert {line for line in before if "float64" not in line} < set(after)


def test_without_a_reference_nothing_can_be_judged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    main(settings(tmp_path, "reduction"))
    assert "no reference is there yet" in caplog.text
    with pytest.raises(UserError, match="holds no points"):
        main(settings(tmp_path, "none"))
    study = Study.from_settings(TINY, tmp_path)
    study.save(Point("tiny", "cut", "solver", "dx", "base"), {})
    with pytest.raises(UserError, match="holds no points"):
        points_with_errors(study)
    assert "cut: the reference (finer) is not there yet" in caplog.text


def test_points_that_did_not_finish_have_no_errors(folder: Path) -> None:
    study = Study.from_settings(TINY, folder)
    (scene,) = study.scenes
    base = Point("tiny", "cut", "solver", "dx", "base")
    runs = {"deep": study.observation(base, "deep")}
    stopped = replace(base, note="stopped: it went wrong")
    assert with_errors(study, scene, stopped, ["deep"], runs) is stopped
    lost = replace(base, label="lost")
    moved = np.full_like(runs["deep"].moved, np.nan)
    study.save(lost, {"deep": replace(runs["deep"], moved=moved)})
    assert with_errors(study, scene, lost, ["deep"], runs).note == "left the range: not finite"
    study.file("cut", "solver", "lost").unlink()


def test_reductions_and_trainings_have_figures_of_their_own() -> None:
    (scene,) = Study.from_settings(TINY, Path("x")).scenes
    known = {"wall_s_per_simulated_s": 0.1, "own_position_rmse_mm": 3.0, "modes": 4.0}
    points = [
        Point("tiny", "cut", "reduction", "r", "r 4", **known),
        Point("tiny", "cut", "surrogate", "r", "net", training_s=30.0, own_force_nrmse=0.5, **known),
    ]
    assert [figure.name for figure in scene_figures(scene, points)] == ["cut_training", "cut_reduction"]


def test_a_solver_that_stops_is_a_point_without_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> None:
        raise SolverStopped("it went\nwrong")

    monkeypatch.setattr(measure, "observe", stop)
    monkeypatch.setattr(timing.Workload, "measure", lambda _: [1.0])
    study = Study.from_settings(TINY, tmp_path)
    measure.measure(study, "solver")
    assert {(point.note, *cases) for point, cases in study.points()} == {("stopped: it went wrong",)}


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"point": 3, "cases": []}', '{"point": {}, "cases": ["../x"]}', "[" * 10**5]
)
def test_a_damaged_point_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "a.json").write_text(text)
    with pytest.raises(UserError, match=r"a\.json is no operating point"):
        main(settings(tmp_path, "none"))


def shipped_study(name: str) -> Study:
    settings = OmegaConf.to_container(composed("frontier", [f"study={name}"]).study)
    return Study.from_settings(settings, Path("x"))


@pytest.mark.parametrize("name", options_of("study"))
def test_points_of_a_shipped_study_compose(name: str) -> None:
    study = shipped_study(name)
    for scene in study.scenes:
        case = scene.cases[next(iter(scene.cases))]
        points = [scene.reference, *scene.points("solver")]
        # Every key once, all together: composing each point would take a minute.
        changes = {change.split("=")[0]: change for point in points for change in point.set}
        made, _ = composed_scene([*case, *changes.values()])
        assert made.duration == composed_scene(case)[0].duration
        assert set(scene.bands) and sum(point.paper for point in points) <= 1
        by_groups: dict[tuple, dict] = {}
        for point in scene.points("surrogate"):
            groups = tuple(change for change in point.set if "." not in change.split("=")[0])
            by_groups.setdefault(groups, {}).update({change.split("=")[0]: change for change in point.set})
        for changes in by_groups.values():
            measure.training_settings(scene.dataset, *changes.values())


def test_cases_are_held_out_runs_of_the_dataset() -> None:
    """They must be in no training run's place: surrogates are judged on them."""
    with initialize_config_module("sgns.conf", version_base="1.3"):
        study = shipped_study("full")
        for scene in study.scenes:
            cfg = composed("simulate", [f"dataset={scene.dataset}", f"scene={scene.settings['scene']}"])
            dataset = OmegaConf.to_container(cfg.dataset, resolve=True)
            base, _ = composed_scene([f"scene={scene.settings['scene']}"])
            campaign = plan(dataset, base.to_dict(), asked_effects(cfg), "float32", seed=0)
            assert set(campaign.split.values()) == set(SPLITS)
            for case in scene.cases:
                wanted, _ = composed_scene(scene.cases[case])
                same = [name for name, found in campaign.scenes.items() if found == wanted]
                assert [campaign.split[name] for name in same] == ["test"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"name": None}, "needs name and scenes"),
        ({"scenes": {"cut": {"scene": "excavation"}}}, r"cut\.dataset is missing"),
        (
            {"scenes": {"cut": CUT | {"training": {}}}},
            "scenes.cut has no key 'training'; allowed: bands, cases",
        ),
        ({"scenes": {"cut": CUT | {"cases": 5}}}, "study.scenes.cases is 5; it must be case: "),
        (
            {"scenes": {"cut": CUT | {"bands": {"force": 1}}}},
            "bands has no key 'force'; allowed: force_nrmse",
        ),
    ],
)
def test_a_study_that_lacks_something_is_refused(change: dict, line: str) -> None:
    with pytest.raises(UserError, match=line):
        Study.from_settings(TINY | change, Path("x"))


@pytest.mark.parametrize(
    ("entries", "line"),
    [
        ([{"axis": "dx", "label": "a"}] * 2, "two points with the label 'a'"),
        ([{"label": "a"}], "needs axis and label"),
        (
            [{"axis": "r", "label": "a", "seconds": 4}],
            "'a' has no key 'seconds'; allowed: axis, centring, label",
        ),
    ],
)
def test_bad_points_are_refused(entries: list, line: str) -> None:
    with pytest.raises(UserError, match=line):
        Study.from_settings(TINY | {"scenes": {"cut": CUT | {"solver": entries}}}, Path("x"))


def test_a_label_stands_for_one_setting(tmp_path: Path) -> None:
    def study(precision: str) -> Study:
        changed = yaml.safe_load(yaml.safe_dump(TINY).replace("float64", precision))
        changed["scenes"]["cut"]["solver"][1]["label"] = "precise"
        return Study.from_settings(changed, tmp_path)

    study("float32").record()
    study("float64").record()  # nothing has been measured yet
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "cut_solver_base.json").touch()
    study("float64").record()
    with pytest.raises(
        UserError, match=r"cut, solver: precise measured with .*float64.*float32.*asked for now"
    ):
        study("float32").record()
    (tmp_path / "study.yaml").write_text("- a list")
    with pytest.raises(UserError, match="does not say what was measured"):
        study("float64").record()
