"""Warp functions and kernels. Their annotations are read by Warp, so none of these files postpones them."""
