"""The kernels that a GPU gets, run on the CPU: by threads at the same time, or item by item under a check.

Warp writes every kernel as C++ and compiles that for a loop over the items, one after the other. Here g++ compiles the
same C++ for two other ways to run it:

- `Threads`: several threads, each with a share of the items in shuffled order; sums are atomic.
- `Checked`: every access to memory is looked at (conflicts.cpp). Two items of one launch that touch the same four
  bytes, not both reading and not both summing atomically, are a conflict, and what lies outside of the launch's arrays
  may be touched by none.

    with on_stand_in(Checked()) as checked:
        list(Solver(scene).frames())
    print(checked.reports())
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar
from unittest import mock

import numpy as np
import warp as wp

from mpm_warp import solver

HERE = Path(__file__).resolve().parent
MANY = 0xFFFFFFFF
FLAGS = tuple("-std=c++17 -w -DNDEBUG -fPIC -shared -march=native -ffp-contract=fast -pthread".split())


@cache
def compiler() -> str | None:
    """Path of g++, if there is one that can do this."""
    found = shutil.which("g++") if sys.platform == "linux" else None
    if found is None:
        return None
    trial = [found, *FLAGS, "-fsanitize=thread", "-c", "-x", "c++", "-o", "/dev/null", "/dev/null"]
    return found if subprocess.run(trial, capture_output=True).returncode == 0 else None


@dataclass
class Report:
    """What the check found in all launches of one kernel."""

    kernel: str
    conflicts: int = 0
    """Places of four bytes, counted in every launch."""
    outside: int = 0
    """Accesses to what is no array of the launch."""
    first: str = ""
    """The first conflict or access outside, in words."""


class StandIn:
    """A way to run a kernel's items.

    Args:
        atomic: the kernels as a GPU gets them; False, a planted fault: those for one thread.
    """

    flags: tuple[str, ...]

    def __init__(self, atomic: bool = True) -> None:
        self.atomic = atomic

    def taken_over(self, command: wp.Launch) -> wp.Launch:
        """The recorded launch, which from now on runs this way."""
        built = _built(_source(command), self.flags)

        def forward(bounds: Any, arguments: Any) -> None:
            self.run(command.kernel, built, bounds._obj, arguments._obj)

        command.hooks = SimpleNamespace(forward=forward)
        return command

    def run(self, kernel: wp.Kernel, built: ctypes.CDLL, bounds: Any, arguments: ctypes.Structure) -> None:
        """Run one launch."""
        raise NotImplementedError


class Threads(StandIn):
    """By `count` threads at the same time; `seed` shuffles the items of every launch."""

    flags = ("-O2",)

    def __init__(self, count: int = 4, seed: int = 0) -> None:
        super().__init__()
        self._count, self._random = count, np.random.default_rng(seed)
        self.launches = 0

    def run(self, kernel: wp.Kernel, built: ctypes.CDLL, bounds: Any, arguments: ctypes.Structure) -> None:
        self.launches += 1
        seed = ctypes.c_uint64(int(self._random.integers(2**63)))
        built.run_by_threads(
            ctypes.byref(bounds), ctypes.byref(arguments), ctypes.c_size_t(self._count), seed
        )


class _Found(ctypes.Structure):
    """As in conflicts.cpp."""

    _fields_ = (
        *((name, ctypes.c_uint64) for name in ("conflicts", "outside", "accesses", "at", "outside_at")),
        *((name, ctypes.c_uint32) for name in ("one", "other")),
    )


class Checked(StandIn):
    """One item after the other, with all that they read and write."""

    flags = ("-O1", "-fno-tree-loop-distribute-patterns", "-fsanitize=thread", "-DCHECKED")

    def __init__(self, atomic: bool = True) -> None:
        super().__init__(atomic)
        self._reports: dict[str, Report] = {}

    def reports(self) -> list[Report]:
        """One for each kernel, by name."""
        return [self._reports[name] for name in sorted(self._reports)]

    def run(self, kernel: wp.Kernel, built: ctypes.CDLL, bounds: Any, arguments: ctypes.Structure) -> None:
        values = [getattr(arguments, name) for name, _ in arguments._fields_]
        arrays = {}
        for argument, value in zip(kernel.adj.args, values, strict=True):
            arrays |= _arrays(argument.label, argument.type, value)
        host = [(ctypes.addressof(part), ctypes.sizeof(part)) for part in (bounds, arguments)]
        known = [(at, at + size, 1) for at, size in arrays.values() if size]
        known += [(at, at + size, 0) for at, size in host]
        memory = np.array(sorted(known), dtype=np.uint64)
        checker, found = _checker(), _Found()
        # A body's mesh is Warp's own and known by a number only.
        beyond = ctypes.c_uint32("mesh" in built.source)
        checker.conflicts_begin(memory.ctypes.data_as(ctypes.c_void_p), ctypes.c_uint64(len(known)), beyond)
        built.run_checked(ctypes.byref(bounds), ctypes.byref(arguments))
        checker.conflicts_end(ctypes.byref(found))

        name = kernel.key.split("__")[-1]
        report = self._reports.setdefault(name, Report(name))
        report.conflicts += found.conflicts
        report.outside += found.outside
        if not report.first and found.conflicts:
            one = "several" if found.one == MANY else f"item {found.one}"
            report.first = f"{one} and item {found.other} at {_place(found.at, arrays)}"
        if not report.first and found.outside:
            report.first = f"an access near {_place(found.outside_at, arrays)}"


@contextmanager
def on_stand_in(stand_in: Way) -> Iterator[Way]:
    """Whatever is launched meanwhile is compiled as for a GPU and run by `stand_in`."""
    launch = wp.launch

    def taken_over(*arguments: Any, **options: Any) -> Any:
        command = launch(*arguments, **options)
        return command if command is None else stand_in.taken_over(command)

    def as_for_a_gpu(kernels: Callable) -> Callable:
        return lambda *arguments, atomic: kernels(*arguments, atomic=stand_in.atomic)

    with (
        mock.patch.object(wp, "launch", taken_over),
        mock.patch.object(solver, "transfer", as_for_a_gpu(solver.transfer)),
    ):
        yield stand_in


Way = TypeVar("Way", bound=StandIn)


def _arrays(name: str, kind: Any, value: Any) -> dict[str, tuple[int, int]]:
    """Address and bytes of the arrays in an argument, by name; also of those in structs and in tables of structs."""
    if isinstance(kind, wp.array):
        size = value.shape[0] * value.strides[0]
        found = {name: (value.data, size)}
        if size and hasattr(kind.dtype, "ctype"):
            rows = (kind.dtype.ctype * value.shape[0]).from_address(value.data)
            for number, row in enumerate(rows):
                found |= _arrays(f"{name}[{number}]", kind.dtype, row)
        return found
    found = {}
    if hasattr(kind, "vars"):
        for field, variable in kind.vars.items():
            found |= _arrays(f"{name}.{field}", variable.type, getattr(value, field))
    return found


def _place(address: int, arrays: dict[str, tuple[int, int]]) -> str:
    """The array, and the byte in it, in or before which an address lies."""
    before = [(at, name) for name, (at, size) in arrays.items() if at <= address and size]
    if not before:
        return "no array"
    at, name = max(before)
    return f"{name}, byte {address - at} of {arrays[name][1]}"


def _source(command: wp.Launch) -> tuple[str, str]:
    """A kernel's name in C++, and the C++ of its module."""
    name = command.kernel.get_mangled_name()
    for file in Path(command.module_exec.binary_path).parent.glob("*.cpp"):
        text = file.read_text()
        if f"{name}_cpu_kernel_forward(" in text:
            return name, text
    raise FileNotFoundError(f"Warp left no C++ of {name}")


