"""Run files: what a simulation or a rollout leaves on disk."""

from sgns.runs.runcheck import check_run
from sgns.runs.runfile import Run
from sgns.runs.runwriter import RunWriter

__all__ = ["Run", "RunWriter", "check_run"]
