"""A campaign of small cuts, planned without torch: processes that make it begin quickly."""

from pathlib import Path
from typing import Any

from mpm_warp import Effects, Scene
from sgns.simulate.campaign import Campaign, plan

BASE = {
    "kind": "excavation",
    "duration": 0.05,
    "blade": {"length": 0.1, "width": 0.1, "thickness": 0.08, "edge": "square"},
    "bed": {"size": [0.4, 0.2, 0.16], "spacing": 0.04},
}
EFFECTS = {"yielding": True, "rate_dependence": True, "separation": True}


def campaign(folder: Path, seed: int = 0, **change: Any) -> Campaign:
    """Ten small cuts; keyword arguments change the settings of the dataset."""
    settings = {
        "name": "tiny",
        "path": str(folder / "tiny"),
        "draw": {"rake": [0.0, 10.0], "depth": [0.02, 0.04, 0.05], "blade.friction": [0.1, 0.3]},
        "runs": 10,
    }
    return plan(settings | change, BASE, EFFECTS, "float32", seed)


def job(scene: Scene, file: Path) -> Any:
    """A run as a campaign sends it to a worker process."""
    from sgns.simulate.workers import _Job

    effects = Effects()
    physics = {"effects": effects, "reasons": effects.described(), "seed": 0}
    physics |= {"device": "cpu", "precision": "float32"}
    return _Job("tiny", 0, scene.to_dict(), scene.meshes, file, physics)
