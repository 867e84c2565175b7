"""Shapes are equal by content and checked when they are made, and a hull contains all its vertices."""

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.geometry import Shape, hfield, hull, point_distance

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def test_shapes_are_equal_by_content():
    assert Shape("box", (1, 2, 3)) == Shape("box", np.array([1.0, 2.0, 3.0]))
    assert hash(Shape("sphere", (0.5, 0, 0))) == hash(Shape("sphere", (0.5,)))  # as MuJoCo has it in geom_size
    assert Shape("capsule", (1, 2)) != Shape("cylinder", (1, 2))
    heights = np.array([[0.0, 0.1], [0.2, 0.3]])
    field, equal_field, higher_field = (hfield(h, (1, 1, 0.5, 0.1)) for h in (heights, heights.copy(), heights + 0.1))
    assert field == equal_field
    assert hash(field) == hash(equal_field)
    assert field != higher_field
    assert hull(CUBE) == hull(CUBE.copy())
    assert hull(CUBE) != hull(2 * CUBE)


@pytest.mark.parametrize("n", [4, 12, 40])
def test_a_hull_is_closed_and_contains_its_vertices(rng, n):
    vertices = rng.normal(size=(n, 3))
    shape = hull(vertices)
    assert np.max(vertices @ shape.normals.T - shape.offsets) < 1e-12
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1)
    corners = shape.vertices[shape.faces]
    # Divergence theorem: the areas of a closed surface add up to zero, and outward triangles give a positive volume.
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(area.sum(axis=0), 0, atol=1e-12)
    assert np.sum(area * corners[:, 0]) > 0
    assert len(shape.vertices) - 1.5 * len(shape.faces) + len(shape.faces) == 2  # Euler
    flipped_faces = shape.faces[:, [0, 2, 1]]
    assert set(map(tuple, np.round(hull(shape.vertices, flipped_faces).normals, 9))) == set(
        map(tuple, np.round(shape.normals, 9))
    )


@pytest.mark.parametrize("make, message", [
    (lambda: Shape("torus", (1, 1)), "kind plane, sphere.*got 'torus'"),
    (lambda: Shape("box", (1, 2)), r"expected 3 positive.*box.*got \(1.0, 2.0\)"),
    (lambda: Shape("sphere", (0,)), "positive"),
    (lambda: Shape("sphere", (np.nan,)), "finite"),
    (lambda: Shape("mesh"), "expected a mesh with vertices"),
    (lambda: point_distance(Shape("rectangle", (1, 1)), np.zeros(3)), "expected a solid, got a rectangle"),
    (lambda: Shape("hfield", (1, 1, 1, 1)), "expected a hfield with heights"),
    (lambda: hull(CUBE[:3]), r"got \(3, 3\)"),
    (lambda: hull(CUBE * [1, 1, 0]), "one plane"),
    (lambda: hull(CUBE * 1e300), "of a size up to"),
    (lambda: hull(CUBE * 1e-300), "one plane"),
    (lambda: hull(np.random.default_rng(0).normal(size=(65, 3))), "got 65 vertices and no faces"),
    (lambda: hull(CUBE, [[0, 1, 8]]), "expected faces of vertices 0 to 7, got 0 to 8"),
    (lambda: hull(CUBE, [[0.0, 1, 2]]), "integers"),
    (lambda: hull(CUBE, [[0, 3, 5]]), "expected the triangles of the convex hull"),
    (lambda: hull(CUBE, hull(CUBE).faces[1:]), "not closed"),
    (lambda: hull(CUBE, [[0, 3, 5], [0, 5, 6], [0, 6, 3], [3, 6, 5]]), "leave a vertex 1.15 m outside"),
    (lambda: hfield(np.zeros((1, 5)), (1, 1, 1, 1)), r"\(1, 5\)"),
    (lambda: hfield(np.full((2, 5), 2.0), (1, 1, 1, 1)), "between 0 and 1.0 m, got 2.0 to 2.0"),
])  # fmt: skip
def test_law_09_wrong_input_is_an_error_at_once(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
