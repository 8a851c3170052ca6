"""From particles to a few modes: incremental PCA, its basis, and the reduced runs of a dataset."""

from sgns.reduction.basis import CENTRINGS, Basis
from sgns.reduction.pca import IncrementalPCA

__all__ = ["CENTRINGS", "Basis", "IncrementalPCA"]
