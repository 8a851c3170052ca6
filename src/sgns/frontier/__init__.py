"""What accuracy costs in time: operating points of the solver, of reductions and of surrogates on one scale."""

from sgns.frontier.point import Point, read_points, write_points

__all__ = ["Point", "read_points", "write_points"]
