"""Every setting outside scenes: its type, range, default and one line of help, as the groups of `conf/` have them; the
keys of commands are in `sgns.command_settings`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, ClassVar, Literal

from mpm_warp.settings import Settings, setting, settings
from sgns.config import UserError


class Group(Settings):
    """Base of the groups: what is not allowed is a `UserError`, and they are plain data in checkpoints."""

    raises = UserError

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        values = asdict(self)  # type: ignore[call-overload]  # every group is a dataclass
        return {key: values[key] for key in ("kind",) if key in values} | values  # the kind first


def require_shares(key: str, split: tuple[float, ...]) -> None:
    """Refuse shares that do not sum to 1."""
    if not math.isclose(sum(split), 1, abs_tol=1e-6):
        raise UserError(
            f"{key} is {list(split)}; it needs three shares (train, validation, test) that sum to 1"
        )


# --- conf/dataset ---------------------------------------------------------------------------------------


@settings
class DatasetSettings(Group):
    """A campaign of runs that are simulated here."""

    group: ClassVar[str] = "dataset"
    name: str = setting("", "what it is called")
    path: str = setting("", "its folder")
    scene: str | None = setting(None, "option of the group `scene` that every run starts from")
    change: dict[str, Any] | None = setting(
        None, "values in that scene", words="; it must be a group of keys of the scene"
    )
    draw: dict[str, Any] | list[dict[str, Any]] | None = setting(
        None,
        "every run takes one combination of a grid",
        words="; it must be a grid, key: [values], or a list of such grids",
    )
    runs: int | None = setting(None, "combinations that are drawn; null: all", ge=3, le=1_000_000)
    split: tuple[float, float, float] = setting(
        (0.8, 0.1, 0.1),
        "shares of train, validation and test runs of every grid",
        ge=0,
        words="; it needs three shares (train, validation, test) that sum to 1",
    )
    where: dict[str, Any] | None = setting(
        None,
        "use only runs of scenes with these values",
        words="; it must be keys of the scene with their values, or null",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_shares("dataset.split", self.split)
        grids = self.draw if isinstance(self.draw, list) else [] if self.draw is None else [self.draw]
        for grid in grids:
            if not grid:
                raise UserError(
                    f"dataset.draw holds {grid!r}; it must be a grid, key: [values], or a list of such grids"
                )
            for key, values in grid.items():
                # A single text may be a pattern of files.
                if not isinstance(values, (list, str)) or not values:
                    raise UserError(
                        f"dataset.draw.{key} is {values!r}; it must be a list of at least one value"
                    )


@settings
class PublishedSettings(Group):
    """The reduced runs that the paper's authors published."""

    group: ClassVar[str] = "dataset"
    name: str = setting("published", "what it is called")
    format: Literal["published"] = setting("published", "TFRecord files, which are not part of this package")
    path: str | None = setting(None, "folder with metadata.json and *.tfrecord, excavation or wheel")
    folds: int | None = setting(None, "folds, one of which is left out; null: none", ge=2, le=1_000_000)
    fold: int = setting(0, "which one", ge=0)


@settings
class PackedSettings(Group):
    """A dataset whose reduced runs are all there is."""

    group: ClassVar[str] = "dataset"
    name: str = setting("", "what it is called")
    format: Literal["reduced"] = setting(
        "reduced", "a few small files, written by sgns reduce ... pack=<folder>"
    )
    path: str = setting("", "folder of these files")


# --- conf/reduction -------------------------------------------------------------------------------------


@settings
class ReductionSettings(Group):
    """How the soil is reduced to a few modes."""

    group: ClassVar[str] = "reduction"
    num_modes: int | Literal["auto"] = setting(8, "modes used; auto: the fewest that are good enough", ge=1)
    max_modes: int = setting(64, "modes fitted and cached once", ge=1, le=100_000)
    centring: Literal["scalar", "particle", "particle_axis"] = setting("particle_axis", "what is subtracted")
    choose: Literal["position", "energy", "displacement_energy"] = setting("position", "by what auto chooses")
    tolerance: float = setting(3.0, "with choose=position: largest RMSE", "mm", gt=0)
    share: float = setting(0.99, "with the energies: least share of the variance", gt=0, le=1)
    closure: Literal["none", "kernel", "quadratic"] = setting("none", "how more modes follow from those used")
    closure_modes: int = setting(32, "modes with the closure's, at most max_modes", ge=2, le=100_000)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_modes != "auto" and self.num_modes > self.max_modes:
            raise UserError(
                f"reduction.num_modes is {self.num_modes}; allowed: 1 to reduction.max_modes ({self.max_modes}); "
                "raise reduction.max_modes to keep more"
            )


