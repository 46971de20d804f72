"""Render pictures of a scene without a graphics library: a depth buffer for the geometry, Pillow for the labels."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vstent.devices.stent import Deployment
from vstent.devices.treatment import BARE
from vstent.geometry.vessel import Anatomy
from vstent.kernels import raster
from vstent.kernels.arrays import Floats
from vstent.reporting.lettering import blank, color_bar, length_bar, points_px, put, put_title
from vstent.reporting.scene import LineLayer, MeshLayer, Scene, View, scene_of, view_of

BACKGROUND = (0.965, 0.973, 0.978)
"""Background color: red, green and blue, 0 to 1."""
_TITLE_PX, _FOOT_PX, _EDGE_PX = 45, 93, 15
"""Heights of the titles, of the color bar and of the edge without one, in pixels; the edge also parts the panels."""
_LIGHT = np.array([-0.35, 0.50, 0.79])
"""Direction to the light in view axes (right, up, toward the eye), not normalized."""
_SUPERSAMPLING = 2
"""Rendered pixels per picture pixel along each axis, averaged to smooth the edges."""
PATIENT_PX = (420, 320)
"""Width and height of the picture of one patient in a cohort, in pixels."""
SEEN_GAP_MM = 0.1
"""Gap in mm from which a contour is shown from the side of its largest gap."""
WEBP_QUALITY = 90
"""Quality of the pictures in the HTML report, 0 to 100, as defined by Pillow's WebP writer."""
WEBP_METHOD = 2
"""Effort of that writer, 0 to 6: higher efforts take longer and make slightly smaller files."""
ABOVE = "Values above the scale have its last color."
"""Caption sentence on values above a color scale."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered picture with its title and caption."""

    id: str
    """Name of what it shows: anatomy, contour, coverage, wires, streamlines, shear."""
    title: str
    """Title, one line."""
    caption: str
    """Caption: what the picture shows and what its colors mean."""
    image: NDArray[np.uint8]
    """(height, width, 3) red, green and blue."""

    @property
    def png(self) -> bytes:
        """The picture as PNG, without metadata, so that equal pictures give equal bytes."""
        return _encoded(self.image, "PNG")

    @property
    def webp(self) -> bytes:
        """The picture as WebP: about a fifth of the bytes of the PNG without a visible difference."""
        return _encoded(self.image, "WEBP", quality=WEBP_QUALITY, method=WEBP_METHOD)


