"""Row operations of the transfers against numpy, in the form for the CPU and in that for a GPU."""

import numpy as np
import pytest
import warp as wp

from mpm_warp.kernels.grid import row_operations


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
@pytest.mark.parametrize("gpu", [False, True])
def test_row_operations(real, gpu):
    """Node k of row 2..4 of six nodes: everything the transfers do with a row, once."""
    lanes = row_operations(real, gpu)
    vec3, vec4, row = wp.types.vector(3, real), wp.types.vector(4, real), lanes.row
    plus, gather, scatter, spread, fold = lanes.plus, lanes.gather, lanes.scatter, lanes.spread, lanes.fold

    @wp.kernel(module="unique", enable_backward=False)
    def use(nodes: wp.array(dtype=vec4), given: wp.array(dtype=vec4), w: vec3, folded: wp.array(dtype=vec4)):
        r = gather(nodes, 2)
        folded[0] = fold(w, r)
        folded[1] = fold(w, plus(row(), real(3.0), r))
        scatter(nodes, 2, spread(w, given[0], given[1]))

    rng = np.random.default_rng(0)
    before, given, w = rng.normal(size=(6, 4)), rng.normal(size=(2, 4)), rng.normal(size=3)
    nodes = wp.array(before, dtype=vec4, device="cpu")
    folded = wp.zeros(2, dtype=vec4, device="cpu")
    wp.launch(use, 1, [nodes, wp.array(given, dtype=vec4, device="cpu"), vec3(*w)], [folded], device="cpu")
    tolerance = {"atol": 1e-5 if real is wp.float32 else 1e-14}
    np.testing.assert_allclose(folded.numpy()[0], w @ before[2:5], **tolerance)
    np.testing.assert_allclose(folded.numpy()[1], 3.0 * w @ before[2:5], **tolerance)
    after = before.copy()
    after[2:5] += w[:, None] * (given[0] + np.arange(3)[:, None] * given[1])
    np.testing.assert_allclose(nodes.numpy(), after, **tolerance)
