"""The artery that yields to the devices in view: redrawn live, with the devices moved along and not deployed again."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from vstent.deployment.motion import Motion, Skin
from vstent.deployment.straightening import Bend, Straightening, artery_beam, described, stiff
from vstent.devices.stent import Stent
from vstent.errors import InputError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.reporting.scene import Layers, LineLayer, MeshLayer, own_layers


class Yielding:
    """An artery whose first path yields to devices."""

    def __init__(self, anatomy: Anatomy) -> None:
        self.rest = artery_beam(anatomy)
        self.skin = Skin(anatomy, self.rest.rest_mm)

    @cached_property
    def scanned(self) -> Layers:
        """Layers of the artery as scanned that move with it."""
        return own_layers("", self.skin.anatomy)

    @cached_property
    def nearest(self) -> Any:
        """Vertex of the lumen (n,) next to every vertex of its layer, which has fewer."""
        return self.skin.near.query(self.scanned[0].vertices_mm)[1]

    def drawn(self, pane: str, stents: Sequence[Stent], layers: Layers, setting: str) -> tuple[Layers, dict[str, Any]]:
        """Return the layers of devices in a pane with those of the artery that has yielded, and what a message states.

        Where nothing yields, the layers stay, and the message states the reason.
        """
        try:
            bend = Bend.of(self.rest, stiff(stents), setting)
        except InputError as error:
            return layers, {"straightening": f"The artery is drawn as scanned. {error}"}
        motion = Motion.of(self.skin, bend.moved_mm)
        measures = Straightening(self.skin.anatomy, (), **bend.numbers()).metrics()
        moved = [self._moved(replace(one, pane=pane), motion) for one in (*self.scanned, *layers)]
        axis = self.skin.anatomy.parent.axis
        points_mm = motion.of_inner(axis.points_mm)
        told = {"straightening": described(measures), "moved_axis": np.round(points_mm, 3).ravel().tolist()}
        return moved, told

    def _moved(self, layer: MeshLayer | LineLayer, motion: Motion) -> MeshLayer | LineLayer:
        """Return a layer after a motion."""
        if isinstance(layer, LineLayer):
            return replace(layer, points_mm=motion.of_points(layer.points_mm))
        if layer.id == "lumen":
            moves_mm = motion.after_mm - self.skin.lumen.vertices_mm
            surface = Surface(layer.vertices_mm + moves_mm[self.nearest], layer.surface.faces)
            return replace(layer, surface=surface)
        frames_mm = None if layer.frames_mm is None else np.stack(list(map(motion.of_inner, layer.frames_mm)))
        surface = Surface(motion.of_inner(layer.vertices_mm), layer.surface.faces)
        return replace(layer, surface=surface, frames_mm=frames_mm)
