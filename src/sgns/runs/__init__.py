"""Run files: what a simulation or a rollout leaves on disk."""

from sgns.runs.chunks import frame_chunks
from sgns.runs.runcheck import check_run
from sgns.runs.runfile import Run
from sgns.runs.runwriter import RunWriter

__all__ = ["Run", "RunWriter", "check_run", "frame_chunks"]
