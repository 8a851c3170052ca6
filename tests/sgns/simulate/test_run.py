"""A run whose solver stopped: what is kept, and how to go on with it."""

from __future__ import annotations

import shutil
import signal
from dataclasses import fields
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from mpm_warp import (
    Bed,
    Body,
    Cylinder,
    Effects,
    Excavation,
    MeshBody,
    Other,
    Plate,
    Scene,
    Solver,
    SolverStopped,
    Sphere,
    Wheel,
    effects_for,
    mesh_files,
)
from mpm_warp.launch import run_concurrently
from sgns.config import Interrupted, UserError, heeded_signals
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.data.writer import stopped_path
from sgns.simulate import workers as campaign_runs
from sgns.simulate.run import restart_from, scene_stages, simulate_scene, unfinished
from sgns.simulate.scene import recorded
from sgns_testing.commands import SHORT, SMALL, refusal, sgns
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj

LAST = 3  # frame before the one in which the solver stops


def small(**kw) -> Excavation:
    return Excavation(
        bed=Bed(size=(0.4, 0.2, 0.16), spacing=0.04, store_every=3),
        blade=Plate(length=0.1, width=0.1, thickness=0.08, edge="square"),
        duration=0.1,
        **kw,
    )


def physics() -> dict[str, Any]:
    """Effects and the record of them as `sgns simulate` decides."""
    effects, decisions = effects_for(small())
    return {"effects": effects, "reasons": recorded(decisions)}


def restarted(kept, *overrides):
    """The restart of `sgns simulate continue_from=<kept> <overrides>`."""
    cfg = {"continue_from": str(kept), "solver": {"precision": "float32"}}
    found = OmegaConf.merge(cfg, OmegaConf.from_dotlist([o.lstrip("+") for o in overrides]))
    return restart_from(found, overrides)


@pytest.fixture
def stops(monkeypatch):
    """Solvers lose a particle after the frame LAST, unless they step at half the usual courant number."""
    whole = Solver._check

    def check(self, index):
        if index == LAST + 1 and self.scene.courant > 0.4:
            raise self._stopped(index, 7, 11, "the test stops it: lower scene.courant")
        whole(self, index)

    monkeypatch.setattr(Solver, "_check", check)


@pytest.fixture
def stopped(stops, tmp_path):
    """A stopped run's file, and the file that it was to become."""
    output = tmp_path / "run.h5"
    with pytest.raises(SolverStopped) as caught:
        simulate_scene(small(), output, **physics())
    assert f"sgns simulate continue_from={stopped_path(output)} output={output} scene.courant=0.3" in str(
        caught.value
    )
    return stopped_path(output), output


def test_the_frames_before_are_kept(stopped):
    kept, output = stopped
    assert kept.name == "run.stopped.h5"
    assert not output.exists()
    assert [p.name for p in kept.parent.iterdir()] == [kept.name]
    with Run(kept) as run:
        assert run.frame_count == LAST + 1
        assert "particle 51 at (" in run.stopped  # 11 of the half that is computed
        assert run.positions(0)[0].shape == (len(small().stored), 3)
        assert run.state.frame == LAST
    (problem,) = check_run(kept)
    assert problem.startswith("the run stopped after 4 good frames: particle 51 at (")
    done = sgns(kept.parent, "check", ".")
    assert done.returncode == 2 and f"run.stopped.h5: {problem}" in done.stdout


def test_going_on_with_half_the_step(stopped):
    kept, output = stopped
    done = sgns(kept.parent, "simulate", f"continue_from={kept}", "scene.courant=0.3", "output=run.h5")
    assert done.returncode == 0, done.stderr
    assert check_run(output) == []
    assert not kept.exists()  # it has served its purpose
    assert campaign_runs.is_done(output, small())  # a campaign takes it for its own
    reference = list(Solver(small(courant=0.3)).frames())
    with Run(output) as run:
        assert run.frame_count == small().frame_count
        assert run.scene == small().to_dict()
        assert run.extra["continued"] == [{"frame": LAST, "changed": {"courant": 0.3}}]
        assert run.stopped is None
        assert np.abs(run.positions(-1)[0] - reference[-1].position[small().stored]).max() < 1e-3


