"""What `conf/model/default.yaml` says of the network and of what it sees."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from sgns.errors import UserError
from sgns.learning.body import BODY_NODES
from sgns.learning.graph import EDGES
from sgns.learning.network import ACTIVATIONS

__all__ = ["ModelSettings", "check_context"]

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
