"""Pack a scene for the viewer: a small JSON manifest and one block of bytes.

Every array is an integer block ``{offset, length, type}`` in the bytes, little-endian, at a multiple of 4. A quantized
array also has ``low`` and ``step``, one per component: number = low + step * integer. Contours over time are one block
of all frames. In the report the bytes are compressed with zlib and encoded in base64. Over HTTP they follow the
manifest (`Packer.framed`): the length of its JSON in four bytes, the JSON padded with spaces to a multiple of 4, and
the bytes.
"""

import base64
import json
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vstent.kernels.arrays import Floats
from vstent.reporting.scene import LineLayer, MeshLayer, Scale, Scene, View

LEVELS = 65_535
"""Largest quantized integer; it fits in two bytes."""


class Packer:
    """Collects arrays in one block of bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, integers: Any) -> dict[str, Any]:
        """Append unsigned integers of 1, 2 or 4 bytes and return the description of their block."""
        array = np.ascontiguousarray(integers)
        data = array.astype(array.dtype.newbyteorder("<")).tobytes()
        block = {"offset": self._length, "length": array.size, "type": f"u{8 * array.itemsize}"}
        padded = data + bytes(-len(data) % 4)
        self._parts.append(padded)
        self._length += len(padded)
        return block

    def add_indices(self, indices: Any) -> dict[str, Any]:
        """Append indices as 2-byte integers, or as 4-byte integers where they are larger; return their block."""
        wide = np.max(indices, initial=0) > LEVELS
        return self.add(np.asarray(indices).ravel().astype(np.uint32 if wide else np.uint16))

    def add_numbers(self, numbers: Floats) -> dict[str, Any]:
        """Append numbers (..., d) with each component quantized to 65,536 levels in its range; return their block."""
        columns = np.nan_to_num(numbers).reshape(-1, numbers.shape[-1])
        low, high = columns.min(axis=0, initial=np.inf), columns.max(axis=0, initial=-np.inf)
        if not len(columns):
            low = high = np.zeros(columns.shape[1])
        step = (high - low) / LEVELS
        levels = np.rint((columns - low) / np.where(step > 0, step, 1.0))
        return {**self.add(levels.astype(np.uint16)), "low": low.tolist(), "step": step.tolist()}

    def text(self) -> str:
        """Return all blocks compressed with zlib, as base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode("ascii")

    def framed(self, manifest: Mapping[str, Any]) -> bytes:
        """Return a manifest and all blocks as one message."""
        words = json.dumps(manifest, separators=(",", ":"), allow_nan=False).encode()
        words += b" " * (-len(words) % 4)
        return len(words).to_bytes(4, "little") + words + b"".join(self._parts)


def message(
    layers: Iterable[MeshLayer | LineLayer], scales: Iterable[Scale] = (), views: Iterable[View] = (), **more: Any
) -> bytes:
    """Return layers, color scales and views, and further entries of the manifest, as one message for the page."""
    packer = Packer()
    manifest = {
        "scales": [_scale(scale, packer) for scale in scales],
        "views": [_view(view) for view in views],
        "layers": [_layer(layer, packer) for layer in layers],
    }
    return packer.framed(manifest | more)


def pack(scene: Scene, notes: dict[str, str]) -> tuple[dict[str, Any], str]:
    """Return the manifest of a scene, with a line of text per pane by its name, and its bytes in base64."""
    packer = Packer()
    manifest = {
        "version": 1,
        "panes": [{"id": name, "title": title, "note": notes.get(name, "")} for name, title in scene.panes],
        "scales": [_scale(scale, packer) for scale in scene.scales],
        "views": [_view(view) for view in scene.views],
        "is_oriented": scene.is_oriented,
        "fade": scene.fade_mm,
        "layers": [_layer(layer, packer) for layer in scene.layers],
    }
    return manifest, packer.text()


def _scale(scale: Scale, packer: Packer) -> dict[str, Any]:
    """Return the manifest entry of a color scale."""
    colours = packer.add(np.rint(255 * scale.colours).astype(np.uint8))
    words = {"id": scale.id, "title": scale.title, "unit": scale.unit}
    return {**words, "low": scale.low, "high": scale.high, "colours": colours}


def _view(view: View) -> dict[str, Any]:
    """Return the manifest entry of a view."""
    axes, center = view.axes.ravel().tolist(), view.center_mm.tolist()
    return {"id": view.id, "axes": axes, "center": center, "radius": view.radius_mm}


def _layer(layer: MeshLayer | LineLayer, packer: Packer) -> dict[str, Any]:
    """Return the manifest entry of a layer; its arrays are added to `packer`."""
    packed: dict[str, Any] = {"id": layer.id, "pane": layer.pane, "colour": layer.colour, "scale": layer.scale}
    if isinstance(layer, LineLayer):
        packed |= {"kind": "lines", "opacity": 1.0, "points": packer.add_numbers(layer.points_mm)}
        packed |= {"starts": packer.add_indices(layer.starts), "radii": packer.add_numbers(layer.radius_mm[:, None])}
    else:
        packed |= {"kind": "mesh", "opacity": layer.opacity, "n_points": len(layer.surface.vertices_mm)}
        packed |= {"faces": packer.add_indices(layer.surface.faces)}
        if layer.frames_mm is None:
            packed |= {"points": packer.add_numbers(layer.surface.vertices_mm)}
        else:
            packed |= {"frames": packer.add_numbers(layer.frames_mm)}
    if isinstance(layer, MeshLayer) and layer.frame_values is not None:
        packed |= {"frame_values": packer.add_numbers(layer.frame_values[..., None])}
    elif len(layer.values):
        packed |= {"values": packer.add_numbers(layer.values[:, None])}
    return packed