def _encoded(image: NDArray[np.uint8], kind: str, **options: int) -> bytes:
    """Return an image as a file of this kind."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, **options)
    return stream.getvalue()


@dataclass(frozen=True, eq=False)
class Plate:
    """A picture to be drawn."""

    id: str
    """Name of what it shows."""
    title: str
    """Title, one line."""
    caption: str
    """Caption."""
    scene: Scene
    """Scene that holds the color scales."""
    shots: list["Shot"]
    """Panels of the picture."""
    scale: str = ""
    """Name of the scale of the color bar; empty: no color bar."""

    def drawn(self) -> Picture:
        """Return the picture."""
        return Picture(self.id, self.title, self.caption, sheet(self.scene, self.shots, self.scale))


@dataclass(frozen=True, eq=False)
class Shot:
    """One panel of a picture: layers and the view from which they are drawn."""

    title: str
    """Title above the panel."""
    layers: tuple[MeshLayer | LineLayer, ...]
    """Layers to draw."""
    view: View
    """View from which they are drawn."""


def plates(scene: Scene) -> list[Plate]:
    """Return the pictures of a scene, to be drawn.

    The anatomy is always shown; contour, coverage and wires where there is a device; streamlines and wall shear stress
    where a flow was computed.
    """
    found = [_anatomy(scene)]
    if len(scene.panes) > 1:
        found += [_contour(scene), _coverage(scene), _wires(scene)]
    drawn = {layer.id for layer in scene.layers}
    if "streamlines" in drawn:
        found.append(_streamlines(scene))
    if "shear" in drawn:
        found.append(_shear(scene))
    if "sac_shear" in drawn:
        found.append(_sac_shear(scene))
    return found


def patient_picture(anatomy: Anatomy, deployments: Sequence[Deployment]) -> Picture:
    """Return a small picture of implants in the artery of a patient, in profile, for a grid of patients.

    Parameters
    ----------
    anatomy : vessel, parent artery and sacs.
    deployments : the deployed implants.
    """
    scene = scene_of(anatomy, {"one": {str(k): one for k, one in enumerate(deployments)}}, {})
    view, picture = scene.views[0], blank(*PATIENT_PX)
    put(picture, draw(scene.pick(("lumen", "continued", "wires", "neck"), "one"), scene, view, PATIENT_PX), (0, 0))
    length_bar(picture, span_mm(view, PATIENT_PX), (0, 0), PATIENT_PX)
    return Picture("patient", "", "", np.asarray(picture))


def overview(scene: Scene) -> bytes:
    """Return one wide PNG that sums up a case: wires across the neck, and streamlines where a flow was computed."""
    layers = ("lumen", "continued", "wires", "neck", "streamlines")
    shots = [Shot(title, scene.pick(layers, pane), scene.view("profile")) for pane, title in scene.panes]
    scales = {scale.id for scale in scene.scales}
    return Plate("overview", "", "", scene, shots, "speed" if "speed" in scales else "").drawn().png


def draw(layers: tuple[MeshLayer | LineLayer, ...], scene: Scene, view: View, size_px: tuple[int, int]) -> Floats:
    """Render layers seen from a view.

    Opaque triangles and lines hide what is farther away. Translucent layers are blended over them and are denser at
    grazing angles, so that a tube shows both its outline and its contents.

    Parameters
    ----------
    layers : meshes and lines to draw.
    scene : scene that holds their color scales.
    view : direction, center and radius of the view.
    size_px : width and height of the image in pixels.

    Returns (height, width, 3) red, green and blue, 0 to 1.
    """
    width, height = (n * _SUPERSAMPLING for n in size_px)
    pixel = span_mm(view, size_px) / width
    image = np.full((height, width, 3), BACKGROUND, np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    sums, clear = np.zeros((height, width, 4), np.float32), np.ones((height, width), np.float32)
    for layer in sorted(layers, key=_is_translucent):
        points = layer.points_mm if isinstance(layer, LineLayer) else layer.surface.vertices_mm
        screen = _to_screen(points, view, pixel, (width, height))
        colours = _colours(layer, scene, screen[:, 2])
        if isinstance(layer, LineLayer):
            radius = np.maximum(layer.radius_mm / pixel, 0.55 * _SUPERSAMPLING)
            raster.paint_wires(screen, layer.starts, radius, pixel, colours, depth, image)
            continue
        normals = layer.surface.vertex_normals @ view.axes.T
        shaded = colours * _brightness(normals, 0.72 if layer.scale else 0.50)[:, None]
        if _is_translucent(layer):
            alphas = _alphas(layer.opacity, normals)
            raster.veil_triangles(screen, shaded, alphas, layer.surface.faces, depth, sums, clear)
        else:
            raster.paint_triangles(screen, shaded, layer.surface.faces, depth, image)
    return np.clip(raster.resolve(image, sums, clear, _SUPERSAMPLING), 0.0, 1.0)


def _is_translucent(layer: MeshLayer | LineLayer) -> bool:
    """Return whether a layer is a mesh with an opacity below 1."""
    return isinstance(layer, MeshLayer) and layer.opacity < 1.0


def span_mm(view: View, size_px: tuple[int, int]) -> float:
    """Return the length in mm that the width of a picture shows.

    The sphere of the view fits into the picture with a small margin.

    Parameters
    ----------
    view : the view.
    size_px : width and height of the picture in pixels.
    """
    return 2.15 * view.radius_mm * max(1.0, size_px[0] / size_px[1])


def _to_screen(points_mm: Floats, view: View, pixel: float, size: tuple[int, int]) -> Floats:
    """Return points (n, 3) as column and row in pixels and depth in mm; `pixel` is the size of a pixel in mm."""
    seen = (points_mm - view.center_mm) @ view.axes.T
    return np.stack([0.5 * size[0] + seen[:, 0] / pixel, 0.5 * size[1] - seen[:, 1] / pixel, -seen[:, 2]], axis=1)


def _colours(layer: MeshLayer | LineLayer, scene: Scene, depth_mm: Floats) -> Floats:
    """Return colors (n, 3) of the points of a layer; wires are paler with their depth (n,) in mm behind the center."""
    if layer.scale:
        return scene.scale(layer.scale).paint(layer.values)
    colours = np.tile(np.array(layer.colour), (len(depth_mm), 1))
    if layer.id != "wires":
        return colours
    pale = 0.65 * np.clip(0.15 + depth_mm / scene.fade_mm, 0.0, 1.0)[:, None]
    return colours * (1 - pale) + np.array(BACKGROUND) * pale


def _brightness(normals: Floats, ambient: float) -> Floats:
    """Return the brightness (n,) of a surface lit on both sides, from unit normals (n, 3) in view axes."""
    facing = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    return ambient + (1.0 - ambient) * np.maximum(facing @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0)


def _alphas(opacity: float, normals: Floats) -> Floats:
    """Return the opacity (n,) of vertices: higher where the surface is seen at a grazing angle."""
    return opacity + (1.0 - opacity) * 0.75 * (1.0 - np.abs(normals[:, 2])) ** 3


def _anatomy(scene: Scene) -> Plate:
    """Return the picture of vessel, parent artery, sac and neck from three sides."""
    ids = ("lumen", "continued", "landing", "sac", "neck")
    titles = {"profile": "In profile", "frontal": "Frontal", "lateral": "From the left"}
    shots = [Shot(title, scene.pick(ids, BARE), scene.view(view)) for view, title in titles.items()]
    caption = "The patient's lumen (glass), the restored parent artery (sand), the sac (red) and the neck (red line)."
    return Plate("anatomy", "The artery and its sac", caption, scene, shots)


def _contour(scene: Scene) -> Plate:
    """Return the picture of the deployed contours, colored by their gap to the wall."""
    ids = ("lumen", "continued", "contour", "neck")
    shots = []
    for pane, title in scene.panes[1:]:
        contour = next(layer for layer in scene.pick(("contour",), pane) if isinstance(layer, MeshLayer))
        largest_mm = float(contour.values.max())
        profile, is_seen = scene.view("profile"), largest_mm >= SEEN_GAP_MM
        words = f"gap of {largest_mm:.2f} mm" if is_seen else f"gaps below {SEEN_GAP_MM:g} mm"
        view = gap_view(contour, profile) if is_seen else profile
        shots.append(Shot(f"{title}: {words}", scene.pick(ids, pane), view))
    caption = (
        "The deployed contour in the lumen, colored by its gap to the wall of the parent artery and seen from the side "
        "where the gap is largest."
    )
    return Plate("contour", "Position of the devices", caption, scene, shots, "wall_gap")


def gap_view(contour: MeshLayer, profile: View) -> View:
    """Return the view of a contour from the side where it is farthest from the wall."""
    normals = contour.surface.vertex_normals
    # A high power of the gap leaves the place of the largest one, and is smooth where several are equal.
    toward = ((contour.values / contour.values.max()) ** 8) @ normals
    toward /= np.linalg.norm(toward)
    right, up, _ = profile.axes
    up = up if abs(float(up @ toward)) < 0.9 else right
    up = up - (up @ toward) * toward
    up /= np.linalg.norm(up)
    return view_of("gap", np.stack([np.cross(up, toward), up, toward]), contour.surface.vertices_mm)


def _coverage(scene: Scene) -> Plate:
    """Return the picture of the metal coverage of each device."""
    ids = ("lumen", "continued", "coverage", "neck")
    shots = [Shot(title, scene.pick(ids, pane), scene.view("profile")) for pane, title in scene.panes[1:]]
    caption = (
        "Metal coverage: fraction of the contour covered by metal, measured on the wires and averaged over a "
        "few pores; higher on the inside of a bend, lower on its outside."
    )
    return Plate("coverage", "Metal coverage of the wall", caption, scene, shots, "coverage")


def _wires(scene: Scene) -> Plate:
    """Return the picture of the wires in profile and seen from the sac."""
    looks = {
        "profile": ("in profile", ("lumen", "continued", "wires", "neck")),
        "neck": ("seen from the sac", ("wires", "neck")),
    }
    shots = [
        Shot(f"{title}: {looks[view.id][0]}", scene.pick(looks[view.id][1], pane), view)
        for pane, title in scene.panes[1:]
        for view in scene.views
        if view.id in looks
    ]
    caption = (
        "The wires and the neck (red line), seen from the sac with its wall removed; wires on the far side are paler."
    )
    return Plate("wires", "Wires across the neck", caption, scene, shots)


def _streamlines(scene: Scene) -> Plate:
    """Return the picture of the streamlines without and with each device."""
    ids = ("lumen", "streamlines", "neck")
    shots = [Shot(title, scene.pick(ids, pane), scene.view("profile")) for pane, title in scene.panes]
    caption = f"Streamlines through artery and sac, colored by speed on one scale. {ABOVE}"
    return Plate("streamlines", "Blood flow before and after", caption, scene, shots, "speed")


def _shear(scene: Scene) -> Plate:
    """Return the picture of the wall shear stress without and with each device."""
    shots = [Shot(title, scene.pick(("shear", "neck"), pane), scene.view("profile")) for pane, title in scene.panes]
    caption = f"Wall shear stress on the lumen, on one scale. {ABOVE}"
    return Plate("shear", "Wall shear stress before and after", caption, scene, shots, "shear")


def _sac_shear(scene: Scene) -> Plate:
    """Return the picture of the sac's wall shear stress on its own scale, without and with each device."""
    ids = ("sac_shear", "neck")
    shots = [Shot(title, scene.pick(ids, pane), scene.view("profile")) for pane, title in scene.panes]
    caption = f"Wall shear stress of the sac alone, on the scale of the sac without a device. {ABOVE}"
    return Plate("sac_shear", "Wall shear stress of the sac", caption, scene, shots, "sac_shear")