def test_a_run_that_goes_on_unchanged_is_the_undisturbed_one(stopped, monkeypatch, tmp_path):
    """Bit for bit, as a run file: the same content hash."""
    kept, _ = stopped
    monkeypatch.undo()
    simulate_scene(small(), tmp_path / "whole.h5", **physics())
    done = sgns(tmp_path, "simulate", f"continue_from={kept}", "output=rest.h5")
    assert done.returncode == 0, done.stderr
    with Run(tmp_path / "whole.h5") as one, Run(tmp_path / "rest.h5") as two:
        assert one.content_hash == two.content_hash
        assert two.extra["continued"] == [{"frame": LAST, "changed": {}}]


def test_it_may_stop_again(stopped, monkeypatch):
    """Then the frames of both are kept, and the file says so."""
    kept, output = stopped
    with Run(kept) as run:
        first = run.wall_time_s
    restart = restarted(kept, "scene.courant=0.3", f"output={output}")

    def check(self, index):
        if index == LAST + 2:
            raise self._stopped(index, 7, 11, "the test stops it again: raise scene.bed.headroom")

    monkeypatch.setattr(Solver, "_check", check)
    with pytest.raises(SolverStopped, match=r"stops it again.*scene.bed.headroom=0"):
        simulate_scene(restart.scene, output, effects=restart.effects, restart=restart)
    with Run(kept) as run:
        assert run.frame_count == LAST + 2
        assert "stops it again" in run.stopped
        assert run.extra["continued"] == [{"frame": LAST, "changed": {"courant": 0.3}}]
        took = run.wall_time_s
        assert run.state.frame == LAST + 1
    assert took > first  # the frames before the first stop included
    third = restarted(kept, "scene.bed.headroom=0.5")
    assert third.changes == {"courant": 0.3, "bed.headroom": 0.5}  # those of before as well
    assert third.changed_scene.courant == 0.3 and third.wall_time == took


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["scene.depth=0.03"], "leave out scene.depth"),
        (["scene=wheel"], "leave out scene"),
        (["scene.courant=2"], "scene.courant is 2"),
        (["dataset=quick"], "leave out dataset="),
    ],
)
def test_what_may_not_change(stopped, arguments, words):
    kept, output = stopped
    assert words in refusal(kept.parent, "simulate", f"continue_from={kept}", f"output={output}", *arguments)


def test_what_cannot_be_gone_on_with(tmp_path, stopped):
    kept, _ = stopped
    assert sgns(tmp_path, "simulate", *SHORT, "output=whole.h5").returncode == 0
    for name, words in (("whole.h5", "is a whole run"), ("none.h5", "no such run file")):
        assert words in refusal(tmp_path, "simulate", f"continue_from={name}")
    with h5py.File(kept, "r+") as file:
        file["state/log_volume"][0] = np.nan
    assert "log_volume is not finite" in refusal(tmp_path, "simulate", f"continue_from={kept}")
    with h5py.File(kept, "r+") as file:
        del file["state/position"]
        file["state/position"] = "text"
    with Run(kept) as run, pytest.raises(UserError, match="does not hold numbers"):
        _ = run.state
    with h5py.File(kept, "r+") as file:
        del file["state"]
    with Run(kept) as run, pytest.raises(UserError, match="holds no state to go on from"):
        _ = run.state


def test_a_bed_without_a_body_can_go_on(stops, tmp_path):
    scene = Scene(bed=Bed(size=(0.2, 0.2, 0.1), spacing=0.04), duration=0.1)
    with pytest.raises(SolverStopped, match="continue_from="):
        simulate_scene(scene, tmp_path / "bed.h5", effects=Effects())
    with Run(tmp_path / "bed.stopped.h5") as run:
        assert run.state.frame == LAST


