"""Frames of straight elastic beams in space, an independent model of wires and struts."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from vstent.devices.design import piece_length_mm


def bending_stiffness(nodes, bars, ends, outward, *, stretch, across, along, twist):
    """Bending stiffness of a frame of bars (m, 2) about x: its `ends`, two sets of nodes, are turned as rigid bodies.

    `across` and `along` are the bending stiffnesses of a bar out of the wall, with the normals `outward`, and along it.
    """
    rows, columns, values = [], [], []
    for (a, b), normal in zip(bars, outward, strict=True):
        way = nodes[b] - nodes[a]
        h = np.linalg.norm(way)
        y = normal - (normal @ way) * way / h**2
        turn = np.kron(np.eye(4), np.stack([way / h, y / np.linalg.norm(y), np.cross(way / h, y / np.linalg.norm(y))]))
        k = np.zeros((12, 12))
        for first, modulus in ((0, stretch), (3, twist)):
            k[np.ix_([first, first + 6], [first, first + 6])] = modulus / h * np.array([[1, -1], [-1, 1]])
        for w, angle, sign, modulus in ((1, 5, 1, across), (2, 4, -1, along)):
            s = sign * h
            bend = [[12, 6 * s, -12, 6 * s], [6 * s, 4 * h**2, -6 * s, 2 * h**2]]
            bend += [[-12, -6 * s, 12, -6 * s], [6 * s, 2 * h**2, -6 * s, 4 * h**2]]
            places = [w, angle, w + 6, angle + 6]
            k[np.ix_(places, places)] += modulus / h**3 * np.array(bend)
        of_bar = np.r_[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
        rows.append(np.repeat(of_bar, 12))
        columns.append(np.tile(of_bar, 12))
        values.append((turn.T @ k @ turn).ravel())
    places = np.concatenate(rows), np.concatenate(columns)
    matrix = coo_matrix((np.concatenate(values), places), shape=(6 * len(nodes), 6 * len(nodes))).tocsc()
    moves, is_given = np.zeros(6 * len(nodes)), np.zeros(6 * len(nodes), dtype=bool)
    for held, turn in zip(ends, (-0.5, 0.5), strict=True):
        middle = np.array([0.0, 0.0, nodes[held, 2].mean()])
        for node in held:
            moves[6 * node : 6 * node + 6] = [*np.cross([turn, 0, 0], nodes[node] - middle), turn, 0, 0]
            is_given[6 * node : 6 * node + 6] = True
    free = ~is_given
    moves[free] = spsolve(matrix[free][:, free], -matrix[free][:, is_given] @ moves[is_given])
    return moves @ (matrix @ moves) * (nodes[ends[1], 2].mean() - nodes[ends[0], 2].mean())


def lattice(design, size, diameter_mm, rows):
    """Joints, struts and both ends of a laser-cut device at a diameter; crowns that are not joined are two joints."""
    length_mm, n = piece_length_mm(design, size), design.n_columns
    width_mm = np.pi * diameter_mm / n
    joints, below, above = [], {}, {}
    for row in range(rows):
        for crown, column in enumerate(range(row % 2, n, 2)):
            angle = 2 * np.pi * column / n
            place = [diameter_mm / 2 * np.cos(angle), diameter_mm / 2 * np.sin(angle), row]
            is_one = row in (0, rows - 1) or design.is_joined(row, crown)
            below[row, column] = len(joints)
            above[row, column] = len(joints) + (not is_one)
            joints += [place] * (1 if is_one else 2)
    nodes = np.array(joints) * [1, 1, np.sqrt(length_mm**2 - width_mm**2)]
    bars = [(i, below[r + 1, (c + s) % n]) for (r, c), i in above.items() if r + 1 < rows for s in (1, -1)]
    ends = [[i for (r, _), i in below.items() if r == row] for row in (0, rows - 1)]
    return nodes, np.array(bars), ends
