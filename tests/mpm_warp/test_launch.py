"""Kernels in Warp's cache, damaged ones as well, and that they compile for a GPU."""

import os
import shutil
import subprocess
import sys

import pytest
import warp as wp

from mpm_warp import Effects, SceneError
from mpm_warp import launch as launch_module
from mpm_warp.kernels.contact import ContactLaw
from mpm_warp.kernels.grid import grid_step
from mpm_warp.kernels.transfer import transfer
from mpm_warp.launch import find_device, load_kernel


@pytest.fixture
def cached(tmp_path, monkeypatch):
    """A kernel that was compiled into a cache of its own, and is forgotten; its folder there."""
    device = find_device("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    @wp.kernel(module="unique", enable_backward=False)
    def add_one(x: wp.array(dtype=float)):
        i = wp.tid()
        x[i] = x[i] + 1.0

    add_one.module.unload()  # a test before has made the same
    load_kernel(add_one, device)
    add_one.module.unload()
    (folder,) = tmp_path.iterdir()
    return add_one, device, folder


def assert_works(kernel, device):
    x = wp.zeros(3, dtype=float, device=device)
    wp.launch(kernel, 3, [x], device=device)
    assert (x.numpy() == 1.0).all()


@pytest.mark.parametrize(("ending", "share"), [(".o", 0.5), (".o", 0.0), (".meta", 0.5), (".meta", 0.0)])
def test_what_is_cut_short_is_compiled_again(cached, capfd, ending, share):
    kernel, device, folder = cached
    (file,) = folder.glob(f"*{ending}")
    whole = file.stat().st_size
    os.truncate(file, int(share * whole))
    load_kernel(kernel, device)
    assert_works(kernel, device)
    assert file.stat().st_size == whole
    assert list(folder.parent.iterdir()) == [folder]
    assert capfd.readouterr() == ("", "")


def test_what_is_no_folder_is_compiled_again(cached):
    """As where a folder cannot be read: nothing can be put into it."""
    kernel, device, folder = cached
    shutil.rmtree(folder)
    folder.write_bytes(b"")
    load_kernel(kernel, device)
    assert_works(kernel, device)
    assert folder.is_dir()


@pytest.mark.parametrize(
    ("cache", "error", "words"),
    [
        (".", SceneError, r"^the kernel .*add_one in .* \(no compiler\); remove .*$"),  # damaged, and again
        ("empty", RuntimeError, "^no compiler"),
    ],
)
def test_what_does_not_compile_is_said(cached, monkeypatch, cache, error, words):
    kernel, device, folder = cached
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder.parent / cache))

    def fails(*_, **__):
        raise RuntimeError("no compiler\nand more")

    monkeypatch.setattr(launch_module.wp, "load_module", fails)
    with pytest.raises(error, match=words):
        load_kernel(kernel, device)


def test_a_cache_that_cannot_be_written_is_one_line(cached, monkeypatch):
    kernel, device, folder = cached
    (folder.parent / "file").write_bytes(b"")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder.parent / "file"))
    with pytest.raises(SceneError, match=r"compiled kernels, .*file, cannot be used .* WARP_CACHE_PATH"):
        load_kernel(kernel, device)


def test_no_place_for_a_cache_is_one_line(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    code = (
        "from mpm_warp.launch import find_device\ntry: find_device('cpu')\nexcept ValueError as e: print(e)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file")},
        capture_output=True,
        text=True,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    assert "cannot make its folder" in line and "WARP_CACHE_PATH" in line
    assert done.stderr == ""


def test_a_user_without_a_home_is_one_line(tmp_path):
    """As one of a container whom its system does not know."""
    code = (
        "import os, pwd\nfrom mpm_warp.launch import find_device\npwd.getpwuid = {}.__getitem__\n"
        "try: find_device('cpu')\nexcept ValueError as e: print(e)"
    )
    names = ("HOME", "XDG_CACHE_HOME", "WARP_CACHE_PATH")
    variables = {name: value for name, value in os.environ.items() if name not in names}
    command, captured = [sys.executable, "-c", code], {"capture_output": True, "text": True}
    done = subprocess.run(command, cwd=tmp_path, env=variables, **captured)
    (line,) = done.stdout.splitlines()
    assert "has no home folder" in line and "WARP_CACHE_PATH" in line, done
    assert list(tmp_path.iterdir()) == []


def test_kernels_compile_for_a_gpu(tmp_path):
    """Also where there is none: Warp brings CUDA's compiler."""
    find_device("cpu")
    if not (targets := wp.get_cuda_supported_archs()):
        pytest.skip("this Warp was built without CUDA")
    everything = Effects(fluidity=True, nonlocality=True)
    particles = transfer(wp.float32, everything, ContactLaw(free=True), atomic=True)
    nodes = grid_step(wp.float32, ("no_slip",) * 3)
    kernels = [*vars(particles).values(), *vars(nodes).values()]
    for kernel in kernels:
        wp.compile_aot_module(kernel.together.module, arch=targets[0], module_dir=tmp_path, use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == len(kernels) == 8
