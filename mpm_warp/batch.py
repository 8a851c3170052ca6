"""Many scenes at once."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from itertools import repeat

from .effects import Effects
from .errors import SceneError, SolverStopped
from .scene import Scene
from .solver import Frame, Solver
from .streams import in_turns

__all__ = ["frames_together"]


def frames_together(
    scenes: Iterable[Scene],
    effects: Effects | Iterable[Effects] | None = None,
    device: str = "cpu",
    precision: str = "float32",
    at_once: int = 32,
) -> Iterator[tuple[int, Frame | SceneError | SolverStopped]]:
    """Computes scenes side by side, each as a `Solver` of its own would.

        for number, frame in frames_together(scenes, device="cuda"):
            if not isinstance(frame, Frame):
                print(f"scene {number} ended: {frame}")

    It pays on a GPU, which a scene of some ten thousand particles does not fill. Scenes may differ in anything; none
    depends on which others are computed with it.

    Args:
        scenes: what to compute.
        effects: which physics, for all of them or one for each.
        device: `cpu` or `cuda`, `cuda:0`, ...
        precision: `float32` or `float64`.
        at_once: scenes that are under way at the same time; the next begins when one ends.

    Yields:
        The number of a scene and its next frame. Frames of one scene come in order, those of different scenes mixed.
        In place of a frame that cannot be computed the error comes, as that scene's last; the others go on.
    """

    def frames(
        scene: Scene, effects: Effects | None
    ) -> Generator[Frame | SceneError | SolverStopped | None, None, None]:
        try:
            yield from Solver(scene, effects, device, precision).stages()
        except (SceneError, SolverStopped) as error:
            yield error

    each = repeat(effects) if effects is None or isinstance(effects, Effects) else effects
    return in_turns(map(frames, scenes, each), at_once, device)
