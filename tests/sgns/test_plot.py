"""`sgns plot` and `sgns render`: pictures of a run."""

import subprocess
import sys

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image

from mpm_warp import Bed, Box, Effects, MeshBody, Other, Scene, Sphere
from sgns import plot
from sgns.config import UserError
from sgns.data.run import Run
from sgns.evaluate import views
from sgns.evaluate.body_shape import bodies, body_silhouette
from sgns.evaluate.figures import DPI, PICTURE_WIDTH
from sgns.simulate.run import simulate_scene
from sgns_testing.commands import sgns
from sgns_testing.meshes import BOX_FACES, box_corners, write_obj
from sgns_testing.runs import make_run

WHEEL = {"blade": None, "kind": "wheel", "diameter": 0.15, "width": 0.08}


@pytest.fixture
def run_file(tmp_path):
    return make_run(tmp_path / "run.h5", frames=14, n=300)


def settings(file, **values):
    return OmegaConf.create({"run": str(file), "output": None, "overwrite": False} | values)


@pytest.mark.parametrize(
    ("scene", "frames"),
    [({}, 1), (WHEEL, 1), ({}, 2), (WHEEL, 14), ({"blade": None, "kind": "body"}, 14)],
    ids=str,
)
def test_a_page_of_every_kind_of_run(tmp_path, scene, frames):
    file = make_run(tmp_path / "run.h5", frames=frames, n=300, scene=scene, producer="rollout")
    plot.main(settings(file))
    with Image.open(tmp_path / "run.png") as picture:
        assert picture.width == round(2 * PICTURE_WIDTH * DPI) and picture.height < 2 * picture.width
        assert np.asarray(picture).std() > 20.0


def test_panels_show_units_and_the_sinkage_of_a_wheel(tmp_path):
    with Run(make_run(tmp_path / "run.h5", n=100, scene=WHEEL)) as run:
        labels = [panel.label for panel in plot.curves(run)]
    assert labels[0] == "drawbar pull Fx [N]" and labels[-1] == "sinkage [mm]"
    assert all(label.endswith("]") for label in labels)


def test_a_turned_wheel_has_the_forces_and_the_torque_of_its_own_axes(tmp_path):
    with Run(make_run(tmp_path / "run.h5", n=100, scene=WHEEL | {"slip_angle": 30.0})) as run:
        panels = {panel.label.split("\n")[0]: panel for panel in plot.curves(run)}
        table = run.forces()
    for name, column in (("drawbar pull", "pull"), ("lateral force", "lateral"), ("drive torque", "drive")):
        assert panels[name].curves[0].values == pytest.approx(table[column].to_numpy())
    assert panels["lateral force"].label == "lateral force\n(along axle) [N]"


