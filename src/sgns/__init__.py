"""Granular flow under a moving tool: simulate, reduce, learn, roll out, report.

The names below are loaded when they are first used, so that `import sgns` and the command line stay quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgns.config import UserError
    from sgns.data.run import Run
    from sgns.gradients import TorchSimulator
    from sgns.reduction.basis import Basis
    from sgns.reduction.pca import IncrementalPCA
    from sgns.simulate.scene import random_paths
    from sgns.simulator import Simulator

__all__ = [
    "Basis",
    "IncrementalPCA",
    "Run",
    "Simulator",
    "TorchSimulator",
    "UserError",
    "__version__",
    "random_paths",
]

__version__ = "0.1.0"

_HOME = {
    "Basis": "sgns.reduction",
    "IncrementalPCA": "sgns.reduction",
    "Run": "sgns.data.run",
    "Simulator": "sgns.simulator",
    "TorchSimulator": "sgns.gradients",
    "UserError": "sgns.config",
    "random_paths": "sgns.simulate.scene",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sgns' has no attribute {name!r}; public names: {', '.join(__all__)}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
