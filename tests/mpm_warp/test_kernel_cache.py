"""Kernels that are damaged in Warp's cache."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import warp as wp

from mpm_warp import SceneError
from mpm_warp import kernel_cache as kernel_cache_module
from mpm_warp.kernel_cache import load_kernel
from mpm_warp.start import find_device


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


def works(kernel, device) -> bool:
    x = wp.zeros(3, dtype=float, device=device)
    wp.launch(kernel, 3, [x], device=device)
    return bool((x.numpy() == 1.0).all())


@pytest.mark.parametrize(("ending", "share"), [(".o", 0.5), (".o", 0.0), (".meta", 0.5), (".meta", 0.0)])
def test_what_is_cut_short_is_compiled_again(cached, capfd, ending, share):
    kernel, device, folder = cached
    (file,) = folder.glob(f"*{ending}")
    whole = file.stat().st_size
    os.truncate(file, int(share * whole))
    load_kernel(kernel, device)
    assert works(kernel, device)
    assert file.stat().st_size == whole
    assert list(folder.parent.iterdir()) == [folder]
    assert capfd.readouterr() == ("", "")


def test_what_is_no_folder_is_compiled_again(cached):
    """As where a folder cannot be read: nothing can be put into it."""
    kernel, device, folder = cached
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    folder.write_bytes(b"")
    load_kernel(kernel, device)
    assert works(kernel, device)
    assert folder.is_dir()


def test_what_does_not_load_twice_is_one_line(cached, monkeypatch):
    kernel, device, _ = cached

    def fails(*_, **__):
        raise Exception("Failed to load CPU module\nand more")

    monkeypatch.setattr(kernel_cache_module.wp, "load_module", fails)
    with pytest.raises(SceneError, match=r"add_one in .* \(Failed to load CPU module\); remove") as caught:
        load_kernel(kernel, device)
    assert "\n" not in str(caught.value)


def test_a_compiler_that_fails_is_no_damage(cached, monkeypatch):
    kernel, device, folder = cached
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder.parent / "empty"))

    def fails(*_, **__):
        raise RuntimeError("no compiler")

    monkeypatch.setattr(kernel_cache_module.wp, "load_module", fails)
    with pytest.raises(RuntimeError, match="no compiler"):
        load_kernel(kernel, device)


def test_a_cache_that_cannot_be_written_is_one_line(cached, monkeypatch):
    kernel, device, folder = cached
    (folder.parent / "file").write_bytes(b"")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder.parent / "file"))
    with pytest.raises(SceneError, match=r"compiled kernels, .*file, cannot be used .* WARP_CACHE_PATH"):
        load_kernel(kernel, device)


def test_no_place_for_a_cache_is_one_line(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    code = "from mpm_warp.start import find_device\ntry: find_device('cpu')\nexcept ValueError as e: print(e)"
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
