"""Pose graphs in the g2o text format, as benchmark problems come."""

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, rotation_from_quat_wxyz, se3, se3_adjoint
from mapserver.survey.pose_graph.pose_graph import PoseEdge

_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def parse_g2o(text: str) -> tuple[Array, list[PoseEdge]]:
    """Starting map_from_body (K, 4, 4), by rising vertex id, and the edges of a graph of SE(3) vertices and edges.

    An edge between vertices that do not follow each other is a loop. The information matrices are read as those of a
    rotation vector, as gtsam does (g2o itself means the vector part of the quaternion). Other line tags, planar ones
    too, numbers that are none, double or unknown vertices raise SurveyError with the line.
    """
    vertices: dict[int, Array] = {}
    rows: list[tuple[int, int, Array]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        tag, *fields = line.split() or [""]
        try:
            if tag == _VERTEX and int(fields[0]) not in vertices and len(fields) == 8:
                vertices[int(fields[0])] = _numbers(fields[1:])
            elif tag == _EDGE and len(fields) == 30:
                rows.append((int(fields[0]), int(fields[1]), _numbers(fields[2:])))
            elif tag not in ("", "FIX"):
                raise ValueError(f"known are {_VERTEX} with 8 numbers, once for each vertex, and {_EDGE} with 30")
        except (ValueError, IndexError) as error:
            raise SurveyError(f"g2o line {number}: {line[:60]!r} ({error}); correct the file") from error
    index = {vertex: k for k, vertex in enumerate(sorted(vertices))}
    strange = sorted({vertex for i, j, _ in rows for vertex in (i, j)} - set(index))
    if strange:
        raise SurveyError(f"g2o: edges join vertices {strange[:5]} that the file does not place; add their lines")
    map_from_body = np.array([_se3_of(vertices[vertex]) for vertex in index]).reshape(-1, 4, 4)
    return map_from_body, [_edge(index[i], index[j], numbers) for i, j, numbers in rows]


def _numbers(fields: list[str]) -> Array:
    numbers = np.array([float(field) for field in fields])
    if not np.isfinite(numbers).all() or np.linalg.norm(numbers[3:7]) < 0.5:
        raise ValueError("not finite, or no quaternion")
    return numbers


def _se3_of(numbers: Array) -> Array:
    """(4, 4) of x y z qx qy qz qw."""
    return se3(rotation_from_quat_wxyz(numbers[[6, 3, 4, 5]]), numbers[:3])


def _edge(i: int, j: int, numbers: Array) -> PoseEdge:
    """The edge of 7 numbers of transform and 21 of information: upper triangle, translation first, axes of j."""
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = numbers[7:]
    information = (upper + np.triu(upper, 1).T)[np.ix_(_ROTATION_FIRST, _ROTATION_FIRST)]
    i_from_j = _se3_of(numbers)
    carried = se3_adjoint(i_from_j)
    return PoseEdge(i, j, i_from_j, carried @ np.linalg.inv(information) @ carried.T, is_loop=abs(i - j) != 1)
