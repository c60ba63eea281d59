"""Float64 NumPy oracles of the energies: plain formulas on plain arrays, sharing no code with the package."""

import numpy as np


def unit(vectors):
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


# --- set `consistent` ---------------------------------------------------------------------------------------


def face_areas(positions, faces):
    a, b, c = (positions[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def stretch(position, rest, faces, mu, lame_lambda, thickness):
    rest_edges, edges = (x[faces[:, :2]] - x[faces[:, 2:]] for x in (rest, position))
    # G = (C - I) / 2 has the traces of the metrics' quotient, whatever the frame of the rest triangle.
    quotient = np.linalg.solve(*(e @ np.swapaxes(e, 1, 2) for e in (rest_edges, edges)))
    green = 0.5 * (quotient - np.eye(2))
    squares, trace = np.einsum("fij,fji->f", green, green), np.einsum("fii->f", green)
    return np.sum(face_areas(rest, faces) * thickness * (mu * squares + 0.5 * lame_lambda * trace**2))


def interior_edges(faces):
    """Return (i, j, left, right, left face, right face) of every interior edge, found edge by edge."""
    directed = {}
    for f, (a, b, c) in enumerate(faces):
        for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
            directed[i, j] = (k, f)
    rows = []
    for (i, j), (left, left_face) in sorted(directed.items()):
        if i < j and (j, i) in directed:
            right, right_face = directed[j, i]
            rows.append((i, j, left, right, left_face, right_face))
    return np.array(rows).reshape(-1, 6)


def dihedral(position, edges):
    """Return the signed angles between the two faces of interior edges, zero where flat."""
    i, j, left, right = (position[edges[:, k]] for k in range(4))
    direction = unit(j - i)
    first, second = unit(np.cross(j - i, left - i)), unit(np.cross(right - i, j - i))
    sine = np.sum(direction * np.cross(first, second), axis=1)
    return np.arctan2(sine, np.sum(first * second, axis=1))


def bending(position, rest, faces, stiffness, *, current_length=False):
    edges = interior_edges(faces)
    areas = face_areas(rest, faces)
    summed = areas[edges[:, 4]] + areas[edges[:, 5]]
    of = position if current_length else rest
    squared_length = np.sum((of[edges[:, 1]] - of[edges[:, 0]]) ** 2, axis=1)
    return np.sum(stiffness * squared_length / (4 * summed) * dihedral(position, edges) ** 2 / 2)


def masses(rest, faces, density):
    areas = np.zeros(len(rest))
    np.add.at(areas, faces, face_areas(rest, faces)[:, None] / 3)
    return density * areas


def inertia(position, guess, mass, timestep):
    return np.sum(mass[:, None] * (position - guess) ** 2) / (2 * timestep**2)


def gravity(position, reference, mass, acceleration):
    return acceleration * np.sum(mass * (position - reference)[:, 1])


def collision(position, points, normals, is_near, area, stiffness, thickness):
    height = np.einsum("va,va->v", position - points, normals)
    return stiffness * np.sum((area * np.maximum(thickness - height, 0) ** 3)[is_near])


def friction(position, start, points, next_points, normals, load, coefficient, slip):
    motion = (position - start) - (next_points - points)
    tangential = motion - np.einsum("va,va->v", motion, normals)[:, None] * normals
    return coefficient * np.sum(load * (np.sqrt(np.sum(tangential**2, axis=1) + slip**2) - slip))


# --- set `hood` ---------------------------------------------------------------------------------------------


def face_planes(body, faces):
    """Return centroids and unit normals, HOOD's normal being (v2 - v1) x (v0 - v1)."""
    v0, v1, v2 = (body[faces[:, k]] for k in range(3))
    return (v0 + v1 + v2) / 3, unit(np.cross(v2 - v1, v0 - v1))


def nearest(points, centers):
    squared = np.sum((points[:, None] - centers[None]) ** 2, axis=2)
    return np.argmin(squared, axis=1), np.min(squared, axis=1)


def hood_collision(position, query, search_body, body, faces, weight, thickness):
    index, _ = nearest(query, face_planes(search_body, faces)[0])
    centers, normals = face_planes(body, faces)
    height = np.sum((position - centers[index]) * normals[index], axis=1)
    return weight * np.sum(np.maximum(thickness - height, 0) ** 3)


def hood_friction(position, start, body_before, body, faces, mass, coefficient, acceleration, radius):
    (centers_before, normals_before), (centers, normals) = (
        face_planes(mesh, faces) for mesh in (body_before, body)
    )
    first, first_squared = nearest(start, centers_before)
    last, last_squared = nearest(position, centers)
    total = 0.0
    for v in range(len(position)):
        if not (first_squared[v] < radius and last_squared[v] < radius):
            continue
        motion = position[v] - (start[v] + centers[first[v]] - centers_before[first[v]])
        normal = 0.5 * (normals_before[first[v]] + normals[last[v]])
        tangential = motion - motion @ normal * normal
        length = np.linalg.norm(tangential)
        cosine = tangential[2] / length if length > 0 else 0.0
        total += mass[v] * np.sqrt(abs(1 - cosine**2) + 1e-4) * length
    return coefficient * acceleration * total
