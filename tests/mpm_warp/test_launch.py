"""Kernels in Warp's cache, launches for one scene or many, and the work that scenes ask of the device."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from mpm_warp import Effects, SceneError
from mpm_warp import launch as launch_module
from mpm_warp.kernels.contact import ContactLaw
from mpm_warp.kernels.grid import grid_step
from mpm_warp.kernels.transfer import transfer
from mpm_warp.launch import Executor, Job, Launch, Program, SceneKernel, find_device, load_kernel

# --- Kernels that are damaged in Warp's cache -----------------------------------------------------------


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


# --- One function over one scene's items and over those of many, and programs of such kernels -----------


@wp.struct
class Pair:
    to: wp.array(dtype=float)
    factor: float


def kernels():
    @SceneKernel
    def add(i: int, pair: Pair, given: wp.array(dtype=float)):
        if i >= given.shape[0]:
            return
        pair.to[i] = pair.to[i] + pair.factor * given[i]

    @SceneKernel
    def double(i: int, to: wp.array(dtype=float)):
        to[i] = 2.0 * to[i]

    return add, double


def scene(add, double, factor, numbers):
    """Add `factor` times the numbers, double, add so many times, double."""
    device, pair = find_device("cpu"), Pair()
    pair.to, pair.factor = wp.zeros(len(numbers), dtype=float, device=device), factor
    given = wp.array(numbers, dtype=float, device=device)
    adds = Launch(add, len(numbers), [pair, given], device)
    doubles = Launch(double, len(numbers), [pair.to], device)
    return pair.to, Program([adds, doubles], [adds], [doubles])


def test_programs_together_are_the_programs_alone():
    """Of different sizes, numbers and steps."""
    device, both = find_device("cpu"), kernels()
    cases = [(1.0, [1.0, 2.0, 3.0], 2), (-0.5, [4.0], 5), (3.0, [1.0, 0.1], 1)]
    alone, together = ([scene(*both, *case[:2]) for case in cases] for _ in range(2))
    for (_, program), (*_, steps) in zip(alone, cases, strict=True):
        Executor(device).run([Job(program, steps)])
    Executor(device).run([Job(p, steps) for (_, p), (*_, steps) in zip(together, cases, strict=True)])
    for (one, _), (two, _), (factor, numbers, steps) in zip(alone, together, cases, strict=True):
        np.testing.assert_array_equal(one.numpy(), two.numpy())
        np.testing.assert_allclose(two.numpy(), 2.0 * (2 + steps) * factor * np.array(numbers), rtol=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_jobs_without_steps_load_the_kernels_only(count):
    both = kernels()
    found = [scene(*both, 1.0, [1.0, 2.0]) for _ in range(count)]
    Executor(find_device("cpu")).run([Job(program, 0) for _, program in found])
    assert all(not to.numpy().any() for to, _ in found)


def test_those_who_have_no_steps_to_do_wait():
    both, executor = kernels(), Executor(find_device("cpu"))
    (one, first), (two, second) = (scene(*both, 1.0, [1.0]) for _ in range(2))
    for steps, wanted in (((1, 0), (6.0, 0.0)), ((0, 2), (6.0, 8.0))):
        executor.run([Job(first, steps[0]), Job(second, steps[1])])
        assert (one.numpy()[0], two.numpy()[0]) == wanted


def test_programs_of_other_kernels_are_done_apart():
    add, double = kernels()
    to, first = scene(add, double, 1.0, [1.0])
    jobs = [Job(first, 1), Job(Program([Launch(double, 1, [to], find_device("cpu"))]), 1)]
    Executor(find_device("cpu")).run(jobs)
    assert to.numpy()[0] == 12.0
    assert [job.shared_by for job in jobs] == [2, 2]


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
    assert len(list(tmp_path.glob("*.ptx"))) == len(kernels) == 7
