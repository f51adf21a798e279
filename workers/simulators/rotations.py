"""Rotations as (3, 3) matrices: what scripted experts need of them."""

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]


def rotation(vector: Vector) -> Matrix:
    """The rotation by |vector| radians about the direction of `vector` (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = np.asarray(vector, np.float64) / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: Matrix = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def rotation_vector(matrix: Matrix) -> Vector:
    """The inverse of `rotation`, for angles below pi."""
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, (np.trace(matrix) - 1) / 2)
    return np.asarray(axis * (angle / sine if sine > 1e-9 else 1.0))


def about_z(angle: float) -> Matrix:
    """A turn about the vertical."""
    return rotation(np.array([0, 0, angle]))


def yaw(matrix: Matrix) -> float:
    """The angle of the turned x axis in the plane."""
    return float(np.arctan2(matrix[1, 0], matrix[0, 0]))


def wrapped(angle: float, period: float) -> float:
    """The angle nearest to 0 that differs by a multiple of the period."""
    return float((angle + period / 2) % period - period / 2)
