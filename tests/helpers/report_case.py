"""A synthetic case for the report's tests: a bent tube with a spherical sac, two helical devices, an analytic flow."""

from functools import cache
from types import SimpleNamespace

import numpy as np

from vstent.devices.catalogue import find_design
from vstent.devices.stent import Deployment, Stent, tube_faces
from vstent.flow.case import FlowField, Level
from vstent.flow.settings import Blood
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Aneurysm, Centerline, Opening, Path, Vessel
from vstent.reporting.page import as_html, contents_of
from vstent.reporting.scene import scene_of

BEND_MM, RADIUS_MM, SAC_MM = 9.0, 2.0, 3.0
ANGLES = np.linspace(0.15, np.pi - 0.15, 90)


def arc(angles):
    return BEND_MM * np.stack([-np.cos(angles), np.zeros_like(angles), np.sin(angles)], axis=-1)


def ring_points(angles, around, radius):
    outward = np.stack([-np.cos(angles), np.zeros_like(angles), np.sin(angles)], axis=-1)
    side = np.array([0.0, 1.0, 0.0])
    return arc(angles) + np.asarray(radius)[..., None] * (
        np.cos(around)[..., None] * outward + np.sin(around)[..., None] * side
    )


def tube(radius, angles=ANGLES, columns=64):
    rows, turn = np.meshgrid(angles, np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij")
    faces = tube_faces(len(angles), columns)
    return Surface(ring_points(rows, turn, radius).reshape(-1, 3), faces[:, ::-1])


def sphere(center, radius, n=40):
    polar, turn = np.meshgrid(
        np.linspace(0.02, np.pi - 0.02, n), np.linspace(0, 2 * np.pi, 2 * n, endpoint=False), indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    return Surface(center + radius * points.reshape(-1, 3), tube_faces(n, 2 * n)[:, ::-1])


def joined(*surfaces):
    starts = np.cumsum([0, *(len(s.vertices_mm) for s in surfaces)])
    faces = [s.faces + start for s, start in zip(surfaces, starts, strict=False)]
    return Surface(np.concatenate([s.vertices_mm for s in surfaces]), np.concatenate(faces))


def patch(artery):
    """The part of the artery under the sac."""
    x, y, z = artery.corners_mm.mean(axis=1).T
    return Surface(artery.vertices_mm, artery.faces[(np.hypot(x, y) < 1.6) & (z > BEND_MM)])


SAC_CENTER = np.array([0.0, 0.0, BEND_MM + RADIUS_MM + 2.2])


def anatomy():
    artery, sac = tube(RADIUS_MM), sphere(SAC_CENTER, SAC_MM)
    axis = Centerline(arc(ANGLES), np.full(len(ANGLES), RADIUS_MM))
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    neck = np.stack(
        [1.7 * np.cos(turn), 1.5 * np.sin(turn), BEND_MM + np.sqrt(RADIUS_MM**2 - (1.5 * np.sin(turn)) ** 2)], axis=-1
    )
    ends = [
        Opening(arc(ANGLES[:1])[0], np.array([0.0, 0, -1]), np.pi * RADIUS_MM**2, "inlet"),
        Opening(arc(ANGLES[-1:])[0], np.array([0.0, 0, -1]), np.pi * RADIUS_MM**2, "outlet_1"),
    ]
    return Anatomy(
        vessel=Vessel(joined(artery, sac), tuple(ends), (axis,)),
        paths=(
            Path(PARENT, axis, np.full(len(ANGLES), RADIUS_MM), artery, np.zeros(len(artery.vertices_mm), dtype=bool)),
        ),
        aneurysms=(Aneurysm(sac, patch(artery), neck),),
    )


def deployment(key, hands, rows=60, columns=36):
    design = find_design(key)
    angles = np.linspace(0.9, np.pi - 0.9, rows)
    grid = np.meshgrid(angles, np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij")
    history = np.stack([ring_points(*grid, radius) for radius in np.linspace(0.9, 1.95, 8)])
    along = np.linspace(0, 1, 200)
    wires = [
        ring_points(0.9 + along * (np.pi - 1.8), 2 * np.pi * (k / hands + sign * 2.5 * along), np.full(200, 1.95))
        for k in range(hands)
        for sign in (1, -1)
    ]
    stent = Stent(
        design=design,
        size=design.sizes[0],
        nodes_mm=history[-1],
        row_abscissa_mm=BEND_MM * (angles - ANGLES[0]),
        wire_points_mm=np.concatenate(wires),
        wire_starts=200 * np.arange(len(wires) + 1),
        wire_diameter_um=np.where(np.arange(len(wires)) % 6 == 0, 50.0, 30.0),
    )
    gap = 0.03 + 0.25 * np.exp(-(((grid[0] - 1.2) / 0.15) ** 2)) * (1 + np.cos(grid[1])) / 2
    energy = np.linspace(8, 1, len(history))
    return Deployment(
        stent, "terminated", "It spans the neck and lies well.", np.linspace(0.1, 1, 7), 0.41, gap, history, energy
    )


CELL_MM = 0.4


def field(strength):
    """Poiseuille flow round the bend and a solid-body vortex in the sac, on a coarse grid."""
    cells = np.stack(np.meshgrid(*[np.arange(70)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    origin = np.full(3, -12.0)
    centers = origin + CELL_MM * cells
    radial = np.hypot(centers[:, 0], centers[:, 2])
    off = np.hypot(radial - BEND_MM, centers[:, 1])
    in_tube = (off < RADIUS_MM) & (centers[:, 2] > 1)
    blood = in_tube | (np.linalg.norm(centers - SAC_CENTER, axis=1) < SAC_MM)
    cells, centers, radial, off, in_tube = (a[blood] for a in (cells, centers, radial, off, in_tube))
    round_bend = np.stack([centers[:, 2], 0 * radial, -centers[:, 0]], axis=1) / radial[:, None]
    spin = np.cross([0.0, 1.0, 0.0], centers - SAC_CENTER) * 0.05 * strength
    wall = joined(tube(RADIUS_MM), sphere(SAC_CENTER, SAC_MM))
    is_artery = np.arange(len(wall.vertices_mm)) < len(tube(RADIUS_MM).vertices_mm)
    shear = np.where(is_artery, 3.0 + wall.vertices_mm[:, 0] / 6, 1.5 * strength)
    velocity = np.where(in_tube[:, None], 0.5 * (1 - (off / RADIUS_MM) ** 2)[:, None] * round_bend, spin)
    return FlowField(
        levels=(Level(cells, origin, CELL_MM, velocity, -10 * centers[:, 0]),),
        wall=wall,
        wall_shear_stress_Pa=shear[:, None] * np.array([1.0, 0, 0]),
        wall_pressure_Pa=np.zeros(len(shear)),
        inlets_mL_s=np.array([3.4]),
        outlets_mL_s=np.array([3.4]),
        inlet_pressure_Pa=np.array([80.0]),
        outlet_pressure_Pa=np.zeros(1),
        blood=Blood(),
        is_converged=True,
        unsettled_fraction=0.001,
        advice="Converged.",
        residual=np.array([0.1, 0.001]),
        steps=100,
        seconds=1.0,
        updates_per_s=1e7,
    )


def flow_metrics(strength):
    return {
        "neck_inflow_mL_s": 0.412 * strength,
        "mean_sac_velocity_m_s": 0.0812 * strength,
        "turnover_time_s": 0.271 / strength,
        "mean_sac_wss_Pa": 1.53 * strength,
        "low_shear_area_fraction": 0.123 / strength,
        "outlet_flow_mL_s": {"outlet_1": 3.37},
        "converged": True,
    }


def metrics():
    treatments = {"bare": {"flow": flow_metrics(1.0)}}
    for name, strength in (("silk", 0.62), ("enterprise", 0.87)):
        flow = flow_metrics(strength)
        measures = {
            "deployed_length_mm": 13.47,
            "largest_wall_gap_mm": 0.281,
            "n_nodes": 2160,
            "coverage_fraction": 0.2816,
        }
        treatments[name] = {
            "implants": {name: measures},
            "flow": flow,
            "change": {"neck_inflow_ratio": strength, "mean_sac_velocity_ratio": strength},
        }
    vessel = {
        "sac_volume_mm3": 111.9,
        "neck_area_mm2": 8.02,
        "artery_radius_mm": 2.004,
        "bend_angle_rad": 1.31,
        "n_outlets": 1,
    }
    return {"vessel": vessel, "treatments": treatments}


def case(name="Bent tube with a sac"):
    fields = {"bare": field(1.0), "silk": field(0.62), "enterprise": field(0.87)}
    return SimpleNamespace(
        name=name,
        anatomy=anatomy(),
        implants={"silk": {"silk": deployment("silk", 24)}, "enterprise": {"enterprise": deployment("enterprise", 5)}},
        fields=fields,
        metrics=metrics(),
        provenance={
            "vstent": "0.1.0",
            "inputs": {"artery.vtp": {"sha256": "9f" * 32, "bytes": 123456}},
            "settings": {"threshold": None, "cell_size_mm": 0.2},
            "versions": {"python": "3.11.4", "numpy": "2.1.0"},
            "seconds": {"trace": 1.25, "deploy": 0.83},
        },
        notes=("Units were guessed as mm from the size of the artery.",),
        keys={},
        whole=None,
        yielded={},
        shown=fields,
    )


@cache
def scene():
    shown = case()
    return scene_of(shown.anatomy, shown.implants, shown.fields)


@cache
def contents():
    return contents_of(case())


@cache
def html():
    return as_html(contents())
