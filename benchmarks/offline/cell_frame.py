"""How stiff the cells of a laser-cut device are: its struts as elastic beams, welded together where they meet.

Run from the repository, offline, seconds: ``python benchmarks/offline/cell_frame.py``. What comes out is kept beside
it in ``cell_frame.json``, beside which ``tests/test_deploy_cells.py`` holds `vstent.deploy.cells`.
Nothing of vstent's deployment is used, only the catalogue's strut sections and angles.

The model. The free device is a frame in space: every strut is an arc on the cylinder, cut into straight beams of Euler
and Bernoulli with the strut's rectangular section (bending both ways, torsion, stretching; Przemieniecki 1968, Theory
of Matrix Structural Analysis, eq. 5.116), rigid over the half of a joint at either end. Displacements are small.
Everything is measured against what a strut resists to being stretched, so the metal's modulus cancels out; of Poisson's
ratio, 0.33 for nitinol, only torsion hears.

Joints are lifted off the cylinder by a little, everything else gives way, and the energy is compared with that of
ideal struts with springs across the cells (``spring``) and lines of struts that bend when their joints are lifted
otherwise than their neighbours (``bending``). The whole device opened or closed tells the first, ovals, which are
twice as wide as high, the second.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from vstent import device

POISSON = 0.33
ELEMENTS = 8
"""Beams of a strut."""
ROWS = 13
HALF_WAVES = (0, 1, 2, 3)
"""Of an oval along the device."""
OUT = Path(__file__).with_suffix(".json")


class Frame:
    """The free device as a frame of beams, and as joints with ideal struts and springs."""

    def __init__(self, design: device.LaserCut, size: device.Size) -> None:
        """Lay the joints on the cylinder, (rows, n / 2)."""
        self.n, self.radius = design.n_columns, 0.5 * size.free_diameter_mm
        self.width, self.thickness = 1e-3 * design.strut_width_um, 1e-3 * design.strut_thickness_um
        self.angle_rad = design.angle_rad
        self.row_mm = 2 * np.pi * self.radius / self.n / np.tan(design.angle_rad)
        row, column = np.nonzero(np.add.outer(np.arange(ROWS), np.arange(self.n)) % 2 == 0)
        self.row, self.column = row, column
        number = np.full((ROWS, self.n), -1)
        number[row, column] = np.arange(len(row))
        self.number = number
        low = np.flatnonzero(row < ROWS - 1)
        self.ends = np.concatenate(
            [np.stack([low, number[row[low] + 1, (column[low] + hand) % self.n]]) for hand in (1, -1)], axis=1
        )
        self.hand = np.repeat([1, -1], len(low))

    def place(self, row: Any, column: Any) -> np.ndarray:
        """Points (..., 3) of the cylinder at fractional rows and columns."""
        turn = 2 * np.pi * np.asarray(column) / self.n
        return np.stack(
            [self.radius * np.cos(turn), self.radius * np.sin(turn), self.row_mm * np.asarray(row)], axis=-1
        )

    @property
    def turn_rad(self) -> np.ndarray:
        """(j,) angles of the joints round the axis."""
        return 2 * np.pi * self.column / self.n

    @property
    def axes(self) -> np.ndarray:
        """(3 j, 3 j) columns: moves of every joint along, around and off the wall."""
        cosine, sine, none = np.cos(self.turn_rad), np.sin(self.turn_rad), 0 * self.turn_rad
        of = np.stack([[none, none, none + 1], [-sine, cosine, none], [-cosine, -sine, none]]).transpose(2, 1, 0)
        return block_diag(*of)

    @property
    def length_mm(self) -> float:
        """Length of a strut along the cylinder."""
        return float(np.hypot(self.row_mm, 2 * np.pi * self.radius / self.n))

    @property
    def joint_mm(self) -> float:
        """Length that two strips of metal have in common where they meet."""
        return float(self.width / np.sin(2 * self.angle_rad))

    def stiffness(self) -> csc_matrix:
        """Stiffness (6 nodes, 6 nodes) over E; joints come first, then the inner nodes of the struts."""
        share = np.linspace(0, 1, ELEMENTS + 1)
        joints, rows, columns, values = len(self.row), [], [], []
        for strut, (a, b) in enumerate(self.ends.T):
            points = self.place(self.row[a] + share, self.column[a] + self.hand[strut] * share)
            nodes = np.concatenate([[a], joints + strut * (ELEMENTS - 1) + np.arange(ELEMENTS - 1), [b]])
            for k in range(ELEMENTS):
                dof = (6 * nodes[[k, k + 1], None] + np.arange(6)).ravel()
                rigid = [0.5 * self.joint_mm * (k == 0), 0.5 * self.joint_mm * (k == ELEMENTS - 1)]
                values.append(self._beam(points[k], points[k + 1], rigid).ravel())
                rows.append(np.repeat(dof, 12))
                columns.append(np.tile(dof, 12))
        n = 6 * (joints + self.ends.shape[1] * (ELEMENTS - 1))
        return csc_matrix(coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (n, n)))

    def _beam(self, start: np.ndarray, end: np.ndarray, rigid_mm: list[float]) -> np.ndarray:
        """Stiffness (12, 12) over E of one beam, rigid over some length at either end."""
        b, t = self.width, self.thickness
        ahead = (end - start) / np.linalg.norm(end - start)
        middle = 0.5 * (start + end) * [1, 1, 0]
        radial = middle - (middle @ ahead) * ahead
        radial /= np.linalg.norm(radial)
        turned = np.stack([ahead, np.cross(radial, ahead), radial])
        length = np.linalg.norm(end - start) - sum(rigid_mm)
        local = _euler_bernoulli(length, b * t, b**3 * t / 12, t**3 * b / 12, _torsion(b, t) / (2 * (1 + POISSON)))
        to_local = np.kron(np.eye(4), turned)
        arms = np.eye(12)
        for end_of, arm in ((0, rigid_mm[0] * ahead), (6, -rigid_mm[1] * ahead)):
            x, y, z = arm
            arms[end_of : end_of + 3, end_of + 3 : end_of + 6] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        whole = to_local @ arms
        return whole.T @ local @ whole


def _torsion(b: float, t: float) -> float:
    """Torsion constant of a rectangle (Timoshenko and Goodier 1951, Theory of Elasticity, art. 94, to 0.5 %)."""
    a, c = max(b, t), min(b, t)
    return a * c**3 * (1 / 3 - 0.21 * c / a * (1 - (c / a) ** 4 / 12))


def _euler_bernoulli(length: float, area: float, in_plane: float, radial: float, torsion: float) -> np.ndarray:
    """Stiffness (12, 12) over E of a beam along x; y lies in the wall, z is radial."""
    k = np.zeros((12, 12))
    for first, value in ((0, area), (3, torsion)):
        k[np.ix_([first, first + 6], [first, first + 6])] = value / length * np.array([[1, -1], [-1, 1]])
    for moves, second_moment, sign in (((1, 5, 7, 11), in_plane, 1), ((2, 4, 8, 10), radial, -1)):
        s = sign * length
        block = [[12, 6 * s, -12, 6 * s], [6 * s, 4 * s * s, -6 * s, 2 * s * s]]
        block += [[-12, -6 * s, 12, -6 * s], [6 * s, 2 * s * s, -6 * s, 4 * s * s]]
        k[np.ix_(moves, moves)] = second_moment / length**3 * np.array(block)
    return k


def condensed(frame: Frame) -> np.ndarray:
    """Twice the energy (3 j, 3 j) of moves of the joints, turns and inner nodes giving way, over E A / L of a strut."""
    whole, joints = frame.stiffness(), len(frame.row)
    kept = (6 * np.arange(joints)[:, None] + np.arange(3)).ravel()
    rest = np.setdiff1d(np.arange(whole.shape[0]), kept)
    across = whole[rest][:, kept].toarray()
    left = whole[kept][:, kept].toarray() - across.T @ splu(csc_matrix(whole[rest][:, rest])).solve(across)
    return frame.axes.T @ left @ frame.axes * frame.length_mm / (frame.width * frame.thickness)


def ideal(frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Energies (3 j, 3 j) of struts that stretch, of springs and of bending lines of struts, at stiffness 1."""
    number, n = frame.number, frame.n
    wide = [[number[r, c], number[r, (c + 2) % n]] for r, c in zip(frame.row, frame.column, strict=True)]
    high = [[number[r, c], number[r + 2, c]] for r, c in zip(frame.row, frame.column, strict=True) if r + 2 < ROWS]
    lines = [
        [number[r + way, (c + way * hand) % n] for way in (-1, 0, 1)]
        for r, c in zip(frame.row, frame.column, strict=True)
        for hand in (1, -1)
        if 0 < r < ROWS - 1
    ]
    bent = np.zeros((len(lines), 3 * len(frame.row)))
    for k, joints in enumerate(lines):
        bent[k, 3 * np.array(joints) + 2] = 1, -2, 1
    slopes = [_stretching(frame, frame.ends.T), _stretching(frame, np.array(wide + high)), bent]
    stretching, opening, bending = (slope.T @ slope for slope in slopes)
    return stretching, opening, bending


