"""The keys of each command: type, range, default and one line of help, as `conf/<command>.yaml` has them."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from mpm_warp.settings import setting, settings
from sgns.config import UserError
from sgns.settings import Group, ReductionSettings, TrainingSettings, require_shares


@settings
class _Command(Group):
    group: ClassVar[str] = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if getattr(self, "device", None) == "meta":
            raise UserError("device is 'meta', which holds no numbers; allowed: cpu, cuda")


def _seed(words: str) -> Any:
    return setting(0, words, ge=0, le=10**18, words="; it must be a whole number, 0 or more")


def _device() -> Any:
    return setting("cpu", "cpu or cuda")


def _num_modes() -> Any:
    return setting(
        None,
        "the first modes; null: all",
        ge=1,
        words="; it must be a whole number, 1 or more, or null",
    )


@settings
class Limits(Group):
    """What is refused before it begins; raise a limit to begin all the same."""

    group: ClassVar[str] = "limits"
    time: float = setting(30.0, "longest time of a run on one core, estimated", "days", gt=0, le=1e6)
    disk: float = setting(1000.0, "largest size of a command's run files", "GB", gt=0, le=1e9)
    any_unit: bool = setting(False, "true: a path or tool may look like one in another unit")


@settings
class Simulate(_Command):
    """`sgns simulate`."""

    output: str = setting("run.h5", "run file to write")
    overwrite: bool = setting(False, "true: replace a finished run that is there at `output`")
    continue_from: str | None = setting(None, "a *.stopped.h5: goes on from its last frame")
    start_from: str | None = setting(
        None, "a run: its soil, as the last frame left it, with this scene's tool"
    )
    seed: int = _seed("of the particle arrangement and of a campaign's draws")
    device: str = _device()
    shard: int = setting(0, "with a dataset: which share of its runs this command makes", ge=0)
    shards: int = setting(1, "into how many shares the runs are divided", ge=1)
    limits: Limits = setting(Limits, "what is refused before it begins")


@settings
class Reduce(_Command):
    """`sgns reduce`."""

    output: str = setting("", "folder for energy.csv; the basis is kept in the dataset's own folder")
    overwrite: bool = setting(False, "true: replace a table that is there at `output`")
    pack: str | None = setting(None, "new folder: also write the reduced runs there, small")
    device: str = _device()


@settings
class Train(_Command):
    """`sgns train`."""

    checkpoint: str | None = setting(None, "file.ckpt to start from, or a name that ships; null: none")
    output: str = setting("", "folder for checkpoints and TensorBoard logs; one that exists is continued")
    seed: int = _seed("of weights, noise and order of the samples")
    device: str = _device()


def _spread() -> bool:
    return setting(False, "true: all members of an ensemble, with the spread of the force; false: the first")


@settings
class Rollout(_Command):
    """`sgns rollout`."""

    checkpoint: str = setting("", "file.ckpt of `sgns train`, or the name of one that ships")
    num_modes: int | None = _num_modes()
    rate_independent: bool = setting(True, "under a slow tool soil follows its way")
    spread: bool = _spread()
    output: str = setting("rollout.h5", "run file to write, of the same kind as the solver's")
    overwrite: bool = setting(False, "true: replace a rollout that is there at `output`")
    seed: int = _seed("of the particle arrangement")
    device: str = _device()


@settings
class Export(_Command):
    """`sgns export`."""

    checkpoint: str = setting("", "file.ckpt of `sgns train`, or the name of one that ships")
    num_modes: int | None = _num_modes()
    rate_independent: bool = setting(True, "under a slow tool soil follows its way")
    output: str = setting(
        "", "file.onnx, or file.pt2 of torch; file.decode.onnx or .pt2 is written beside it"
    )
    overwrite: bool = setting(False, "true: replace files that are there")


@settings
class Evaluate(_Command):
    """`sgns evaluate`."""

    checkpoint: str = setting("", "file.ckpt of `sgns train`, or the name of one that ships")
    num_modes: int | None = _num_modes()
    spread: bool = _spread()
    split: Literal["train", "validation", "test"] = setting("test", "which runs")
    new_rollouts: list[str] | str | None = setting(
        list,
        "run files of `sgns rollout` to show, too",
        words="; it must be a list of run files, as [a.h5,b.h5]",
    )
    timing_repeats: int = setting(3, "warm repeats of the timing; their median is reported", ge=3, le=1000)
    full_space: bool = setting(False, "also measure what the same network would cost on every particle")
    output: str = setting("", "folder for the report, its tables, figures and rollouts")
    overwrite: bool = setting(False, "true: replace a report that is there at `output`")
    device: str = _device()


@settings
class Frontier(_Command):
    """`sgns frontier`."""

    axis: Literal["solver", "reduction", "surrogate", "all", "none"] = setting(
        "all", "points to measure; none: only gather"
    )
    output: str = setting("", "folder of points, table, figures and page; one that exists is continued")


def _error(words: str, unit: str = "") -> Any:
    allowed = "; it must be a number above 0"
    limits: dict[str, Any] = {"gt": 0, "words": allowed}
    if not unit:  # of all: no better than a force of zero
        limits = {"gt": 0, "le": 1, "words": f"{allowed}, at most 1, a share: for 30 % give 0.3"}
    return setting(None, f"largest {words}; null: do not care", unit, **limits)


@settings
class Errors(Group):
    """Largest errors against the most accurate run."""

    group: ClassVar[str] = "error"
    force: float | None = _error("NRMSE of the force")
    position: float | None = _error("RMSE of the soil's displacement", "m")
    surface: float | None = _error("RMSE of the surface at the end", "m")
    sinkage: float | None = _error("mean absolute error of a wheel's height", "m")


@settings
class Advise(_Command):
    """`sgns advise`."""

    task: str = setting("cut", "what the body does, the column `scene` of the table")
    error: Errors = setting(Errors, "largest errors")
    time: float | None = setting(
        None,
        "longest wall time of one step of 1/60 s on one core, as Simulator.step takes it",
        "s",
        gt=0,
        words="; it must be a number above 0",
    )
    particles: bool = setting(False, "the positions of all particles are needed in every step")
    against: Literal["reference", "training"] = setting(
        "reference", "the most accurate run, or the solver that made the training runs"
    )
    table: str | None = setting(
        None, "points.csv of sgns frontier; null: the one that ships with the package"
    )


@settings
class Check(_Command):
    """`sgns check`."""

    files: list[str] | str = setting(
        list,
        "run files; a folder stands for the run files in it",
        words="; it must be paths of run files, as in sgns check run.h5",
    )


@settings
class ImportNames(Group):
    """What the arrays are called in the source; in HDF5 these are paths."""

    group: ClassVar[str] = "names"
    position: str = setting(
        "position", "soil (T, n, 3); of several series of .vtu files a pattern, as soil_*.vtu"
    )
    velocity: str = setting("velocity", "soil (T, n, 3), if it is there")
    id: str = setting("id", "numbers of the particles (T, n), if their order changes")
    time: str = setting("time", "of the frames [s], (T,)")
    pose: str = setting("pose", "of the tool (T, 7): place, quaternion")
    force: str = setting("force", "by the soil on the tool [N], (T, 3)")
    torque: str = setting("torque", "about the tool's place [N m], (T, 3), if it is there")
    body_points: str = setting("body_points", "of the tool: (M, 3) in its own frame, or (T, M, 3)")
    vertices: str = setting("vertices", "of the tool's mesh (V, 3), in its own frame")
    triangles: str = setting("triangles", "of the tool's mesh (F, 3)")


@settings
class Import(_Command):
    """`sgns import`."""

    source: list[str] | str = setting(
        list,
        "files (.npz, .h5) or folders, each with one run; patterns in quotes",
        words="; it must be paths, as in sgns import run.npz run.h5",
    )
    output: str = setting("", "run file to write (.h5), or folder of a dataset")
    overwrite: bool = setting(False, "true: replace what is there at `output`")
    frame_rate: float | None = setting(None, "of the source; null: as its times say", "Hz", gt=0, le=1e6)
    unit: Literal["m", "mm", "cm", "in"] = setting("m", "of the source's lengths")
    up: Literal["z", "y"] = setting("z", "the source's axis that points upwards")
    quaternion: Literal["xyzw", "wxyz"] = setting("xyzw", "order of the source's quaternions")
    origin: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "the source's point that becomes x = y = z = 0", words="; it needs three coordinates"
    )
    tool: str | None = setting(None, "mesh file of the tool, in its own frame; null: from the source")
    names: ImportNames = setting(ImportNames, "what the arrays are called in the source")
    split: tuple[float, float, float] = setting(
        (0.8, 0.1, 0.1),
        "shares of train, validation and test runs",
        ge=0,
        words="; it needs three shares (train, validation, test) that sum to 1",
    )
    seed: int = _seed("of the split")

    def __post_init__(self) -> None:
        super().__post_init__()
        require_shares("split", self.split)


@settings
class Convert(_Command):
    """`sgns convert`."""

    run: str = setting("", "run file to convert")
    output: str = setting("", "file to write; its ending says what for: .vtkhdf, .xyz, .csv, .npz")
    every: int = setting(1, "one frame of so many", ge=1, le=1_000_000)
    overwrite: bool = setting(False, "true: replace a file that is there")


def _overwrite() -> bool:
    return setting(False, "replace a picture that is there")


@settings
class Plot(_Command):
    """`sgns plot`."""

    run: str = setting("", "run file to show")
    output: str | None = setting(None, "PNG file to write; null: beside the run, with its name")
    overwrite: bool = _overwrite()


@settings
class Render(_Command):
    """`sgns render`."""

    run: str = setting("", "run file to show")
    output: str | None = setting(
        None, "GIF, MP4 or PNG file to write; null: a GIF beside the run, with its name"
    )
    overwrite: bool = _overwrite()


@settings
class View(_Command):
    """`sgns view`."""

    run: str | None = setting(
        None, "run file to show; with checkpoint the one whose tool is driven; null: none"
    )
    prediction: str | None = setting(None, "another run of the same scene, shown beside `run`; null: none")
    checkpoint: str | None = setting(
        None,
        "network to drive a tool in: file.ckpt of `sgns train`, or the name of one that ships; null: none",
    )
    output: str = setting("view.h5", "run file for what is recorded; more of them are numbered")
    port: int = setting(8765, "of 127.0.0.1, where the page is; 0: any that is free", ge=0, le=65535)
    open: bool = setting(False, "true: open the page in a browser on this machine")
    device: str = _device()


# --- All of them, by command ----------------------------------------------------------------------------

COMMANDS: dict[str, type[Group]] = {
    "simulate": Simulate,
    "reduce": Reduce,
    "train": Train,
    "rollout": Rollout,
    "export": Export,
    "evaluate": Evaluate,
    "frontier": Frontier,
    "advise": Advise,
    "check": Check,
    "convert": Convert,
    "import": Import,
    "plot": Plot,
    "render": Render,
    "view": View,
}
MAIN_KEYS: dict[str, list[tuple[str, type[Group], tuple[str, ...]]]] = {
    "reduce": [("reduction", ReductionSettings, ("num_modes", "tolerance"))],
    "train": [
        ("reduction", ReductionSettings, ("num_modes",)),
        ("training", TrainingSettings, ("max_steps",)),
    ],
}
"""Keys of groups that the help of a command shows beside its own: group, class, names."""