# --- interrupted, and the same command again ------------------------------------------------------------


@pytest.fixture
def interrupted(monkeypatch):
    """A signal comes in the middle of the frame after LAST, once."""
    whole, left = Solver._check, [signal.SIGTERM]

    def check(self, index):
        if index == LAST and left:
            signal.raise_signal(left.pop())
        whole(self, index)

    monkeypatch.setattr(Solver, "_check", check)


FAST = small(start=0.3, depth=0.06, speed=1.0)
SEVERAL = small(
    others=(
        Other(tool=Sphere(diameter=0.1), position=(0.3, 0.1, 0.03), spin=(0.0, 5.0, 0.0)),
        Other(tool=Cylinder(diameter=0.1), motion="follow", position=(0.15, 0.0, 0.0), load=20.0),
    )
)
WHEEL = {"friction_angle": None, "damping": 0.0, "load": 20.0, "settle": 0.02}


@pytest.mark.parametrize(
    ("scene", "effects"),
    [
        (small(), Effects(symmetry=True)),
        (
            Wheel(bed=Bed(size=(0.4, 0.24, 0.08), spacing=0.04, headroom=0.1), duration=0.1, **WHEEL),
            Effects(),
        ),
        (small(), Effects(fluidity=True, nonlocality=True)),
        (FAST, Effects()),
        (SEVERAL, Effects()),
    ],
    ids=["cut", "wheel", "nonlocal fluidity", "loose soil", "further bodies"],
)
def test_an_interrupted_run_goes_on_to_the_same_bits(scene, effects, interrupted, tmp_path):
    output, same = tmp_path / "run.h5", {"effects": effects, "seed": 3, "precision": "float32"}
    with pytest.raises(Interrupted) as caught, heeded_signals():
        simulate_scene(scene, output, **same)
    kept = stopped_path(output)
    assert caught.value.said == f"{LAST + 1} of {scene.frame_count} frames are kept in {kept}"
    assert list(tmp_path.iterdir()) == [kept]
    with Run(kept) as run:
        assert run.stopped == "interrupted by SIGTERM"
        if scene is FAST:
            assert (run.state.arrays["log_volume"] > 0.0).any()
    simulate_scene(scene, output, **same, restart=unfinished(output, scene, **same))
    simulate_scene(scene, tmp_path / "whole.h5", **same)
    with Run(output) as one, Run(tmp_path / "whole.h5") as two:
        assert one.content_hash == two.content_hash
        assert two.frame_count == scene.frame_count
        assert two.other_pose.shape == (scene.frame_count, len(scene.others), 7)
        if scene.others:
            assert (two.other_force[:, :, 2].max(axis=0) > 0.0).all()
            assert two.other_torque[:, 0].any()
    assert check_run(output) == []
    assert not kept.exists()
    assert unfinished(output, scene, **same) is None


