"""What a checkpoint holds: the latent dynamics with all that is needed to step a bed."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import torch
from torch import Tensor, nn

from mpm_warp.poses import in_body_frame
from sgns.config import UserError
from sgns.data.files import read_json, whole_file
from sgns.data.run_file import require_mesh_was_read
from sgns.model.dynamics import Dynamics
from sgns.model.features import slowest_travel
from sgns.model.training_range import TrainingRange
from sgns.reduction.basis import Basis
from sgns.reduction.reduce import ReducedDataset

DYNAMICS = {
    "network": "sgns.model.network_dynamics:LatentDynamics",
    "polynomial": "sgns.model.polynomial:PolynomialDynamics",
}
"""Every kind of latent dynamics, by `model.kind`. Loaded is that of the checkpoint only: torch-geometric, which
networks need, takes seconds."""

# A checkpoint is laid out as Lightning's `.ckpt` and loaded with `weights_only`: tensors in its state dict (weights,
# normalisation, basis, common start, body points) and plain Python values, the card, as its hyperparameters. A
# network's is written by Lightning and also holds what is needed to go on training.

_FORMAT = "sgns-surrogate"
_FORMAT_VERSION = 2
_PREFIX = "surrogate."
_DEEPEST = 100  # nesting of a card
_MOST_VALUES = 1_000_000  # of a card
_MOST_TEXT = 1 << 24  # characters of a card
# How far the soil's modes may leave the range of the training runs, in widths of that range. Held-out runs leave it by
# up to 0.57 (of four training runs), rollouts five times as deep as trained by 0.45.
_MARGIN = 0.75


class Surrogate(nn.Module):
    """Latent dynamics, the basis they live in, and where they start.

    Args:
        dynamics: A network or polynomials, with their statistics.
        basis: Modes of the soil; as many as the dynamics has.
        start_positions: Common start of the soil at rest [m], shape (n, 3).
        body_points: Body points in the body frame [m], shape (M, 3).
        card: Plain values: frame_rate [Hz], scene, training_range (see `TrainingRange.plain`), slowest_travel (see
            `sgns.model.features`), and any provenance.

    Attributes:
        training_range: What the training runs covered.
        slowest_travel: Of the training runs' tools in a frame [m].
    """

    basis_mean: Tensor
    basis_modes: Tensor
    basis_eigenvalues: Tensor
    start_positions: Tensor
    body_points: Tensor

    def __init__(
        self,
        dynamics: Dynamics,
        basis: Basis,
        start_positions: Tensor,
        body_points: Tensor,
        card: dict[str, Any],
    ) -> None:
        super().__init__()
        if basis.num_modes != dynamics.num_modes:
            raise UserError(
                f"the basis has {basis.num_modes} modes and the {dynamics.settings.kind} {dynamics.num_modes}; they "
                "must agree"
            )
        self.dynamics = dynamics
        self.basis = basis
        state = basis.state()
        for name in [name for name, value in state.items() if isinstance(value, Tensor)]:
            self.register_buffer(f"basis_{name}", state.pop(name))
        self.register_buffer("start_positions", start_positions.double())
        self.register_buffer("body_points", body_points.double())
        self.training_range = TrainingRange.from_plain(card["training_range"])
        dynamics.lowest, dynamics.highest = (
            torch.as_tensor(bound.reshape(dynamics.num_modes, 3)).to(dynamics.lowest)
            for bound in self.training_range.soil(_MARGIN)
        )
        self.slowest_travel = float(card["slowest_travel"])
        if not 0.0 <= self.slowest_travel < math.inf:
            raise ValueError(f"the slowest travel is {self.slowest_travel}")
        self.card = dict(card) | {
            "format": _FORMAT,
            "format_version": _FORMAT_VERSION,
            **dynamics.card(),
            "basis": state,
        }

    def __repr__(self) -> str:
        size = f"{self.basis.num_modes} modes of {self.basis.num_particles} particles"
        return f"Surrogate({self.dynamics.settings.kind}: {size}, {self.frame_rate:g} Hz)"

    @classmethod
    def of(cls, dynamics: Dynamics, reduced: ReducedDataset, card: Mapping[str, Any]) -> Surrogate:
        """Dynamics with the basis, the start and the body points of the dataset that they are trained on."""
        runs = reduced.runs("train")
        points = in_body_frame(runs[0].pose[0], runs[0].body_points[0])
        sees_points = dynamics.settings.body_nodes == "points"
        known = TrainingRange.of(runs, dynamics.num_modes, dynamics.context_keys, sees_points)
        return cls(
            dynamics,
            reduced.of_modes(dynamics.num_modes),
            torch.as_tensor(reduced.start_positions),
            torch.as_tensor(points),
            {**card, "training_range": known.plain(), "slowest_travel": slowest_travel(runs)},
        )

    @property
    def frame_rate(self) -> float:
        """Steps per second [Hz]."""
        return float(self.card["frame_rate"])

    def save(self, path: Path) -> None:
        """Write a checkpoint without anything to go on training from."""
        state = {f"{_PREFIX}{name}": value for name, value in self.state_dict().items()}
        write_checkpoint({"state_dict": state, "hyper_parameters": self.card}, path)


def write_checkpoint(content: dict[str, Any], path: Path) -> None:
    """Write a checkpoint, complete or not at all; OSError if the disk does not take it."""
    buffer = io.BytesIO()  # torch says of a full disk only that some position is unexpected
    torch.save(content, buffer)
    with whole_file(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """A checkpoint's content, with its card under "hyper_parameters"; the path may be the name of one that ships.

    Raises:
        UserError: Missing, truncated, or not a checkpoint of this project, or of a newer one.
    """
    ships = f"; {_what_ships()}" if is_plain_name(path) else ""
    path = checkpoint_file(path)
    if (inside := path / "best.ckpt").is_file():
        raise UserError(f"{path} is a folder; use checkpoint={inside}")
    if not path.is_file():
        raise UserError(
            f"no checkpoint at {path}{ships}; train one with: sgns train output=<folder>, then use "
            "<folder>/best.ckpt"
        )
    try:
        _require_plain_archive(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever the bytes are, reading them may fail in any way
        raise UserError(
            f"{path} cannot be read as a checkpoint; it is truncated or something else; train again"
        ) from error
    card = content.get("hyper_parameters") if isinstance(content, dict) else None
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(card, dict) or card.get("format") != _FORMAT or not isinstance(state, dict):
        raise UserError(
            f"{path} is not a checkpoint of sgns; use best.ckpt or last.ckpt of an output of sgns train"
        )
    if not isinstance(version := card.get("format_version", 0), int) or version > _FORMAT_VERSION:
        raise UserError(
            f"{path} has format {version!r}, newer than this program reads ({_FORMAT_VERSION}); update sgns"
        )
    try:
        _require_tree(card)
        _require_settings(card.get("settings", {}))
    except ValueError as error:
        raise UserError(f"{path} has a card that cannot be used ({error}); train again") from error
    return content


def load_surrogate(path: str | Path) -> Surrogate:
    """The surrogate in a checkpoint, on the CPU.

    Raises:
        UserError: As `read_checkpoint`, or its parts do not fit together.
    """
    content = read_checkpoint(path)
    card = content["hyper_parameters"]
    try:
        state = _below(_PREFIX, content["state_dict"])
        _require_own_values(state)
        if not isinstance(scene := card["scene"], dict) or not isinstance(scene.get("bed", {}), dict):
            raise ValueError("its card does not say what the scene is")
        require_mesh_was_read(scene)
        kind: type[Dynamics] = resolve_name(DYNAMICS[card["model"]["kind"]])
        dynamics = kind.from_card(card, _below("dynamics.", state))
        tensors = {name: state[f"basis_{name}"] for name in ("mean", "modes", "eigenvalues")}
        tensors |= _below("basis_", state)  # those of a closure
        basis = Basis.from_state(card["basis"] | tensors, where=str(path))
        surrogate = Surrogate(dynamics, basis, state["start_positions"], state["body_points"], card)
        surrogate.load_state_dict(state)
        own = surrogate.state_dict()
        if odd := [
            name
            for name, value in state.items()
            if value.dtype.is_floating_point != own[name].is_floating_point()
        ]:
            raise ValueError(f"{odd[0]} holds {state[odd[0]].dtype}")
        if not 0.0 < surrogate.frame_rate < math.inf:
            raise ValueError(f"the frame rate is {surrogate.frame_rate} Hz")
        if not all(bool(value.isfinite().all()) for value in state.values() if value.is_floating_point()):
            raise ValueError("it holds numbers that are not finite")
    except UserError as error:
        raise UserError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{path} is a checkpoint whose parts do not fit together ({reason}); train again"
        ) from error
    return surrogate.eval().requires_grad_(False)


def _below(prefix: str, state: dict[str, Any]) -> dict[str, Any]:
    """The part of a state dict whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _require_plain_archive(path: Path) -> None:
    """Refuses what `torch.save` does not write by default, such as compressed parts, whose size nobody knows before."""
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            compressed = any(part.compress_type != zipfile.ZIP_STORED for part in parts)
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise ValueError(str(error)) from error
    if compressed:
        raise ValueError("its parts are compressed")
    if sum(part.file_size for part in parts) > path.stat().st_size:
        raise ValueError("its parts overlap")


