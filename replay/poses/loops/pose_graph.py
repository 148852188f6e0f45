"""Pose graphs: nodes joined by measured motions, of which some may be wrong; the poses that fit them best.

Levenberg and Marquardt's steps; robust edges lose their weight by Huber's function first, from far away, then by
Geman and McClure's (Barron, «A general and adaptive robust loss function», 2019, has both).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from replay.poses.loops.block_cholesky import BlockCholesky, edge_slots, elimination_pattern
from replay.poses.loops.kernels import EdgeArrays, normal_equations, squared_residuals
from replay.poses.loops.options import GraphOptions


class RobustLoss(NamedTuple):
    """A function that squared normalised residuals count by.

    Attributes:
        cost: What a squared residual (E,) costs, by the scale at which it begins to cost less.
        weight: The slope of that: the weight (E,) of an edge.
    """

    cost: Callable[[FloatArray, float], FloatArray]
    weight: Callable[[FloatArray, float], FloatArray]


def _huber_cost(squares: FloatArray, scale: float) -> FloatArray:
    return np.where(squares < scale, squares, 2.0 * np.sqrt(scale * squares) - scale)


def _huber_weight(squares: FloatArray, scale: float) -> FloatArray:
    return np.asarray(np.sqrt(scale / np.maximum(squares, scale)))


def _geman_mcclure_cost(squares: FloatArray, scale: float) -> FloatArray:
    return scale * squares / (scale + squares)


def _geman_mcclure_weight(squares: FloatArray, scale: float) -> FloatArray:
    return (scale / (scale + squares)) ** 2


HUBER = RobustLoss(_huber_cost, _huber_weight)
GEMAN_MCCLURE = RobustLoss(_geman_mcclure_cost, _geman_mcclure_weight)


class PoseGraph:
    """Nodes in the frame of the first one, and the motions measured between them.

    Args:
        poses: (N, 3) to begin at: x, y (m), heading (rad).
        edges: The motions.
        robust: (E,) which of them may be wrong.
        options: Losses and steps.
    """

    def __init__(
        self, poses: FloatArray, edges: EdgeArrays, robust: NDArray[np.bool_], options: GraphOptions
    ) -> None:
        self.poses, self.edges, self.robust = poses.astype(float), edges, robust
        self.squares, self.weights = np.empty(len(robust)), np.ones(len(robust))
        self._options = options
        self._pattern = elimination_pattern(len(poses), edges.first, edges.last)
        self._slots = edge_slots(self._pattern, edges.first, edges.last)
        self._diagonal = np.empty((len(poses), 3, 3))
        self._below = np.empty((len(self._pattern.rows), 3, 3))

    def optimise(self, loss: RobustLoss) -> None:
        """Find the poses of the least cost, from those that the graph has.

        Args:
            loss: That of robust edges; others' residuals count by their squares.
        """
        options, damping = self._options, self._options.damping
        cost = self._cost(self.poses, loss)
        for _ in range(options.steps):
            right = self._linearised(loss)
            scales = np.einsum("nii->ni", self._diagonal).copy()
            while True:
                step = self._damped_step(right, damping * scales)
                moved = self.poses if step is None else self.poses + step
                new = cost if step is None else self._cost(moved, loss)
                if step is not None and new <= cost:
                    break
                damping *= options.damping_factor
                if damping > options.most_damping:
                    self._weigh(loss)
                    return
            self.poses, cost = moved, new
            damping = max(damping / options.damping_factor, options.least_damping)
            if np.abs(step).max() < options.tolerance:
                break
        self._weigh(loss)

    def factor(self) -> BlockCholesky:
        """Return the factor of the information of all poses, by the edges' weights as they are."""
        self._set_equations()
        return BlockCholesky(self._pattern, self._diagonal, self._below)

    def _cost(self, poses: FloatArray, loss: RobustLoss) -> float:
        squared_residuals(poses, self.edges, self.squares)
        robust = loss.cost(self.squares[self.robust], self._options.scale).sum()
        return float(self.squares[~self.robust].sum() + robust)

    def _weigh(self, loss: RobustLoss) -> None:
        squared_residuals(self.poses, self.edges, self.squares)
        self.weights[self.robust] = loss.weight(self.squares[self.robust], self._options.scale)

    def _linearised(self, loss: RobustLoss) -> FloatArray:
        """Set the normal equations; return their right hand side (N, 3), by columns of the pattern."""
        self._weigh(loss)
        return self._set_equations()

    def _set_equations(self) -> FloatArray:
        right = np.empty((len(self.poses), 3))
        normal_equations(
            self.poses, self.edges, self.weights, self._pattern, self._slots, self._diagonal, self._below, right
        )
        self._diagonal[self._pattern.places[0]] += np.eye(3) / self._options.first_std**2
        return right

    def _damped_step(self, right: FloatArray, damping: FloatArray) -> FloatArray | None:
        """Return a step (N, 3) of the nodes; None where the equations have no solution."""
        damped = self._diagonal + damping[:, :, None] * np.eye(3)
        factor = BlockCholesky(self._pattern, damped, self._below)
        return factor.solve(right[self._pattern.places][:, :, None])[:, :, 0] if factor.is_positive else None
