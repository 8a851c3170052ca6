"""`sgns import`: runs of other simulators are checked, turned to our axes and units, and can be trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.simulator import Simulator
from sgns_testing.commands import TRAIN, refusal, sgns
from sgns_testing.meshes import box_corners, box_triangles, write_stl
from sgns_testing.runs import body_grid, make_run


@pytest.fixture(scope="module")
def arrays(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """What another simulator wrote."""
    with Run(make_run(tmp_path_factory.mktemp("foreign") / "run.h5", n=400)) as run:
        found = {name: getattr(run, name) for name in ("time", "pose", "force", "torque")}
        return found | {"position": run.positions().astype(float), "body_points": body_grid(15)}


def imported(folder: Path, arrays: dict[str, Any], *settings: str, source: str = "a.npz") -> Run:
    """The run file that the command makes of arrays."""
    np.savez(folder / source, **arrays)
    done = sgns(folder, "import", source, "run.h5", "overwrite=true", *settings)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert check_run(folder / "run.h5") == []
    return Run(folder / "run.h5")


def test_arrays_become_a_run(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    with imported(tmp_path, arrays | {"load": 50.0}) as run:
        assert (run.producer, run.frame_rate) == ("imported", pytest.approx(60.0))
        assert np.array_equal(run.positions(), arrays["position"].astype("f4"))
        for name in ("pose", "force", "torque"):
            assert getattr(run, name) == pytest.approx(arrays[name])
        assert run.velocities(3)[0] == pytest.approx(
            60.0 * (run.positions(3)[0] - run.positions(2)[0]), abs=1e-4
        )
        assert run.scene["load"] == 50.0 and run.scene["kind"] == "imported"
        assert run.surface().z.size > 1  # its bin lies as ours do
    assert sgns(tmp_path, "plot", "run.h5").returncode == 0


def test_axes_units_and_order_of_another_simulator(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    upright = Rotation.from_euler("x", 90, degrees=True)  # their y, upwards, to our z
    theirs = upright.inv()
    pose, origin = arrays["pose"], np.array([7.0, -3.0, 11.0])
    turned = (theirs * Rotation.from_quat(pose[:, 3:])).as_quat()
    place = 1e3 * theirs.apply(pose[:, :3]) + origin
    given = {
        "x": 1e3 * theirs.apply(arrays["position"].reshape(-1, 3)).reshape(arrays["position"].shape) + origin,
        "pose": np.hstack([place, turned[:, [3, 0, 1, 2]]]),
        "force": theirs.apply(arrays["force"]),
        "torque": theirs.apply(arrays["torque"]),
        "body_points": 1e3 * arrays["body_points"],
    }
    words = ("unit=mm", "up=y", "quaternion=wxyz", "origin=[7,-3,11]", "names.position=x", "frame_rate=60")
    with imported(tmp_path, given, *words) as run, imported(tmp_path, arrays, source="b.npz") as ours:
        assert run.positions() == pytest.approx(ours.positions(), abs=1e-6)
        assert run.body_points == pytest.approx(ours.body_points)
        assert run.force == pytest.approx(ours.force) and run.torque == pytest.approx(ours.torque)


def test_hdf5_with_paths_and_particles_in_changing_order(
    arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    frames, n, _ = arrays["position"].shape
    order = np.argsort(np.random.default_rng(0).random((frames, n)), axis=1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["soil/x"] = np.take_along_axis(arrays["position"], order[..., None], axis=1)
        file["soil/number"] = order
        file.attrs["frame_rate"] = 60.0
        for name in ("pose", "force", "body_points"):
            file[name] = arrays[name]
    done = sgns(tmp_path, "import", "a.h5", "run.h5", "names.position=soil/x", "names.id=soil/number")
    assert (done.returncode, done.stderr) == (0, "")
    with Run(tmp_path / "run.h5") as run:
        assert np.array_equal(run.positions(), arrays["position"].astype("f4")) and not run.torque.any()


def test_a_mesh_has_its_pose_and_torque_moved_to_the_centre_of_mass(
    arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    corner = np.array([0.1, 0.2, 0.3])
    write_stl(tmp_path / "tool.stl", box_corners((0.1, 0.1, 0.08), corner), box_triangles())
    given = {name: values for name, values in arrays.items() if name != "body_points"}
    with imported(tmp_path, given, "tool=tool.stl") as run:
        centre = corner + np.array([0.05, 0.05, 0.04])
        arm = Rotation.from_quat(arrays["pose"][:, 3:]).apply(np.tile(centre, (len(arrays["pose"]), 1)))
        assert run.pose[:, :3] == pytest.approx(arrays["pose"][:, :3] + arm)
        assert run.torque == pytest.approx(arrays["torque"] - np.cross(arm, arrays["force"]))
        assert run.mesh is not None and run.mesh[0].shape == (8, 3) and run.body_point_count == 8
        assert run.extra["centre"] == pytest.approx(centre)
    done = sgns(tmp_path, "convert", "run.h5", "again.npz")  # and what is exported comes back
    assert done.returncode == 0 and sgns(tmp_path, "import", "again.npz", "again.h5").returncode == 0
    with Run(tmp_path / "again.h5") as again, Run(tmp_path / "run.h5") as run:
        assert again.pose == pytest.approx(run.pose)
        assert again.body_points.mean(axis=1) == pytest.approx(run.body_points.mean(axis=1))


def test_a_folder_of_vtk_files_and_a_table(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    pytest.importorskip("vtkmodules", reason="vtk is not installed")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    folder = tmp_path / "case"
    folder.mkdir()
    for frame, soil in enumerate(arrays["position"]):
        points, data, writer = vtkPoints(), vtkPolyData(), vtkXMLPolyDataWriter()
        points.SetData(numpy_to_vtk(soil, deep=True))
        data.SetPoints(points)
        writer.SetFileName(str(folder / f"soil_{frame}.vtp"))
        writer.SetInputData(data)
        writer.Write()
    np.savez(folder / "tool.npz", body_points=arrays["body_points"])
    header = "t,x,y,z,qx,qy,qz,qw,Fx,Fy,Fz"
    table = np.hstack([arrays["time"][:, None], arrays["pose"], arrays["force"]])
    np.savetxt(folder / "tool.csv", table, delimiter=",", header=header, comments="")
    done = sgns(tmp_path, "import", "case", "run.h5")
    assert (done.returncode, done.stderr) == (0, "")
    with Run(tmp_path / "run.h5") as run:
        assert run.positions() == pytest.approx(arrays["position"], abs=1e-6)  # frame 2 before frame 10
        assert run.force == pytest.approx(arrays["force"])
    (folder / "soil_0.vtp").rename(folder / "other_0.vtp")
    assert "names.position='other_*.vtp'" in refusal(tmp_path, "import", "case", "b.h5")


def changed(name: str, index: Any, value: float) -> Any:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name][index] = value

    return change


def without(name: str) -> Any:
    return lambda arrays: arrays.pop(name)


WRONG = [
    (without("force"), "has no force; it has"),
    (without("body_points"), "no body_points and no mesh"),
    (without("time"), "no time (T,) and no frame_rate; give frame_rate=60"),
    (lambda arrays: arrays.update(frame_rate=0.0), "frame_rate is 0 Hz; it must be a number above 0"),
    (
        lambda arrays: arrays.update(vertices=np.eye(3), triangles=np.zeros((0, 3), int)),
        "triangles has shape (0, 3); it needs three whole numbers in each row",
    ),
    (changed("position", (3, 5, 2), np.nan), "position is not finite at index (3, 5, 2)"),
    (changed("time", 4, 1.0), "time before frame 4 advances by"),
    (changed("pose", (2, 6), 5.0), "quaternion of frame 2 has length"),
    (lambda arrays: arrays.update(force=arrays["force"].T), "force has shape (3, 12); expected (12, 3)"),
    (lambda arrays: arrays.update(position=arrays["position"][0]), "it must be (T, n, 3): frames, particles"),
    (lambda arrays: arrays.update(pose=np.array(["a"] * 12)), "pose holds no numbers"),
    (lambda arrays: arrays.update(id=np.zeros((12, 400), int)), "not those of frame 0, each once"),
    (
        lambda arrays: arrays.update(body_points=np.random.default_rng(0).random((12, 4, 3))),
        "from where the pose puts it",
    ),
    (lambda arrays: arrays.clear(), "holds none of position, velocity"),
]


@pytest.mark.parametrize(("change", "words"), WRONG, ids=[words for _, words in WRONG])
def test_what_is_no_run_is_refused(
    arrays: dict[str, np.ndarray], tmp_path: Path, change: Any, words: str
) -> None:
    given = dict(arrays)
    change(given)
    np.savez(tmp_path / "a.npz", **given)
    assert words in refusal(tmp_path, "import", "a.npz", "run.h5")


DOUBTS = [
    (lambda arrays: arrays.update(force=-arrays["force"]), "is it by the soil on the tool?"),
    (lambda arrays: arrays.update(force=0 * arrays["force"]), "the force is 0 in all frames"),
    (lambda arrays: arrays.update(position=1e-3 * arrays["position"] - 9.0), "never nearer to the soil than"),
    (lambda arrays: arrays["position"][5].sort(axis=0), "in the same order in all frames?"),
]


@pytest.mark.parametrize(("change", "words"), DOUBTS, ids=[words for _, words in DOUBTS])
def test_what_looks_odd_is_told(
    arrays: dict[str, np.ndarray], tmp_path: Path, change: Any, words: str
) -> None:
    given = {name: values.copy() for name, values in arrays.items()}
    change(given)
    np.savez(tmp_path / "a.npz", **given)
    done = sgns(tmp_path, "import", "a.npz", "run.h5")
    lines = [line for line in done.stdout.splitlines() if line.startswith("warning: a.npz: ")]
    assert done.returncode == 0 and len(lines) == 1 and words in lines[0], done


@pytest.mark.parametrize("judged", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_dataset_of_imported_runs_is_trained_on(tmp_path: Path, judged: bool) -> None:
    for seed in range(5):
        with Run(make_run(tmp_path / "own.h5", n=60, seed=seed)) as run:
            given = {name: getattr(run, name) for name in ("time", "pose", "force", "torque")}
            np.savez(
                tmp_path / f"cut_{seed}.npz",
                position=run.positions(),
                body_points=body_grid(15),
                load=float(seed),
                **given,
            )
    done = sgns(tmp_path, "import", "cut_*.npz", "data")
    assert done.returncode == 0, done.stderr
    assert "data: 5 runs (3 train, 1 validation, 1 test)" in done.stdout
    assert done.stdout.endswith(
        "next: sgns train dataset=imported dataset.path=data output=outputs/imported\n"
    )
    where = ("dataset=imported", "dataset.path=data")
    done = sgns(tmp_path, "train", *where, *TRAIN, "output=out")
    assert done.returncode == 0, done.stderr
    assert "sgns rollout" not in done.stdout  # whose scenes have beds of ours
    rollout = ("rollout", "checkpoint=out/best.ckpt", "output=new.h5")
    assert "trained on imported runs, which no scene describes" in refusal(tmp_path, *rollout)
    simulator = Simulator.load(tmp_path / "out" / "best.ckpt")
    assert simulator.context_keys == ("load",)
    with Run(next((tmp_path / "data" / "runs").glob("*.h5"))) as run:
        answer = simulator.rollout(run.pose, values=run.scene)
        assert answer.soil().shape == (60, 3) and simulator.arrangement_hash == run.arrangement_hash
    if judged:
        done = sgns(tmp_path, "evaluate", *where, "checkpoint=out/best.ckpt", "output=report")
        assert done.returncode == 0, done.stderr
    assert "is there already" in refusal(tmp_path, "import", "cut_*.npz", "data")


def test_runs_of_a_dataset_start_alike(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    np.savez(tmp_path / "b.npz", **arrays | {"position": arrays["position"] + [0.05, 0.0, 0.0]})
    done = sgns(tmp_path, "import", "a.npz", "b.npz", "data")
    assert done.returncode == 2 and "begins 0.05 m from where it begins in the first run" in done.stderr
    assert "one run, and there are 2 sources" in refusal(tmp_path, "import", "a.npz", "b.npz", "run.h5")
    assert "no file or folder c_*.npz" in refusal(tmp_path, "import", "c_*.npz", "run.h5")
