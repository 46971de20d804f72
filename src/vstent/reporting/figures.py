"""Render pictures of a scene without a graphics library: a depth buffer for the geometry, Pillow for the labels."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vstent.devices.stent import Deployment
from vstent.geometry.vessel import Anatomy
from vstent.kernels import raster
from vstent.kernels.arrays import Floats
from vstent.reporting.lettering import DPI, blank, color_bar, length_bar, points_px, put, put_title
from vstent.reporting.scene import LineLayer, MeshLayer, Scene, View, scene_of, view_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
COIL_MM = 0.1
"""Radius in mm that is larger than of all wires and struts, and smaller than of all coils."""
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
        return self._encoded("PNG")

    @property
    def webp(self) -> bytes:
        """The picture as WebP: about a fifth of the bytes of the PNG without a visible difference."""
        return self._encoded("WEBP", quality=WEBP_QUALITY, method=WEBP_METHOD)

    def _encoded(self, kind: str, **options: int) -> bytes:
        """Return the picture as a file of this kind."""
        from PIL import Image

        stream = io.BytesIO()
        Image.fromarray(self.image).save(stream, kind, **options)
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

    Treatments come first, if there are any; then streamlines and wall shear stress where a flow was computed; then the
    anatomy; then contour, coverage and wires where there is a device.
    """
    bare, *devices = scene.panes

    def by_value(
        name: str, ids: tuple[str, ...], title: str, caption: str, panes: Sequence[tuple[str, str]] = scene.panes
    ) -> Plate:
        """Return a picture with one panel per treatment, in profile, colored by one scale."""
        shots = [Shot(words, scene.pick(ids, pane), scene.view("profile")) for pane, words in panes]
        return Plate(name, title, caption, scene, shots, "speed" if name == "streamlines" else name)

    sides = {"profile": "In profile", "frontal": "Frontal", "lateral": "From the left"}
    layers = ("lumen", "continued", "landing", "sac", "neck")
    shots = [Shot(title, scene.pick(layers, bare[0]), scene.view(view)) for view, title in sides.items()]
    caption = "The patient's lumen (glass), the restored parent artery (sand), the sac (red) and the neck (red line)."
    anatomy = Plate("anatomy", "The artery and its sac", caption, scene, shots)
    present = {layer.id for layer in scene.layers}
    drawn = [*(by_value(*row) for row in _OF_FLOW if row[0] in present), anatomy]
    if devices:
        treated = ("lumen", "continued", "sac", "wires", "neck")
        caption = "The devices in the patient's artery with its sac; the red line is the neck."
        title = "The treatment in the artery" if len(devices) == 1 else "The treatments in the artery"
        shots = [Shot(words, scene.pick(treated, pane), scene.view("profile")) for pane, words in devices]
        drawn.insert(0, Plate("treatment", title, caption, scene, shots))
        coverage = (
            "Metal coverage: fraction of the contour covered by metal, measured on the wires and averaged over a "
            "few pores. In a bend, wires at more than 45° to the axis (flow diverters) are denser on the inner side, "
            "and those at less than 45° (laser-cut closed cells) on the outer side."
        )
        wires = (
            "The wires and the neck (red line), seen from the sac without its wall and coils. "
            "Wires on the far side are paler."
        )
        shots = [
            Shot(f"{title}: {shot.title.lower()}", shot.layers, shot.view)
            for pane, title in devices
            for shot in wire_shots(scene, pane)[-1:]
        ]
        ids = ("lumen", "continued", "coverage", "neck")
        meshes = [(pane, title) for pane, title in devices if scene.pick(("contour",), pane)]  # coils have none
        if meshes:
            drawn.append(_contours(scene, meshes))
            drawn.append(by_value("coverage", ids, "Metal coverage of the wall", coverage, meshes))
        drawn.append(Plate("wires", "Wires across the neck", wires, scene, shots))
    return drawn


_OF_FLOW = (
    (
        "streamlines",
        ("lumen", "streamlines", "neck"),
        "Blood flow before and after",
        f"Streamlines through artery and sac, colored by speed on one scale. {ABOVE}",
    ),
    (
        "shear",
        ("shear", "neck"),
        "Wall shear stress before and after",
        f"Wall shear stress on the lumen, on one scale. {ABOVE}",
    ),
    (
        "sac_shear",
        ("sac_shear", "neck"),
        "Wall shear stress of the sac",
        f"Wall shear stress of the sac alone, on the scale of the sac without a device. {ABOVE}",
    ),
)
"""Layer that a picture of the flow shows, all its layers, its title and its caption."""


def wire_shots(scene: Scene, pane: str, *more: str) -> list[Shot]:
    """Return the wires of a treatment in profile, with `more` layers, and from the sac where there is one."""
    looks = {
        "profile": ("In profile", ("lumen", "continued", "wires", "neck", *more)),
        "neck": ("Seen from the sac", ("wires", "neck")),
    }
    return [
        Shot(looks[view.id][0], _without_coils(scene.pick(looks[view.id][1], pane), view), view)
        for view in scene.views
        if view.id in looks
    ]


def _without_coils(layers: tuple[MeshLayer | LineLayer, ...], view: View) -> tuple[MeshLayer | LineLayer, ...]:
    """Return layers without coils where these would hide a stent that is seen from the sac."""
    thin = tuple(one for one in layers if not (isinstance(one, LineLayer) and one.radius_mm.max() > COIL_MM))
    return thin if view.id == "neck" and any(one.id == "wires" for one in thin) else layers