# --- conf/model -----------------------------------------------------------------------------------------

_CONTEXT = ("gravity", "friction_angle", "load", "diameter", "width", "slip", "slip_angle")


def _context(words: str) -> Any:
    return setting(lambda: list(_CONTEXT), words, words="; it must be a list of keys of the scene")


MOST_WEIGHTS = 1e8
"""Of a model: 1.6 GB with their gradients and what the optimiser keeps."""


@settings
class ModelSettings(Group):
    """The graph network on modes and body."""

    group: ClassVar[str] = "model"
    history: int = setting(3, "positions of history; one velocity fewer", ge=2, le=100)
    body_nodes: Literal["pose", "points"] = setting("pose", "one node, or one per body point")
    positions: bool = setting(True, "nodes know where they are, not only how they move")
    next_motion: bool = setting(True, "the prescribed motion into the next frame is told")
    identity: Literal["mode", "type"] = setting("mode", "a learned vector per mode, or one")
    identity_width: int = setting(8, "width of these vectors", ge=0, le=10_000)
    context: list[str] = _context("numbers of the scene told to every node, where they vary")
    edges: Literal["complete", "star"] = setting("complete", "every pair of nodes, or modes and body only")
    self_loops: bool = setting(False, "every node has an edge to itself")
    edge_scale: float | None = setting(
        None,
        "unit of positions on edges; null: as on nodes",
        "m",
        gt=0,
        words="; it must be a length above 0 [m], or null",
    )
    edge_length: bool = setting(True, "edges hold their length beside the relative position")
    hidden_width: int = setting(128, "width of every layer", ge=1, le=10_000)
    hidden_layers: int = setting(2, "hidden layers of each MLP", ge=1, le=100)
    message_passing_steps: int = setting(1, "each with two MLPs of its own", ge=1, le=100)
    layer_norm: bool = setting(False, "layer normalisation after every MLP but the decoder")
    residual: bool = setting(False, "message passing adds to nodes and edges instead of replacing them")
    activation: Literal["relu", "silu", "gelu", "tanh"] = setting("relu", "of every hidden layer")
    predicts: Literal["acceleration", "velocity"] = setting("velocity", "what the decoder says of every mode")
    rigid: bool = setting(True, "predicted body points are moved to the nearest place of a rigid body")
    force: Literal["sum", "mean"] = setting("sum", "of what the nodes contribute")
    torque: bool = setting(True, "predict the torque, too")
    kind: Literal["network"] = setting("network", "of the model")

    def __post_init__(self) -> None:
        super().__post_init__()
        weights = (2 * self.message_passing_steps + 4) * self.hidden_layers * self.hidden_width**2
        if weights > MOST_WEIGHTS:
            raise UserError(
                f"the model would have about {weights:.2g} weights; at most {MOST_WEIGHTS:g} are allowed: lower "
                "model.hidden_width, hidden_layers or message_passing_steps"
            )


@settings
class PolynomialSettings(Group):
    """Polynomials of what the network is shown, in its place."""

    group: ClassVar[str] = "model"
    history: int = setting(3, "positions of history; one velocity fewer", ge=2, le=100)
    degree: Literal[1, 2] = setting(2, "1 (linear), or 2 (and all products of two inputs)")
    context: list[str] = _context("numbers of the scene that are inputs, where they vary")
    kind: Literal["polynomial"] = setting("polynomial", "of the model")

    @property
    def body_nodes(self) -> str:
        """The body is always shown as its pose."""
        return "pose"


# --- conf/training --------------------------------------------------------------------------------------


@settings
class LossWeights(Group):
    """Weights of the squared errors of normalised quantities."""

    group: ClassVar[str] = "training.loss"
    change: float = setting(1.0, "of the predicted accelerations (or velocities), mean over nodes", ge=0)
    force: float = setting(1.0, "of the force", ge=0)
    torque: float = setting(0.1, "of the torque", ge=0)