def test_all_bodies_are_drawn_where_they_are(tmp_path, monkeypatch):
    turn = (0.0, 0.0, 0.0, 1.0)
    rock = MeshBody(file=str(write_obj(tmp_path / "rock.obj", box_corners((0.05, 0.06, 0.07)), BOX_FACES)))
    others = (
        Other(tool=rock, motion="path", path=((0.0, 0.1, 0.1, 0.1, *turn), (0.1, 0.3, 0.1, 0.05, *turn))),
        Other(tool=Sphere(diameter=0.1), position=(0.2, 0.1, 0.045)),
        Other(tool=Box(size=(0.06, 0.04, 0.05)), position=(0.3, 0.1, 0.2)),
    )
    scene = Scene(bed=Bed(size=(0.4, 0.2, 0.16), spacing=0.04), duration=0.1, frame_rate=100.0, others=others)
    simulate_scene(scene, tmp_path / "run.h5", effects=Effects())
    with Run(tmp_path / "run.h5") as run:
        own, *further = bodies(run)
        assert own is run and body_silhouette(run, 0) == []
        for body, size in zip(further, ((0.05, 0.07), (0.1, 0.1), (0.06, 0.05)), strict=True):
            for frame in (0, 10):
                outline = np.concatenate(body_silhouette(body, frame))
                assert np.ptp(outline, axis=0) == pytest.approx(size, rel=0.01)
                middle = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
                assert middle == pytest.approx(body.pose[frame, [0, 2]], abs=1e-3)
        panels = {panel.label: panel.curves for panel in plot.curves(run)}
        assert [curve.label for curve in panels["vertical Fz [N]"]] == ["others[0]", "others[1]", "others[2]"]
        assert [curve.label for curve in panels["z of centre [mm]"]] == ["others[1]", "others[2]"]
        assert panels["z of centre [mm]"][1].values == pytest.approx(1e3 * run.other_pose[:, 2, 2])
        drawn, whole = [], views.draw_body
        for module in (views, plot):
            monkeypatch.setattr(
                module, "draw_body", lambda *given, **kw: drawn.append(given) or whole(*given, **kw)
            )
        plot.run_page(run)
        assert len(drawn) == 4 * 4  # three side views and the map; a mesh is seen from the side, and cut
        plot.moving_picture({"run": run}, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == 3


def test_a_moving_picture_plays_in_real_time(run_file, tmp_path):
    plot.render(settings(run_file, output=str(tmp_path / "new.gif")))
    with Image.open(tmp_path / "new.gif") as picture:
        assert picture.n_frames == 5 and picture.info["duration"] == 50  # every third frame of 1/60 s


def test_a_moving_picture_is_a_video_too(run_file, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    plot.render(settings(run_file, output=str(tmp_path / "new.mp4")))
    read = [ffmpeg.get_ffmpeg_exe(), "-i", tmp_path / "new.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(read, capture_output=True, check=True)
    assert b"h264" in done.stderr and b", 20 fps" in done.stderr
    shown = np.frombuffer(done.stdout, np.uint8).reshape(5, -1, 680, 3)
    assert shown[0].std() > 20.0 and (shown[0] != shown[-1]).any()


def test_a_video_without_its_library_is_refused_before_it_is_drawn(run_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(plot, "drawn_frames", None)
    with pytest.raises(UserError, match=r"pip install 'sgns\[video\]', or choose a \.gif"):
        plot.render(settings(run_file, output=str(tmp_path / "new.mp4")))
    assert not (tmp_path / "new.mp4").exists()


def test_a_still_picture_of_the_last_moment_of_work(run_file, tmp_path):
    plot.render(settings(run_file, output=str(tmp_path / "new.PNG")))
    with Image.open(tmp_path / "new.PNG") as picture:
        assert picture.format == "PNG" and picture.width == 1360 and np.asarray(picture).std() > 20.0


def test_a_long_run_gives_a_bounded_number_of_pictures(run_file, tmp_path, monkeypatch):
    monkeypatch.setattr(plot, "MOST_PICTURES", 4)
    monkeypatch.setattr(plot, "LONGEST", 0.02)
    with Run(run_file) as run:
        assert plot.moving_picture({"run": run}, tmp_path / "a.gif") == pytest.approx(4 / 60 / 0.02)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == 4


def test_a_moving_picture_leaves_out_pictures_to_be_small(tmp_path, monkeypatch):
    noise = [Image.effect_noise((60, 40), 90.0) for _ in range(16)]
    plot.write_gif(noise, tmp_path / "all.gif", 50)
    monkeypatch.setattr(plot, "MOST_BYTES", (tmp_path / "all.gif").stat().st_size // 3)
    plot.write_gif(noise, tmp_path / "some.gif", 50)
    with Image.open(tmp_path / "some.gif") as picture:
        assert picture.n_frames == 4 and picture.info["duration"] == 200
    assert (tmp_path / "some.gif").stat().st_size <= plot.MOST_BYTES


@pytest.mark.parametrize(("command", "suffix"), [(plot.main, "png"), (plot.render, "gif")])
def test_a_picture_is_replaced_only_if_asked(run_file, command, suffix):
    picture = run_file.with_suffix(f".{suffix}")
    picture.write_text("mine")
    with pytest.raises(UserError, match=r"there already; .* overwrite=true"):
        command(settings(run_file))
    assert picture.read_text() == "mine"
    command(settings(run_file, overwrite=True))
    with pytest.raises(UserError, match=rf"a \.{suffix} file: output=x\.{suffix}"):
        command(settings(run_file, output="x.jpg"))
    with pytest.raises(UserError):
        command(settings("."))


@pytest.mark.parametrize("command", [plot.main, plot.render])
def test_a_run_that_is_not_finite_is_refused(tmp_path, command):
    import h5py

    file = make_run(tmp_path / "run.h5", n=100)
    with h5py.File(file, "r+") as content:
        content["particles/soil/position/value"][0, 3] = np.nan
    with pytest.raises(UserError, match=r"frame 0 is not finite; `sgns check"):
        command(settings(file))


def test_the_commands_take_plain_paths(run_file, tmp_path):
    done: subprocess.CompletedProcess = sgns(tmp_path, "plot", "run.h5", "a b.png")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a b.png").is_file()
    done = sgns(tmp_path, "render", "run.h5", "a.gif", "c")
    assert (
        done.returncode == 2 and "'c' is one path too many: sgns render takes run and output" in done.stderr
    )
