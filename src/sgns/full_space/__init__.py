"""The reference without a reduction: the graph network on every particle, edges between near ones."""