def _require_tree(card: dict[str, Any]) -> None:
    """Refuses a card that is not plain values, each in its place, as JSON and YAML hold them.

    Pickles can put a list into itself, or one list into another many times: whoever writes that out never ends.
    """
    values = characters = 0
    unfinished: list[tuple[Any, int]] = [(card, 0)]
    while unfinished:
        value, depth = unfinished.pop()
        values += 1
        if isinstance(value, str):
            characters += len(value)
        elif isinstance(value, (dict, list, tuple)):
            inside = [*value.keys(), *value.values()] if isinstance(value, dict) else value
            values += len(inside)
            unfinished += [(one, depth + 1) for one in inside] if values <= _MOST_VALUES else []
        elif not (value is None or isinstance(value, (bool, float))) and not (
            isinstance(value, int) and value.bit_length() < 64
        ):
            raise ValueError(f"it holds a {type(value).__name__}")
        if depth > _DEEPEST:
            raise ValueError(f"it is nested more than {_DEEPEST} deep, or in itself")
        if values > _MOST_VALUES or characters > _MOST_TEXT:
            raise ValueError(f"it stands for more than {_MOST_VALUES} values or {_MOST_TEXT} characters")


def _require_settings(settings: Any) -> None:
    """Refuses settings of a training that the report could not name."""
    training = settings.get("training", {}) if isinstance(settings, dict) else None
    runs = settings.get("validation_runs", []) if isinstance(settings, dict) else None
    if not isinstance(training, dict) or not isinstance(runs, list):
        raise ValueError("its settings are no group of keys with a group training and a list validation_runs")
    if not all(isinstance(run, str) for run in runs):
        raise ValueError("validation_runs are not names")
    batch = training.get("batch_size", 1)
    if type(batch) is not int or batch < 1:
        raise ValueError(f"training.batch_size is {batch!r:.40}")


