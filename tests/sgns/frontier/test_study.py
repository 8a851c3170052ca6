"""A whole study, tiny: measured, interrupted, gathered."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import yaml
from hydra import initialize_config_module
from omegaconf import OmegaConf

from sgns.cli.help import options_of
from sgns.config import UserError
from sgns.data.dataset import SPLITS
from sgns.frontier import measure
from sgns.frontier import study as timing
from sgns.frontier.command import axes_of, main
from sgns.frontier.point import read_points
from sgns.frontier.study import AXES, Study, composed, composed_scene
from sgns.simulate.campaign import plan
from sgns.simulate.scene import asked_effects

TINY = yaml.safe_load("""
name: tiny
scenes:
  cut:
    scene: quick_excavation
    dataset: quick
    cases: {deep: [scene.duration=0.1, scene.bed.spacing=0.05, scene.blade.thickness=0.12, scene.clearance=0]}
    bands: {force_nrmse: 0.2}
    reference: {label: finer, set: [scene.bed.spacing=0.04]}
    solver:
      - {axis: dx, label: base}
      - {axis: precision, label: float64, set: [solver.precision=float64]}
""")


def settings(output: Path, axis: str = "solver"):
    return OmegaConf.create({"study": TINY, "axis": axis, "output": str(output)})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as change:
        change.setattr(timing, "FRAMES", 1)
        main(settings(output))
    return output


def test_an_axis_may_be_done_before_the_reference(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        main(settings(tmp_path, "reduction"))
    assert "no reference is there yet" in caplog.text
    with pytest.raises(UserError, match="no points"):
        main(settings(tmp_path, "none"))


def test_a_study_gives_a_table_figures_and_a_page(folder: Path) -> None:
    points = {p.label: p for p in read_points(folder / "points.csv")}
    assert set(points) == {"finer", "base", "float64"}
    assert points["finer"].axis == "reference" and points["finer"].force_nrmse != points["finer"].force_nrmse
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


def test_what_is_there_is_not_measured_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(measure, "solver_point", refuse)
    before = (folder / "points.csv").read_bytes()
    main(settings(folder))
    assert (folder / "points.csv").read_bytes() == before


def test_only_a_missing_point_is_measured(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "FRAMES", 1)
    next((folder / "points").glob("*float64*")).unlink()
    with caplog.at_level(logging.INFO):
        main(settings(folder))
    measured = [r.getMessage() for r in caplog.records if "solver:" in r.getMessage()]
    assert len(measured) == 1 and "float64" in measured[0]


def test_an_empty_folder_cannot_be_gathered(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no points"):
        main(settings(tmp_path, "none"))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"point": 3, "cases": []}', '{"point": {}, "cases": ["../x"]}', "[" * 10**5]
)
def test_a_damaged_point_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "a.json").write_text(text)
    with pytest.raises(UserError, match=r"a\.json is no operating point"):
        main(settings(tmp_path, "none"))


def test_axes() -> None:
    assert axes_of("all") == AXES and axes_of("none") == () and axes_of("solver") == ("solver",)
    with pytest.raises(UserError, match="axis is 'x'; allowed: solver"):
        axes_of("x")


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
                wanted = scene.case_scene(case)
                same = [name for name, found in campaign.scenes.items() if found == wanted]
                assert [campaign.split[name] for name in same] == ["test"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"name": None}, "needs name and scenes"),
        ({"scenes": {"cut": {"scene": "excavation"}}}, r"cut\.dataset is missing"),
    ],
)
def test_a_study_that_lacks_something_is_refused(change: dict, line: str) -> None:
    with pytest.raises(UserError, match=line):
        Study.from_settings(TINY | change, Path("x"))


def test_two_points_of_one_name_are_refused() -> None:
    scene = TINY["scenes"]["cut"] | {"solver": [{"axis": "dx", "label": "a"}] * 2}
    study = Study.from_settings(TINY | {"scenes": {"cut": scene}}, Path("x"))
    with pytest.raises(UserError, match="two points with the label 'a'"):
        study.scenes[0].points("solver")
    scene["solver"] = [{"label": "a"}]
    with pytest.raises(UserError, match="needs axis and label"):
        study.scenes[0].points("solver")


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