def sheet(scene: Scene, shots: list[Shot], scale: str) -> NDArray[np.uint8]:
    """Return an image (height, width, 3) of panels side by side, each with a length bar, over one common color bar.

    Parameters
    ----------
    scene : scene that holds the color scales.
    shots : panels; four are laid out in two rows, others in rows of at most three.
    scale : name of the scale of the color bar; empty: no color bar.
    """
    columns = 2 if len(shots) == 4 else min(len(shots), 3)
    rows = -(-len(shots) // columns)
    panel = (760, 560) if columns < 3 else (520, 480)
    foot = _FOOT_PX if scale else _EDGE_PX
    picture = blank(columns * (panel[0] + _EDGE_PX) - _EDGE_PX, rows * (panel[1] + _TITLE_PX) + foot)
    for number, shot in enumerate(shots):
        row, column = divmod(number, columns)
        left, top = column * (panel[0] + _EDGE_PX), row * (panel[1] + _TITLE_PX) + _TITLE_PX
        put(picture, draw(shot.layers, scene, shot.view, panel), (left, top))
        put_title(picture, shot.title, left, top - points_px(4))
        length_bar(picture, span_mm(shot.view, panel), (left, top), panel)
    if scale:
        chosen = scene.scale(scale)
        color_bar(picture, chosen.colours, (chosen.low, chosen.high), f"{chosen.title} [{chosen.unit}]")
    return np.asarray(picture)
