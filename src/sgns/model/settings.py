"""What `conf/model` says of the network or the polynomials."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from sgns.config import UserError, check_fields
from sgns.model.features import BODY_NODES, EDGES
from sgns.model.network import ACTIVATIONS

# --- What `conf/model/default.yaml` says of the network and of what it sees -----------------------------

_LEAST = {
    "history": 2,
    "hidden_width": 1,
    "hidden_layers": 1,
    "message_passing_steps": 1,
    "identity_width": 0,
}
_WORDS = {
    "body_nodes": BODY_NODES,
    "identity": ("mode", "type"),
    "edges": EDGES,
    "activation": tuple(ACTIVATIONS),
    "force": ("sum", "mean"),
    "predicts": ("acceleration", "velocity"),
    "kind": ("network",),
}


@dataclass(frozen=True)
class ModelSettings:
    """The values of `conf/model/default.yaml`; see there for the meaning of each key."""

    history: int
    body_nodes: str
    positions: bool
    next_motion: bool
    identity: str
    identity_width: int
    context: list[str]
    edges: str
    self_loops: bool
    edge_scale: float | None
    edge_length: bool
    hidden_width: int
    hidden_layers: int
    message_passing_steps: int
    layer_norm: bool
    residual: bool
    activation: str
    predicts: str
    rigid: bool
    force: str
    torque: bool
    kind: str = "network"

    def __post_init__(self) -> None:
        for key, low in _LEAST.items():
            if getattr(self, key) < low:
                raise UserError(f"model.{key} is {getattr(self, key)}; it must be at least {low}")
        for key, allowed in _WORDS.items():
            if getattr(self, key) not in allowed:
                raise UserError(f"model.{key} is {getattr(self, key)!r}; allowed: {', '.join(allowed)}")
        check_context(self.context)
        if self.edge_scale is not None and not 0 < self.edge_scale < math.inf:
            raise UserError(
                f"model.edge_scale is {self.edge_scale}; it must be a length above 0 [m], or null"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return {"kind": self.kind} | asdict(self)


def check_context(keys: Any) -> None:
    """Refuses a `model.context` that is no list of keys."""
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise UserError(f"model.context is {keys!r}; it must be a list of keys of the scene")


# --- What `conf/model/polynomial.yaml` and `conf/training/polynomial.yaml` say --------------------------


@dataclass(frozen=True)
class PolynomialSettings:
    """The values of `conf/model/polynomial.yaml`; see there for the meaning of each key."""

    history: int
    degree: int
    context: list[str]
    kind: str = "polynomial"

    def __post_init__(self) -> None:
        if self.kind != "polynomial":
            raise UserError(f"model.kind is {self.kind!r}; allowed: polynomial")
        if self.history < 2:
            raise UserError(f"model.history is {self.history}; it must be at least 2")
        if self.degree not in (1, 2):
            raise UserError(f"model.degree is {self.degree}; allowed: 1, 2")
        check_context(self.context)

    @property
    def body_nodes(self) -> str:
        """The body is always shown as its pose."""
        return "pose"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return {"kind": self.kind} | asdict(self)


@dataclass(frozen=True)
class FitSettings:
    """The values of `conf/training/polynomial.yaml`; see there for the meaning of each key."""

    noises: list[float]
    penalties: list[float]
    linear: bool
    draws: int
    normalisation_floor: float
    resume: str | bool
    threads: int | None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FitSettings:
        """From plain values, checked.

        Raises:
            UserError: A value is out of range; the line names the key.
        """
        check_fields(cls, values, "training")
        settings = cls(**values)
        for key in ("noises", "penalties"):
            found = getattr(settings, key)
            if not isinstance(found, list) or not found or not all(map(_is_share, found)):
                raise UserError(f"training.{key} is {found!r}; it must be a list of numbers, 0 or more")
        for key, low in (("draws", 1), ("normalisation_floor", 0), ("threads", 1)):
            value = getattr(settings, key)
            if value is not None and value < low:
                raise UserError(f"training.{key} is {value}; it must be at least {low}")
        if settings.resume not in ("auto", False):
            raise UserError(f"training.resume is {settings.resume!r}; allowed: auto, false")
        return settings

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a checkpoint."""
        return asdict(self)


def _is_share(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < math.inf


# --- Which kind of latent dynamics a `model` describes: a network or polynomials. Everywhere else they are

_SETTINGS: dict[Any, type[ModelSettings] | type[PolynomialSettings]] = {
    "network": ModelSettings,
    "polynomial": PolynomialSettings,
}


def model_settings(model: Mapping[str, Any]) -> ModelSettings | PolynomialSettings:
    """The settings in the values of `conf/model`, checked.

    Raises:
        UserError: A value is unknown or not allowed for this kind; the line names its key.
    """
    kind = model.get("kind")
    if kind not in _SETTINGS:
        raise UserError(f"model.kind is {kind!r}; allowed: {', '.join(_SETTINGS)}")
    check_fields(_SETTINGS[kind], model, "model")
    return _SETTINGS[kind](**model)