def _threads() -> Any:
    return setting(2, "CPU threads of torch; null: torch's own choice", ge=1, le=1024)


@settings
class TrainingSettings(Group):
    """How the network is trained."""

    group: ClassVar[str] = "training"
    max_steps: int = setting(6000, "optimiser steps", ge=1, le=10**9)
    batch_size: int = setting(
        32, "windows of one step; of several members each takes half of it", ge=1, le=10**9
    )
    members: int = setting(
        1, "networks that are trained side by side, for a spread of force and soil", ge=1, le=64
    )
    learning_rate: float = setting(2e-3, "highest, after the warm-up", gt=0)
    final_learning_rate: float = setting(1e-6, "at max_steps", gt=0)
    warmup_steps: int = setting(200, "steps of linear rise", ge=0, le=10**9)
    schedule: Literal["cosine", "exponential"] = setting("cosine", "fall to final_learning_rate")
    decades: float = setting(2.0, "of the exponential fall: powers of ten until max_steps", ge=0, le=300)
    weight_decay: float = setting(0.0, "AdamW's", ge=0)
    gradient_clip: float | None = setting(1.0, "largest norm of the gradient; null: none", gt=0)
    noise: float = setting(1.0, "deviation of the random-walk noise on the history", ge=0)
    noise_unit: Literal["velocity", "metre"] = setting("velocity", "share of a mode's velocity, or m")
    scales: Literal["per_mode", "pooled"] = setting("per_mode", "scales of quantities")
    normalisation_floor: float = setting(0.01, "smallest scale, share of the largest", ge=0)
    horizon: int = setting(1, "steps predicted one after another for the loss", ge=1, le=1000)
    fewer_modes: float = setting(0.0, "share of the steps that use the first few modes only", ge=0, le=1)
    change_of: Literal["free", "all"] = setting("free", "nodes whose change counts")
    loss: LossWeights = setting(LossWeights, "weights of the parts of the loss")
    validate_every: int = setting(500, "steps between rollouts of the validation runs", ge=1, le=10**9)
    log_every: int = setting(50, "steps between points in TensorBoard", ge=1, le=10**9)
    resume: Literal["auto", False] = setting(
        "auto", "go on from last.ckpt in `output`; false: start anew and overwrite"
    )
    threads: int | None = _threads()
    devices: int = setting(
        1, "processes on each machine, each with its own device, started by torchrun or srun", ge=1, le=1024
    )
    nodes: int = setting(1, "machines", ge=1, le=100_000)
    strategy: Literal["auto", "ddp", "ddp_find_unused_parameters_true"] = setting(
        "auto", "Lightning's, of several processes"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.windows // self.members % self.processes:
            raise UserError(
                f"training.devices times training.nodes is {self.processes}, and each takes the same share of the "
                f"{self.windows // self.members} windows of a step: choose a training.batch_size that this divides"
            )

    @property
    def processes(self) -> int:
        """That train together."""
        return self.devices * self.nodes

    @property
    def windows(self) -> int:
        """Of one step, those of all members."""
        return self.batch_size if self.members == 1 else self.members * math.ceil(self.batch_size / 2)

    def rate(self, step: int) -> float:
        """Learning rate of a step (from 0) as a share of the highest: a linear rise, then the fall."""
        if step < self.warmup_steps:
            return (step + 1) / (self.warmup_steps + 1)
        done = min(1.0, (step - self.warmup_steps) / max(1, self.max_steps - self.warmup_steps))
        end = self.final_learning_rate / self.learning_rate
        if self.schedule == "exponential":
            return max(end, 10.0 ** (-self.decades * done))
        return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * done))