@pytest.mark.parametrize(
    ("name", "at", "value", "words"),
    [
        ("force", (1, 0, 2), np.nan, "other_force is not finite at frame 1"),
        ("pose", (2, 1, 3), 0.5, "a quaternion of the further bodies at frame 2 is not of length 1"),
    ],
)
def test_damaged_further_bodies_are_named(name, at, value, words, tmp_path):
    simulate_scene(SEVERAL, tmp_path / "run.h5", effects=Effects())
    with h5py.File(tmp_path / "run.h5", "a") as file:
        file[f"observables/others/{name}/value"][at] = value
    assert words in check_run(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5", "a") as file:
        del file["observables/others/pose"]
    with pytest.raises(UserError, match="dataset /observables/others/pose/value is missing"):
        Run(tmp_path / "run.h5")


def test_a_run_holds_the_meshes_of_further_bodies(tmp_path):
    """Where the file was is not looked at again."""
    file = write_obj(tmp_path / "rock.obj", box_corners((0.05, 0.06, 0.07)), BOX_FACES)
    rock, turn = MeshBody(file=str(file)), (0.0, 0.0, 0.0, 1.0)
    rows = ((0.0, 0.2, 0.1, 0.05, *turn), (0.1, 0.2, 0.1, 0.0, *turn))
    dropped = Other(tool=rock, position=(0.2, 0.05, 0.05), velocity=(0.0, 0.0, -1.0))
    scene = small(others=(SEVERAL.others[0], dropped, Other(tool=rock, motion="path", path=rows)))
    first, second = tmp_path / "first.h5", tmp_path / "second.h5"
    simulate_scene(scene, first, effects=Effects())
    file.unlink()
    with Run(first) as run:
        soil = run.soil
        assert np.abs(run.other_force[:, 2]).max() > 0.0
    simulate_scene(small(others=soil.scene.others[1:]).starting_from(soil), second, effects=Effects())
    for path, known in ((first, [None, None, rock.mesh, rock.mesh]), (second, [None, rock.mesh, rock.mesh])):
        assert check_run(path) == []
        with Run(path) as run:
            assert run.mesh is None and len(run.meshes) == len(known)
            for found, mesh in zip(run.meshes, known, strict=True):
                assert (found is None) == (mesh is None)
                for one, two in zip(found or (), mesh or (), strict=True):
                    np.testing.assert_array_equal(one, two)
    with h5py.File(first, "a") as content:
        content["parameters/others/1/vertices"][0, 0] = np.nan
        scene = yaml.safe_load(content.attrs["scene"])
        scene["others"][2]["tool"]["digest"] = ""
        content.attrs["scene"] = yaml.safe_dump(scene)
    problems = "; ".join(check_run(first))
    assert "the mesh of scene.others[1] is damaged (the mesh has a vertex that is not finite" in problems
    assert "its scene names a mesh file without the digest" in problems
    with h5py.File(second, "a") as content:
        del content["parameters/others/1/triangles"]
    with pytest.raises(UserError, match="dataset /parameters/others/1/triangles is missing"):
        Run(second)


def test_the_same_command_goes_on_and_another_is_refused_by_key(interrupted, tmp_path):
    done = sgns(tmp_path, "simulate", *SMALL, "output=run.h5")
    assert done.returncode == 128 + signal.SIGTERM
    frames = f"{LAST + 1} of 13 frames are kept in run.stopped.h5"
    assert done.stderr == f"sgns simulate: interrupted; {frames}; the same command goes on from there\n"
    for change, words in (
        ("scene.rake=7.5", "scene.rake is 10.0 there and 7.5 here"),
        ("material.grain_density=2700.0", "material.grain_density is 2583.0 there and 2700.0 here"),
        ("effects.nonlocality=true", "effects.nonlocality is False there and True here"),
        ("solver.precision=float64", "solver.precision is 'float32' there and 'float64' here"),
        ("seed=4", "seed is 0 there and 4 here"),
    ):
        line = refusal(tmp_path, "simulate", *SMALL, "output=run.h5", change)
        assert "run.stopped.h5 is an unfinished run of other settings: " in line and words in line, line
        assert "overwrite=true begins anew" in line
    shutil.copy(tmp_path / "run.stopped.h5", tmp_path / "anew.stopped.h5")
    anew = sgns(tmp_path, "simulate", *SMALL, "output=anew.h5", "seed=4", "overwrite=true")
    assert anew.returncode == 0 and "going on" not in anew.stdout
    again = sgns(tmp_path, "simulate", *SMALL, "output=run.h5")
    assert again.returncode == 0, again.stderr
    assert f"going on from frame {LAST} of run.stopped.h5" in again.stdout
    assert sgns(tmp_path, "simulate", *SMALL, "output=whole.h5").returncode == 0
    with Run(tmp_path / "run.h5") as one, Run(tmp_path / "whole.h5") as two:
        assert one.content_hash == two.content_hash


def test_an_interrupted_run_is_listed_as_unfinished_unless_it_cannot_go_on(interrupted, tmp_path):
    assert sgns(tmp_path, "simulate", *SMALL, "output=run.h5").returncode == 128 + signal.SIGTERM
    words = f"run.stopped.h5: unfinished: {LAST + 1} of 13 frames, good; the same `sgns simulate` goes on"
    found = sgns(tmp_path, "check", ".")
    assert found.returncode == 0 and words in found.stdout, found.stderr
    with h5py.File(tmp_path / "run.stopped.h5", "r+") as file:
        file["state"].attrs["frame"] = 1
    found = sgns(tmp_path, "check", ".")
    assert found.returncode == 2 and "4 frames but the state of frame 1; repeat the run" in found.stdout
    with h5py.File(tmp_path / "run.stopped.h5", "r+") as file:
        del file["state"]
    (problem,) = check_run(tmp_path / "run.stopped.h5")
    assert "holds no state to go on from" in problem


def test_an_interrupted_sweep_or_continuation_says_how_its_run_goes_on(interrupted, tmp_path):
    done = sgns(tmp_path, "simulate", *SMALL, "-m", "scene.rake=5.0", f"output={tmp_path}/run.h5")
    kept, output = tmp_path / "0/run.stopped.h5", tmp_path / "0/run.h5"
    way = f"sgns simulate continue_from={kept} output={output}"
    assert f"are kept in {kept}; {way} goes on from there; finished jobs stay in " in done.stderr
    assert done.stderr.endswith("the same sweep would begin anew in another folder\n")
    again = sgns(tmp_path, *way.split()[1:])
    assert again.returncode == 0 and check_run(output) == [], again.stderr


def test_of_runs_made_side_by_side_all_are_kept(interrupted, tmp_path):
    scenes, same = [small(), small(rake=5.0)], {"effects": Effects(), "seed": 0, "precision": "float32"}
    files = [tmp_path / "a.h5", tmp_path / "b.h5"]
    tasks = [scene_stages(scene, file, **same) for scene, file in zip(scenes, files, strict=True)]
    with pytest.raises(Interrupted), heeded_signals():
        list(run_concurrently(tasks, 2, "cpu"))
    assert sorted(tmp_path.iterdir()) == list(map(stopped_path, files))
    for scene, file in zip(scenes, files, strict=True):
        simulate_scene(scene, file, **same, restart=unfinished(file, scene, **same))
        simulate_scene(scene, tmp_path / "whole.h5", **same)
        with Run(file) as one, Run(tmp_path / "whole.h5") as two:
            assert one.extra["continued"] and one.content_hash == two.content_hash


def test_a_damaged_unfinished_run_is_refused(interrupted, tmp_path):
    assert sgns(tmp_path, "simulate", *SMALL, "output=run.h5").returncode == 128 + signal.SIGTERM
    with h5py.File(tmp_path / "run.stopped.h5", "r+") as file:
        del file["state"]
    line = refusal(tmp_path, "simulate", *SMALL, "output=run.h5")
    assert "holds no state to go on from" in line and "overwrite=true begins anew" in line


# --- Soil of another run --------------------------------------------------------------------------------


def test_a_run_starts_from_the_soil_of_another(tmp_path):
    assert sgns(tmp_path, "simulate", *SMALL, "scene.gravity=5.0", "output=one.h5").returncode == 0
    assert check_run(tmp_path / "one.h5") == []
    new = [
        "scene.blade={length: 0.1, width: 0.12, thickness: 0.08, edge: square}",
        "scene.rake=5",
        "scene.start=0.3",
    ]
    new += ["scene.duration=0.1"]
    done = sgns(tmp_path, "simulate", "start_from=one.h5@12", *new, "output=two.h5")
    assert done.returncode == 0, done.stderr
    assert check_run(tmp_path / "two.h5") == []
    with Run(tmp_path / "one.h5") as one, Run(tmp_path / "two.h5") as two:
        np.testing.assert_array_equal(one.positions(-1), two.positions(0))
        np.testing.assert_array_equal(one.velocities(-1), two.velocities(0))
        assert two.scene["bed"] == one.scene["bed"] and two.scene["gravity"] == 5.0
        assert two.extra["start_from"] == {"run": "one.h5@12", "soil": one.soil.digest}
        assert two.arrangement_hash != one.arrangement_hash
        # And from Python.
        scene = Scene.from_dict(two.scene)
        effects = Effects(**{effect.name: two.effects[effect.name]["on"] for effect in fields(Effects)})
        *_, last = Solver(scene, effects, start_from=one.soil).frames()
        np.testing.assert_array_equal(last.position, two.positions(-1)[0])
    third = sgns(
        tmp_path, "simulate", "start_from=two.h5", "scene=wheel", "scene.load=5.0", *ROLLS, "output=three.h5"
    )
    assert third.returncode == 0, third.stderr


ROLLS = ["scene.width=0.09", "scene.diameter=0.1", "scene.duration=0.1", "scene.settle=0.05"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["start_from=none.h5"], "no such run file: none.h5"),
        (
            ["start_from=one.h5@3"],
            "for its last frame only, number 12; for frame 3 simulate it again with scene.dur",
        ),
        (
            ["start_from=one.h5", "scene.bed.spacing=0.02"],
            "scene.bed.spacing is 0.02, but 0.04 in the run to start fr",
        ),
        (
            ["start_from=one.h5", "material.youngs_modulus=2e6"],
            "material.youngs_modulus is 2e+06, but 1e+06 in",
        ),
        (["start_from=one.h5", "scene=column"], "a scene of the kind column has a start of its own"),
        (["start_from=one.h5", "dataset=quick"], "start_from is for single runs"),
        (
            ["start_from=bad.h5"],
            "bad.h5: the soil to start from is not good: log_volume is not finite; repeat the run",
        ),
        (["start_from=old.h5"], "old.h5 holds no state to go on from"),
        (["start_from=shape.h5"], "velocity has shape (3, 3) and not"),
    ],
)
def test_soil_that_a_run_cannot_start_from(run_with_state, arguments, words):
    tool = [] if "scene=column" in arguments or "dataset=quick" in arguments else SMALL[2:]
    assert words in refusal(run_with_state, "simulate", *arguments, *tool)