def patient_picture(anatomy: Anatomy, deployments: Sequence[Deployment]) -> Picture:
    """Return a small picture of implants in the artery of a patient, in profile, for a grid of patients."""
    scene = scene_of(anatomy, {"one": {str(k): one for k, one in enumerate(deployments)}}, {})
    view, picture = scene.views[0], blank(*PATIENT_PX)
    put(picture, draw(scene.pick(("lumen", "continued", "wires", "neck"), "one"), scene, view, PATIENT_PX), (0, 0))
    length_bar(picture, span_mm(view, PATIENT_PX), (0, 0), PATIENT_PX)
    return Picture("patient", "", "", np.asarray(picture))


def draw(layers: tuple[MeshLayer | LineLayer, ...], scene: Scene, view: View, size_px: tuple[int, int]) -> Floats:
    """Render layers seen from a view as an image (height, width, 3) of a size (width, height), 0 to 1.

    Opaque triangles and lines hide what is farther away. Translucent layers are blended over them and are denser at
    grazing angles, so that a tube shows both its outline and its contents. `scene` holds the color scales.
    """
    width, height = (n * _SUPERSAMPLING for n in size_px)
    pixel_mm = span_mm(view, size_px) / width
    light = _LIGHT / np.linalg.norm(_LIGHT)
    image = np.full((height, width, 3), BACKGROUND, np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    sums, clear = np.zeros((height, width, 4), np.float32), np.ones((height, width), np.float32)
    for layer in sorted(layers, key=lambda layer: isinstance(layer, MeshLayer) and layer.opacity < 1.0):
        seen = (layer.vertices_mm - view.center_mm) @ view.axes.T
        columns, rows = 0.5 * width + seen[:, 0] / pixel_mm, 0.5 * height - seen[:, 1] / pixel_mm
        screen = np.stack([columns, rows, -seen[:, 2]], axis=1)
        colours = _colours(layer, scene, screen[:, 2])
        if isinstance(layer, LineLayer):
            radius = np.maximum(layer.radius_mm / pixel_mm, 0.55 * _SUPERSAMPLING)
            raster.paint_wires(screen, layer.starts, radius, pixel_mm, colours, depth, image)
            continue
        normals = layer.surface.vertex_normals @ view.axes.T
        ambient = 0.72 if layer.scale else 0.50
        facing = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)  # lit on both sides
        shaded = colours * (ambient + (1.0 - ambient) * np.maximum(facing @ light, 0.0))[:, None]
        if layer.opacity < 1.0:
            grazing = (1.0 - np.abs(normals[:, 2])) ** 3
            alphas = layer.opacity + (1.0 - layer.opacity) * 0.75 * grazing
            raster.veil_triangles(screen, shaded, alphas, layer.surface.faces, depth, sums, clear)
        else:
            raster.paint_triangles(screen, shaded, layer.surface.faces, depth, image)
    return np.clip(raster.resolve(image, sums, clear, _SUPERSAMPLING), 0.0, 1.0)


def span_mm(view: View, size_px: tuple[int, int]) -> float:
    """Return the length in mm that the width of a picture (width, height) shows: the view's sphere and a margin."""
    return 2.15 * view.radius_mm * max(1.0, size_px[0] / size_px[1])


def _colours(layer: MeshLayer | LineLayer, scene: Scene, depth_mm: Floats) -> Floats:
    """Return colors (n, 3) of the points of a layer; wires are paler with their depth (n,) in mm behind the center."""
    if layer.scale:
        return scene.scale(layer.scale).paint(layer.values)
    colours = np.tile(np.array(layer.colour), (len(depth_mm), 1))
    if layer.id != "wires":
        return colours
    pale = 0.65 * np.clip(0.15 + depth_mm / scene.fade_mm, 0.0, 1.0)[:, None]
    return colours * (1 - pale) + np.array(BACKGROUND) * pale


def _contours(scene: Scene, meshes: Sequence[tuple[str, str]]) -> Plate:
    """Return the picture of the deployed contours in these panes, colored by their gap to the wall."""
    shots = []
    for pane, title in meshes:
        contours = [layer for layer in scene.pick(("contour",), pane) if isinstance(layer, MeshLayer)]
        contour = max(contours, key=lambda one: float(one.values.max()))
        largest_mm = float(contour.values.max())
        profile, is_seen = scene.view("profile"), largest_mm >= SEEN_GAP_MM
        words = f"gap up to {largest_mm:.2f} mm" if is_seen else f"gaps below {SEEN_GAP_MM:g} mm"
        view = gap_view(contour, profile) if is_seen else profile
        shots.append(Shot(f"{title}: {words}", scene.pick(("lumen", "continued", "contour", "neck"), pane), view))
    caption = (
        "The deployed contour in the lumen, colored by its gap to the wall of the parent artery, over the neck too, "
        "and seen from the side where the gap is largest."
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


def image_of(figure: "Figure") -> NDArray[np.uint8]:
    """Return a figure of matplotlib as an image (height, width, 3), at the resolution of all pictures."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def sheet(scene: Scene, shots: list[Shot], scale: str) -> NDArray[np.uint8]:
    """Return an image (height, width, 3) of panels, each with a length bar, over one common color bar.

    Four panels are laid out in two rows, others in rows of at most three. Without `scale` there is no color bar.
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
