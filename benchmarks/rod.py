"""A single rod in a sphere, by vstent's coils and by PyElastica (Cosserat rods): shape and bending energy.

``python benchmarks/rod.py`` needs PyElastica 1.0 (``pip install pyelastica``); it runs for a minute.
"""

from typing import Any

import elastica as ea
import numpy as np

from vstent.kernels import rods
from vstent.kernels.arrays import Floats

WOUND_MM, SPHERE_MM, LENGTH_MM = 0.3, 2.5, 12.0
LAWS = rods.Laws(WOUND_MM, 1.04 * WOUND_MM, 3e4 * WOUND_MM, 1.2, 1 / 1.5, 20.0)
"""The numbers with which coils are placed (`vstent.deployment.coils`)."""
INNER_MM = SPHERE_MM - 0.5 * LAWS.diameter
FINER = 2
"""Elements of the referee per segment; both press on the wall at as many points."""


def curls(kind: str, place: Floats) -> Floats:
    """Return natural curvature (n, 2) in 1/mm at relative places: loops in one plane, or two turned by 90 degrees."""
    if kind == "flat":
        return np.tile([1 / 6, 0.0], (len(place), 1))
    turn = np.pi / 2 * np.clip(10 * place - 4.5, 0, 1)
    return np.stack([np.cos(turn), np.sin(turn)], axis=1) / 3.5


def start(count: int) -> Floats:
    """Return nodes (count + 1, 3) of an arc that fits, lifted a little out of its plane."""
    turn = np.linspace(0.0, LENGTH_MM / 1.9, count + 1)
    return np.stack([1.9 * np.cos(turn), 1.9 * np.sin(turn), 0.25 * np.sin(1.7 * turn)], axis=1)


def axes(nodes: Floats) -> tuple[Floats, Floats]:
    """Return unit tangents (n, 3) and the first material axes (n, 3) of segments, as if without twist."""
    along = np.diff(nodes, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.cross([0.0, 0.0, 1.0], along)
    return along, first / np.linalg.norm(first, axis=1, keepdims=True)


def ours(kind: str) -> tuple[Floats, float, float]:
    """Return nodes and bending energy of the rod by vstent, and the imbalance of its forces."""
    count = round(LENGTH_MM / WOUND_MM)
    x = start(count)
    first = np.concatenate([axes(x)[1], np.zeros((1, 3))])
    natural = curls(kind, np.arange(count + 1) / count) * WOUND_MM
    is_segment = np.r_[np.ones(count, bool), False]
    state = rods.Rods(x, first, natural, is_segment, np.zeros(count + 1, bool))
    low, spacing = np.full(3, -3.2), 0.1
    field = np.linalg.norm(low[:, None, None, None] + spacing * np.indices((65, 65, 65)), axis=0) - SPHERE_MM
    for drag, steps in 6 * ((0.1, 300), (1.0, 300), (10.0, 200), (100.0, 200)):
        imbalance = rods.advance(state, LAWS, count + 1, (field, low, spacing), drag, steps, np.zeros(3), 0)[1]
    n = count + 1
    work = np.zeros((n, 3)), np.zeros(n), np.zeros((3 * n, rods.BAND)), np.zeros((n, 2))
    return state.x, rods._bend(state, LAWS, 0, n, *work), imbalance


class Sphere(ea.NoForces):
    """The wall, with the law of contact of `vstent.kernels.rods`."""

    def apply_forces(self, system: Any, time: float = 0.0) -> None:
        """Push nodes back that are outside."""
        x = system.position_collection
        away = np.linalg.norm(x, axis=0)
        deep = np.maximum(away - INNER_MM, 0.0)
        push = LAWS.contact * deep * (1 + rods.HARDENING * (deep / LAWS.diameter) ** 2)
        system.external_forces -= push / np.maximum(away, 1e-9) * x


class Simulator(ea.BaseSystemCollection, ea.Forcing, ea.Damping):
    """A rod, a wall and a damper."""


def referee(kind: str, duration: float = 120.0, step: float = 1e-3) -> tuple[Floats, float, float]:
    """Return nodes and bending energy of the rod by PyElastica, after damped motion, and the speed that remains."""
    count = FINER * round(LENGTH_MM / WOUND_MM)
    x = start(count)
    along, first = axes(x)
    directors = np.stack([first, np.cross(along, first), along]).transpose(0, 2, 1)
    radius = 0.5 * WOUND_MM
    young = 4 / (np.pi * radius**4)  # bending stiffness 1
    rod = ea.CosseratRod.straight_rod(
        count, x[0], along[0], first[0], LENGTH_MM, radius, 1.0, youngs_modulus=young, shear_modulus=young / 2,
        position=x.T.copy(), directors=directors,
    )  # fmt: skip
    rod.bend_matrix[:] = np.diag([1.0, 1.0, LAWS.twist])[:, :, None]
    natural = curls(kind, np.arange(1, count) / count)
    rod.rest_kappa[:2] = -natural[:, 1], natural[:, 0]  # about the first and second axis
    simulator = Simulator()
    simulator.append(rod)
    simulator.add_forcing_to(rod).using(Sphere)
    simulator.dampen(rod).using(ea.AnalyticalLinearDamper, damping_constant=0.15, time_step=step)
    simulator.finalize()
    ea.integrate(ea.PositionVerlet(), simulator, duration, round(duration / step), progress_bar=False)
    speed = np.linalg.norm(rod.velocity_collection, axis=0).max()
    return rod.position_collection.T.copy(), float(rod.compute_bending_energy()), speed


def apart(nodes: Floats, others: Floats) -> float:
    """Return the largest distance between curves of nodes, one turned and moved (or mirrored) onto the other."""
    fine = np.linspace(0, 1, 200)
    a, b = (np.stack([np.interp(fine, np.linspace(0, 1, len(x)), c) for c in x.T], axis=1) for x in (nodes, others))
    best = np.inf
    for curve in (b, b * [1, 1, -1]):
        u, _, v = np.linalg.svd(a.T @ curve)  # both have the sphere's middle in common
        turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
        best = min(best, np.linalg.norm(a - curve @ turn.T, axis=1).max())
    return best


def main() -> None:
    """Print both energies and the distance of the shapes."""
    for kind in ("flat", "turned"):
        nodes, energy, imbalance = ours(kind)
        others, energy_there, speed = referee(kind)
        print(
            f"{kind}: energy {energy:.4f}, PyElastica {energy_there:.4f} ({energy / energy_there - 1:+.1%}); "
            f"{apart(nodes, others) / WOUND_MM:.2f} wound diameters apart; remaining force {imbalance:.1%}, "
            f"speed {speed:.1e}"
        )


if __name__ == "__main__":
    main()