@pytest.fixture(scope="module")
def run_with_state(tmp_path_factory):
    """A folder with a run and damaged copies of it."""
    folder = tmp_path_factory.mktemp("soil")
    assert sgns(folder, "simulate", *SMALL, "output=one.h5").returncode == 0
    for name in ("bad.h5", "old.h5", "shape.h5"):
        shutil.copy(folder / "one.h5", folder / name)
    with h5py.File(folder / "bad.h5", "r+") as file:
        file["state/log_volume"][5] = np.nan
    with h5py.File(folder / "old.h5", "r+") as file:
        del file["state"]
    with h5py.File(folder / "shape.h5", "r+") as file:
        del file["state/velocity"]
        file["state/velocity"] = np.zeros((3, 3))
    assert check_run(folder / "old.h5") == []  # nothing is wrong with it
    for name in ("bad.h5", "shape.h5"):
        (problem,) = check_run(folder / name)
        assert "the soil to start from is not good" in problem
    return folder


def test_an_interrupted_run_on_the_soil_of_another_goes_on_with_it(run_with_state, interrupted, tmp_path):
    for name in ("one.h5", "two.h5"):
        shutil.copy(run_with_state / "one.h5", tmp_path / name)
    with h5py.File(tmp_path / "two.h5", "r+") as file:
        file["state/position"][0, 2] += 1e-3
    command = ["simulate", "start_from=one.h5", "scene.duration=0.2", *SMALL[3:], "output=run.h5"]
    assert sgns(tmp_path, *command).returncode == 128 + signal.SIGTERM
    line = refusal(tmp_path, "simulate", "continue_from=run.stopped.h5")
    assert "run.stopped.h5 started from the soil of one.h5@12; give that, too: start_from=..." in line
    line = refusal(tmp_path, "simulate", "continue_from=run.stopped.h5", "start_from=two.h5")
    assert "did not start from the soil of start_from" in line
    assert "start_from is " in refusal(tmp_path, *command, "start_from=two.h5")
    shutil.copy(tmp_path / "run.stopped.h5", tmp_path / "other.stopped.h5")
    way = ["simulate", "continue_from=other.stopped.h5", "start_from=one.h5", "output=other.h5"]
    assert sgns(tmp_path, *way).returncode == 0
    assert sgns(tmp_path, *command).returncode == 0
    assert sgns(tmp_path, *command[:-1], "output=whole.h5").returncode == 0
    with (
        Run(tmp_path / "run.h5") as one,
        Run(tmp_path / "other.h5") as two,
        Run(tmp_path / "whole.h5") as three,
    ):
        assert one.content_hash == two.content_hash == three.content_hash