def _stretching(frame: Frame, pairs: np.ndarray) -> np.ndarray:
    """How much further apart pairs of joints (p, 2) get by moves (3 j,)."""
    joints_mm, slopes = frame.place(frame.row, frame.column), np.zeros((len(pairs), 3 * len(frame.row)))
    for k, (a, b) in enumerate(pairs):
        ahead = (joints_mm[b] - joints_mm[a]) / np.linalg.norm(joints_mm[b] - joints_mm[a])
        slopes[k, 3 * a : 3 * a + 3], slopes[k, 3 * b : 3 * b + 3] = -ahead, ahead
    return slopes @ frame.axes


def lifted(energy: np.ndarray, lift: np.ndarray) -> float:
    """Energy when the joints are lifted by (j,) and give way along and around."""
    off = np.arange(2, len(energy), 3)
    rest = np.setdiff1d(np.arange(len(energy)), off)
    inner, across = energy[np.ix_(rest, rest)], energy[np.ix_(rest, off)] @ lift
    return float(lift @ energy[np.ix_(off, off)] @ lift - across @ np.linalg.pinv(inner, rcond=1e-10) @ across)


def derive(design: device.LaserCut, size: device.Size) -> dict[str, float]:
    """Stiffnesses of springs and of lines of struts with which ideal struts resist as the frame does."""
    frame = Frame(design, size)
    welded, (stretching, opening, bending) = condensed(frame), ideal(frame)
    ovals = [np.cos(2 * frame.turn_rad) * np.cos(np.pi * k * frame.row / (ROWS - 1)) for k in HALF_WAVES]

    def too_stiff(spring: float, bend: float, lifts: list[np.ndarray]) -> float:
        ours = stretching + spring**2 * opening + bend**2 * bending
        return float(np.mean([np.log(lifted(ours, lift) / lifted(welded, lift)) for lift in lifts]))

    spring, bend = 0.03, 0.01
    for _ in range(4):
        now = bend
        spring = brentq(lambda x: too_stiff(x, now, [np.ones(len(frame.row))]), 1e-3, 0.3, xtol=1e-6)  # noqa: B023
        held = spring
        bend = brentq(lambda x: too_stiff(held, x, ovals), 1e-4, 0.3, xtol=1e-6)  # noqa: B023
    misfit = [too_stiff(spring, bend, [oval]) for oval in ovals]
    return {"spring": round(spring, 5), "bending": round(bend, 5), "oval_energy_within": round(np.ptp(misfit), 3)}


def main() -> None:
    found = {}
    for key in ("enterprise", "neuroform_atlas"):
        design = device.find_design(key)
        found[key] = derive(design, design.sizes[-1])
    OUT.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
