"""Sparse Cholesky factors of 3 x 3 blocks: in which order nodes are eliminated, solutions, marginal covariances."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from replay.poses.loops.kernels import Pattern, factorise, selected_inverse, substitute


def elimination_pattern(count: int, first: NDArray[np.intp], last: NDArray[np.intp]) -> Pattern:
    """Order nodes by minimum degree, and find which blocks of the factor are not zero.

    Args:
        count: How many nodes there are.
        first: (E,) nodes that edges join …
        last: (E,) … with these.

    Returns:
        The pattern.
    """
    neighbours: list[set[int]] = [set() for _ in range(count)]
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        neighbours[a].add(b)
        neighbours[b].add(a)
    queue = [(len(others), node) for node, others in enumerate(neighbours)]
    heapq.heapify(queue)
    order: list[int] = []
    columns: list[set[int]] = []
    is_done = [False] * count
    while queue:
        degree, node = heapq.heappop(queue)
        if is_done[node] or degree != len(neighbours[node]):
            continue
        is_done[node], around = True, neighbours[node]
        order.append(node)
        columns.append(around)
        for other in around:
            near = neighbours[other]
            near |= around
            near.discard(other)
            near.discard(node)
            heapq.heappush(queue, (len(near), other))
    places = np.empty(count, np.intp)
    places[order] = np.arange(count)
    rows = [np.sort(places[list(column)]) if column else np.zeros(0, np.intp) for column in columns]
    starts = np.concatenate(([0], np.cumsum([len(one) for one in rows]))).astype(np.intp)
    return Pattern(places, starts, np.concatenate(rows).astype(np.intp) if rows else np.zeros(0, np.intp))


def edge_slots(pattern: Pattern, first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.intp]:
    """Find the blocks below the diagonal that edges between nodes belong to.

    Args:
        pattern: The factor's pattern.
        first: (E,) nodes.
        last: (E,) nodes.

    Returns:
        (E,) indices of blocks.
    """
    count = len(pattern.places)
    columns = np.repeat(np.arange(count), np.diff(pattern.starts))
    a, b = pattern.places[first], pattern.places[last]
    return np.searchsorted(columns * count + pattern.rows, np.minimum(a, b) * count + np.maximum(a, b))


class BlockCholesky:
    """The factor of a symmetric positive definite matrix of blocks, as nodes have them.

    Args:
        pattern: Its pattern.
        diagonal: (N, 3, 3) the matrix's blocks on the diagonal, by columns of the pattern.
        below: (K, 3, 3) those below.
    """

    def __init__(self, pattern: Pattern, diagonal: FloatArray, below: FloatArray) -> None:
        self._pattern = pattern
        self._roots, self._factor = np.empty_like(diagonal), np.empty_like(below)
        self.is_positive = bool(factorise(pattern, diagonal, below, self._roots, self._factor))

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve equations.

        Args:
            right: (N, 3, M) right hand sides, by nodes.

        Returns:
            The solutions (N, 3, M), by nodes.
        """
        ordered = np.empty((len(right), 3, right.shape[2]))
        ordered[self._pattern.places] = right
        substitute(self._pattern, self._roots, self._factor, ordered)
        return ordered[self._pattern.places]

    def column(self, node: int) -> FloatArray:
        """Return a node's columns of the inverse.

        Args:
            node: Its index.

        Returns:
            (N, 3, 3): the cross-covariances of all nodes with it, where the matrix is the information.
        """
        right = np.zeros((len(self._roots), 3, 3))
        right[node] = np.eye(3)
        return self.solve(right)

    def marginals(self) -> FloatArray:
        """Return the blocks (N, 3, 3) on the diagonal of the inverse, by nodes."""
        diagonal, below = np.empty_like(self._roots), np.empty_like(self._factor)
        selected_inverse(self._pattern, self._roots, self._factor, diagonal, below)
        return diagonal[self._pattern.places]