def pushed(file) -> Body:
    rows = tuple((t, 0.1 + 0.5 * t, 0.1, 0.03, 0.0, 0.0, 0.0, 1.0) for t in (0.0, 0.1))
    bed = Bed(size=(0.4, 0.2, 0.16), spacing=0.04)
    return Body(bed=bed, tool=MeshBody(file=str(file)), path=rows, duration=0.1)


@pytest.fixture
def stopped_mesh(stops, tmp_path):
    """A stopped run of a mesh whose file is gone, and the content of that file."""
    file = write_obj(tmp_path / "box.obj", box_corners((0.08, 0.09, 0.1)), BOX_FACES)
    with pytest.raises(SolverStopped):
        simulate_scene(pushed(file), tmp_path / "run.h5", effects=Effects())
    content = file.read_text()
    file.unlink()
    return tmp_path / "run.stopped.h5", content


def test_a_run_brings_its_mesh(stopped_mesh, tmp_path, monkeypatch):
    """Whatever lies where the run says that the mesh was, it is not looked at."""
    kept, _ = stopped_mesh
    (tmp_path / "box.obj").write_text("another's")

    def never(*_):
        raise AssertionError("a file is read because a run names it")

    monkeypatch.setattr(mesh_files, "read_bytes", never)
    with pytest.raises(UserError, match=r"brings its own tool; leave out scene\.tool\.file"):
        restarted(kept, "+scene.tool.file=box.obj")
    restart = restarted(kept, "scene.courant=0.3")
    simulate_scene(restart.scene, tmp_path / "run.h5", effects=restart.effects, restart=restart)
    assert check_run(tmp_path / "run.h5") == []
    with Run(tmp_path / "run.h5") as run:
        assert run.frame_count == restart.scene.frame_count
        np.testing.assert_array_equal(run.mesh[0], restart.scene.mesh[0])


def test_a_run_without_its_mesh_is_refused(stopped_mesh, tmp_path):
    kept, content = stopped_mesh
    with h5py.File(kept, "r+") as file:
        del file["parameters"]
    (tmp_path / "box.obj").write_text(content)  # where the run says it was
    with pytest.raises(
        UserError, match=r"scene\.tool is a mesh, which these data do not hold .* repeat the run"
    ):
        restarted(kept)


def test_a_run_cannot_ask_for_a_file(stopped_mesh):
    """A scene in a file without a digest would be one of a person, whose file is read."""
    kept, _ = stopped_mesh
    with h5py.File(kept, "r+") as file:
        scene = yaml.safe_load(file.attrs["scene"])
        scene["tool"].pop("digest")
        del file["parameters"]
        file.attrs["scene"] = yaml.safe_dump(scene)
    with pytest.raises(UserError, match="without the digest"):
        restarted(kept)
