"""Kernels that work for one scene or, in one launch, for many.

What a scene asks of the device is a fixed order of kernels with fixed arguments. Where several scenes ask for the same
kernels, one launch of each serves them all: a table holds every scene's arguments, and thread (s, i) does in scene s
what thread i does where the scene is alone. Each scene keeps arrays, sizes, a material and a time step of its own.
"""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import warp as wp

from .kernel_cache import load_kernel

__all__ = ["Launch", "SceneKernel", "Together", "scene_kernel"]


class SceneKernel:
    """The two kernels made of one function.

    Args:
        body: what thread i does; i is its first argument, the others are the kernel's.
        module_options: Warp's options for the kernels' modules.
    """

    def __init__(self, body: Callable, module_options: dict[str, Any] | None = None) -> None:
        _, *arguments = inspect.get_annotations(body).items()
        self.name = body.__name__
        self._types = dict(arguments)
        self._body, self._options = body, module_options
        self._function = wp.func(body)

    @cached_property
    def alone(self) -> wp.Kernel:
        """Over the items of one scene, with the function's arguments."""
        arguments = ", ".join(f"{name}: types[{name!r}]" for name in self._types)
        return self._kernel("", arguments, f"one_item(wp.tid(), {', '.join(self._types)})")

    @cached_property
    def together(self) -> wp.Kernel:
        """Over (scenes, items); `counts` are the scenes' items, and a scene with no more than `step` steps to do is
        left as it is."""
        return self._kernel(
            "_together",
            "table: wp.array(dtype=row), counts: wp.array(dtype=int), steps: wp.array(dtype=int), step: int",
            "s, i = wp.tid()",
            "if i < counts[s] and step < steps[s]:",
            f"    one_item(i, {', '.join(f'table[s].{name}' for name in self._types)})",
        )

    @property
    def row(self) -> Any:
        """Struct of one scene's arguments in the table of `together`."""
        # Not the one made below: where Warp has met the same text and types before, it gives the kernel it made then.
        return self.together.adj.arg_types["table"].dtype

    def _kernel(self, ending: str, arguments: str, *lines: str) -> wp.Kernel:
        # Warp translates a kernel's text. This one stands in no file, so Python has to be told of it.
        name = self.name + ending
        text = "\n    ".join((f"def {name}({arguments}):", *lines)) + "\n"
        file = f"<{self._body.__module__}.{self._body.__qualname__}{ending} {id(self)}>"
        linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file
        names: dict[str, Any] = {"wp": wp, "one_item": self._function, "types": self._types}
        names["__name__"] = self._body.__module__
        if ending:
            names["row"] = wp.struct(type(f"{self.name}_row", (), {"__annotations__": self._types}))
        exec(compile(text, file, "exec"), names)
        function: Any = names[name]
        function.__qualname__ = self._body.__qualname__ + ending
        return wp.kernel(function, module="unique", enable_backward=False, module_options=self._options)


def scene_kernel(module_options: dict[str, Any] | None = None) -> Callable[[Callable], SceneKernel]:
    """Decorator that makes a `SceneKernel` of a function."""
    return lambda body: SceneKernel(body, module_options)


@dataclass(frozen=True, eq=False)
class Launch:
    """A kernel over the items of one scene."""

    kernel: SceneKernel
    count: int
    arguments: Sequence[Any]
    """Of the kernel's function, without its first. Arrays keep their place and numbers their value."""
    device: wp.Device

    def load(self) -> None:
        """Load the kernel, which compiles it the first time."""
        _ = self._recorded

    def launch(self, step: int = 0) -> None:
        """Run it, whatever the number of the step."""
        self._recorded.launch()

    @cached_property
    def _recorded(self) -> wp.Launch:
        load_kernel(self.kernel.alone, self.device)
        return wp.launch(self.kernel.alone, self.count, self.arguments, device=self.device, record_cmd=True)


class Together:
    """The same kernel over the items of several scenes.

    Args:
        launches: one of each scene.
        steps: that each scene has to do.
    """

    def __init__(self, launches: Sequence[Launch], steps: wp.array) -> None:
        self._launches = launches  # they hold the arrays that the table points to
        kernel, device, rows = launches[0].kernel, launches[0].device, []
        row = kernel.row
        for launch in launches:
            rows.append(row())
            for name, value in zip(row.vars, launch.arguments, strict=True):
                setattr(rows[-1], name, value)
        counts = [launch.count for launch in launches]
        table = wp.array(rows, dtype=row, device=device), wp.array(counts, dtype=int, device=device)
        load_kernel(kernel.together, device)
        self._recorded = wp.launch(
            kernel.together,
            (len(launches), max(counts)),
            [*table, steps, 0],
            device=device,
            record_cmd=True,
        )

    def launch(self, step: int = 0) -> None:
        """Run it for the scenes that have more than `step` steps to do."""
        self._recorded.set_param_by_name("step", step)
        self._recorded.launch()
