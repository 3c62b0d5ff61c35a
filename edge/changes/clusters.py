# SPDX-License-Identifier: Apache-2.0
"""Groups of points of the space that lie close together."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from edge.types import F64


def clusters(xyz: F64, link_m: F64, least: int) -> list[NDArray[np.int64]]:
    """Rows of each group of at least `least` points (n, 3), each linked over its own `link_m` (n,).

    In the order of their first points.
    """
    n = len(xyz)
    if n < least:
        return []
    pairs = cKDTree(xyz).query_pairs(float(link_m.max()), output_type="ndarray")
    apart = np.linalg.norm(xyz[pairs[:, 0]] - xyz[pairs[:, 1]], axis=1)
    pairs = pairs[apart < np.minimum(link_m[pairs[:, 0]], link_m[pairs[:, 1]])]
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(links, directed=False)
    rows = (np.flatnonzero(label == c) for c in range(count))
    return [group for group in rows if len(group) >= least]