def _require_own_values(state: dict[str, Any]) -> None:
    """Refuses tensors that claim more values than the file holds, by strides of zero."""
    for name, value in state.items():
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            raise ValueError(f"{name} is not a plain tensor")
        if value.untyped_storage().nbytes() < value.numel() * value.element_size():
            raise ValueError(f"{name} claims more values than there are")


# --- Checkpoints that ship with the package, each with its model card; `sgns.ship` makes them -----------

PRETRAINED = Path(__file__).parents[1] / "pretrained"
"""Folder of `<name>.ckpt` and `<name>.md`."""


def pretrained_names() -> list[str]:
    """Those that ship."""
    return sorted(file.stem for file in PRETRAINED.glob("*.ckpt"))


def pretrained_file(name: str) -> Path:
    """The file of one that ships.

    Raises:
        UserError: There is none of that name.
    """
    if name not in pretrained_names():
        raise UserError(f"no pretrained checkpoint is called {name!r}; {_what_ships()}")
    return PRETRAINED / f"{name}.ckpt"


def checkpoint_file(path: str | Path) -> Path:
    """The file of a checkpoint: a plain name that is no file here may be one that ships."""
    here = Path(path)
    ships = is_plain_name(path) and not here.is_file() and here.name in pretrained_names()
    return pretrained_file(here.name) if ships else here


def is_plain_name(path: str | Path) -> bool:
    """Whether a path has no folder and no ending."""
    return Path(path).name == str(path) and not Path(path).suffix


def _what_ships() -> str:
    """As part of a sentence."""
    return f"with the package ship: {', '.join(pretrained_names()) or 'none'}"


# --- `training.json`, the numbers of a complete training, beside its checkpoint -------------------------

SUMMARY = "training.json"
_WRONG = "not the summary of a training"
_ADVICE = "remove it or train again"


def read_summary(folder: Path) -> dict[str, Any]:
    """What the summary in a folder says: at least `seconds` (wall time) and `skill`; of networks `steps`.

    Raises:
        UserError: It cannot be read, or says something else.
    """
    file = folder / SUMMARY
    summary = read_json(file, _WRONG, _ADVICE)
    if not isinstance(summary, dict):
        raise UserError(f"{file} is {_WRONG} (no group of keys); {_ADVICE}")
    # Polynomials are fitted without any steps. The skill may be NaN: nothing moved.
    values: dict[str, Any] = {"steps": 1} | summary
    for key, type_, least in (("seconds", float, 0), ("skill", float, None), ("steps", int, 1)):
        value: Any = values.get(key)
        number = isinstance(value, (int, type_)) and not isinstance(value, bool)
        if not number or (least is not None and not least <= value < math.inf):
            raise UserError(f"{file} is {_WRONG} ({key} is {value!r:.40}); {_ADVICE}")
    return summary
