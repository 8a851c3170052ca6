"""Cores and memory that a process may use, where the system or a container says less than all."""

import math
import os

import pytest

from mpm_warp import Bed, Scene, SceneError, Solver, limits
from mpm_warp.limits import usable_cores, usable_memory

GB = 10**9


@pytest.fixture
def in_container(tmp_path, monkeypatch):
    """Lets control groups be what is given: the lines of /proc/self/cgroup, and files below /sys/fs/cgroup."""
    monkeypatch.setattr(limits, "ROOT", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 4_000_000}[name])

    def place(lines: str, **files: str) -> None:
        for name, text in {
            "proc/self/cgroup": lines,
            **{f"sys/fs/cgroup/{n}": t for n, t in files.items()},
        }.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)

    return place


def test_without_control_groups_the_machine_is_all(in_container):
    assert usable_cores() == 8
    assert usable_memory() == 4096 * 4_000_000


@pytest.mark.parametrize(
    ("lines", "files", "cores", "memory"),
    [
        ("0::/\n", {"cpu.max": "150000 100000\n", "memory.max": f"{GB}\n"}, 2, GB),
        ("0::/\n", {"cpu.max": "max 100000\n", "memory.max": "max\n"}, 8, None),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000\n", "a/b/cpu.max": "max 100000\n"}, 3, None),
        ("0::/a/b\n", {"a/memory.max": f"{GB}\n", "a/b/memory.max": f"{2 * GB}\n"}, 8, GB),
        ("0::/../c\n", {"cpu.max": "20000 100000\n"}, 1, None),
        (
            "5:cpu,cpuacct:/docker/x\n3:memory:/docker/x\n0::/\n",  # a path of the host; the container sees its top
            {
                "cpu/cpu.cfs_quota_us": "400000\n",
                "cpu/cpu.cfs_period_us": "100000\n",
                "memory/memory.limit_in_bytes": f"{3 * GB}\n",
            },
            4,
            3 * GB,
        ),
        ("5:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8, None),
        ("5:cpu:/\n", {"cpu/cpu.cfs_quota_us": "what\n"}, 8, None),
    ],
    ids=["v2", "v2 free", "v2 above", "v2 least", "v2 outside", "v1", "v1 free", "damaged"],
)
def test_a_container_s_limits_count(in_container, lines, files, cores, memory):
    in_container(lines, **files)
    assert usable_cores() == cores
    assert usable_memory() == (memory or 4096 * 4_000_000)


def test_where_the_system_does_not_say(in_container, monkeypatch):
    """As on macOS and Windows."""
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert usable_cores() == 6
    assert usable_memory() == math.inf
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_cores() == 1


def test_a_scene_that_a_container_does_not_hold_is_refused(in_container):
    in_container("0::/\n", **{"memory.max": "1000000\n"})
    with pytest.raises(SceneError, match=r"needs about .* GB of memory and cpu has 0\.001 GB"):
        Solver(Scene(bed=Bed(size=(0.4, 0.4, 0.2), spacing=0.02)))