@cache
def _folder() -> Path:
    """Where libraries are made; it goes when the process ends."""
    folder = Path(tempfile.mkdtemp(prefix="sgns-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def _built(source: tuple[str, str], flags: tuple[str, ...]) -> ctypes.CDLL:
    """The library of a kernel."""
    name, text = source
    dimensions = re.search(rf"{name}_cpu_forward\(\s*wp::launch_bounds_t<(\d)>", text).group(1)
    # Without Warp's own C library, which it needs where there is no other.
    text = re.sub(r"#define WP_NO_CRT\n", "", text)
    # What the code for the CPU copies vectors with is not seen by the compiler's check.
    if "-DCHECKED" in flags:
        text = re.sub(r"\b__builtin_memcpy\b", "conflicts_copy", text)
    code = (
        'extern "C" void* conflicts_copy(void*, const void*, unsigned long);\n'
        f'#include "{HERE / "preamble.h"}"\n{text}\n'
        f"#define KERNEL {name}_cpu_kernel_forward\n#define ARGUMENTS wp_args_{name}\n"
        f'#define DIMENSIONS {dimensions}\n#include "{HERE / "entry.h"}"\n'
    )
    file = _folder() / f"{hashlib.blake2b((code + repr(flags)).encode(), digest_size=8).hexdigest()}.cpp"
    file.write_text(code)
    headers = Path(wp.__file__).parent / "native"
    library, parts = file.with_suffix(".so"), [file]
    if "-DCHECKED" in flags:
        # Compiled and linked apart: at linking, the flag would bring in the compiler's own library.
        unit = file.with_suffix(".o")
        _compile([*flags, "-c", "-I", headers, file, "-o", unit])
        flags, parts = (), [unit, Path(_checker()._name)]
    _compile([*flags, "-I", headers, *parts, "-o", library])
    built = ctypes.CDLL(str(library))
    built.source = text
    return built


@cache
def _checker() -> ctypes.CDLL:
    library = _folder() / "conflicts.so"
    _compile(["-O2", HERE / "conflicts.cpp", "-o", library])
    return ctypes.CDLL(str(library))


def _compile(arguments: list[Any]) -> None:
    if compiler() is None:
        raise FileNotFoundError("g++ on Linux is needed")
    shared = [flag for flag in FLAGS if "-c" not in arguments or flag != "-shared"]
    subprocess.run([compiler(), *shared, *map(str, arguments)], check=True)