@settings
class FitSettings(Group):
    """How polynomials are fitted."""

    group: ClassVar[str] = "training"
    noises: list[float] = setting(
        lambda: [0.1, 0.3, 1.0],
        "of the noise on the history, shares of a mode's velocity",
        ge=0,
        words="; it must be a list of numbers, 0 or more",
    )
    penalties: list[float] = setting(
        lambda: [1e-4, 1e-3, 1e-2, 1e-1, 1.0],
        "of the squares of coefficients, to choose from",
        ge=0,
        words="; it must be a list of numbers, 0 or more",
    )
    linear: bool = setting(True, "with model.degree=2, fits without products of inputs may be chosen, too")
    draws: int = setting(2, "how often all windows are taken, each time with other noise", ge=1, le=1000)
    normalisation_floor: float = setting(0.01, "smallest scale, share of the largest", ge=0)
    resume: Literal["auto", False] = setting(
        "auto", "answer from what is complete in `output`; false: start anew"
    )
    threads: int | None = _threads()

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("noises", "penalties"):
            if not getattr(self, key):
                raise UserError(f"training.{key} is []; it must be a list of numbers, 0 or more")


# --- conf/study -----------------------------------------------------------------------------------------


@settings
class PointSettings(Group):
    """What makes a point of a study."""

    group: ClassVar[str] = "study.scenes"
    axis: str = setting("", "what is varied")
    label: str = setting("", "its name, unique in its list")
    set: list[str] = setting(
        list, "overrides: of `sgns simulate` for the solver, of `sgns train` for surrogates"
    )
    paper: bool = setting(False, "it is an operating point of the paper")
    centring: Literal["scalar", "particle", "particle_axis"] = setting("particle_axis", "of a reduction")
    modes: list[int] = setting(list, "of a reduction: the numbers r, a point each", ge=1)


def _points() -> Any:
    return setting(None, "its points", words="; it must be a list of points, each with axis and label")


@settings
class StudySceneSettings(Group):
    """One figure of a study: a kind of scene, what it is judged on, and its points."""

    group: ClassVar[str] = "study.scenes"
    scene: str = setting("", "option of the group `scene` that all points start from")
    dataset: str = setting("", "that surrogates learn from; the cases are among its test runs")
    cases: dict[str, list[str]] = setting(
        dict, "runs that all points are judged on", words="; it must be case: [overrides of sgns simulate]"
    )
    bands: dict[str, float] | None = setting(
        None, "how wrong the reference may be", ge=0, words="; it must be column of errors: number, 0 or more"
    )
    reference: dict[str, Any] = setting(
        dict, "the most accurate run", words="; it must be a group with label and set"
    )
    solver: list[Any] | None = _points()
    reduction: list[Any] | None = _points()
    surrogate: list[Any] | None = _points()


# --- conf/solver ----------------------------------------------------------------------------------------


@settings
class SolverSettings(Group):
    """How the material point method computes."""

    group: ClassVar[str] = "solver"
    precision: Literal["float32", "float64"] = setting("float32", "of the numbers")
    threads: int = setting(
        1,
        "of the CPU for one run, each with a part of its soil; a dataset makes a run per core",
        ge=1,
        le=256,
    )
    batch: int = setting(32, "with a dataset on a GPU: runs under way at once", ge=1, le=100_000)


# --- Which of them a value chooses ----------------------------------------------------------------------

MODELS: dict[Any, tuple[Any, Any]] = {
    "network": (ModelSettings, TrainingSettings),
    "polynomial": (PolynomialSettings, FitSettings),
}
"""Settings of the model and of its training, by `model.kind`."""


def model_settings(model: Mapping[str, Any]) -> ModelSettings | PolynomialSettings:
    """The settings in the values of `conf/model`, checked.

    Raises:
        UserError: A value is unknown or not allowed for this kind; the line names its key.
    """
    kind = model.get("kind")
    if not isinstance(kind, str) or kind not in MODELS:
        raise UserError(f"model.kind is {kind!r}; allowed: {', '.join(MODELS)}")
    return MODELS[kind][0].from_dict(model)


def training_settings(model: Mapping[str, Any], training: Mapping[str, Any]) -> Any:
    """The settings in the values of `conf/training`, checked: those that go with the kind of model."""
    return MODELS[model_settings(model).kind][1].from_dict(training)


def dataset_settings(dataset: Mapping[str, Any]) -> Group:
    """The settings in the values of `conf/dataset`, checked; errors as `model_settings`."""
    if "format" not in dataset:
        return DatasetSettings.from_dict(dataset)
    return (PackedSettings if dataset["format"] == "reduced" else PublishedSettings).from_dict(dataset)
