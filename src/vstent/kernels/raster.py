"""Rendering of triangles and wires into an image with a depth buffer, without a graphics library or a display.

Screen coordinates are x to the right and y down, in pixels, and depth away from the eye, in mm (orthographic). The
centre of a pixel is at integer + 0.5. `depth` (h, w) holds the smallest depth painted so far, `image` (h, w, 3) its
colour.
"""

import math

import numpy as np
from numba import njit

from vstent.kernels.arrays import Floats, Ints


@njit(cache=True, nogil=True)
def paint_triangles(screen: Floats, colours: Floats, faces: Ints, depth: Floats, image: Floats) -> None:
    """Paint opaque triangles (m, 3) of vertices (n, 3) with colours (n, 3) in place; the nearer one is visible."""
    height, width = depth.shape
    for f in range(len(faces)):
        i, j, k = _turned(screen, faces[f, 0], faces[f, 1], faces[f, 2])
        area = _edge(screen[i], screen[j], screen[k, 0], screen[k, 1])
        x0, x1, y0, y1 = _box(screen[i], screen[j], screen[k], 0.0, width, height)
        for y in range(y0, y1):
            for x in range(x0, x1):
                a = _edge(screen[j], screen[k], x + 0.5, y + 0.5)
                b = _edge(screen[k], screen[i], x + 0.5, y + 0.5)
                c = _edge(screen[i], screen[j], x + 0.5, y + 0.5)
                if not (
                    _holds(a, screen[j], screen[k])
                    and _holds(b, screen[k], screen[i])
                    and _holds(c, screen[i], screen[j])
                ):
                    continue
                a, b, c = a / area, b / area, c / area
                z = a * screen[i, 2] + b * screen[j, 2] + c * screen[k, 2]
                if z < depth[y, x]:
                    depth[y, x] = z
                    for ch in range(3):
                        image[y, x, ch] = a * colours[i, ch] + b * colours[j, ch] + c * colours[k, ch]


@njit(cache=True, nogil=True)
def paint_wires(
    screen: Floats, starts: Ints, radius: Floats, pixel: float, colours: Floats, depth: Floats, image: Floats
) -> None:
    """Paint round wires of points (p, 3) with colours (p, 3) in place.

    `starts` (w + 1,) are the first points and `radius` (w,) is in pixels. The size of a pixel, in mm, converts the
    bulge of a wire towards the eye to depth.
    """
    height, width = depth.shape
    for wire in range(len(radius)):
        r = radius[wire]
        for i in range(starts[wire], starts[wire + 1] - 1):
            p, q = screen[i], screen[i + 1]
            dx, dy = q[0] - p[0], q[1] - p[1]
            length2 = max(dx * dx + dy * dy, 1e-12)
            x0, x1, y0, y1 = _box(p, q, q, r, width, height)
            for y in range(y0, y1):
                for x in range(x0, x1):
                    t = ((x + 0.5 - p[0]) * dx + (y + 0.5 - p[1]) * dy) / length2
                    t = min(max(t, 0.0), 1.0)
                    off2 = ((x + 0.5 - p[0] - t * dx) ** 2 + (y + 0.5 - p[1] - t * dy) ** 2) / (r * r)
                    if off2 > 1.0:
                        continue
                    bulge = math.sqrt(1.0 - off2)
                    z = p[2] + t * (q[2] - p[2]) - bulge * r * pixel
                    if z < depth[y, x]:
                        depth[y, x] = z
                        for ch in range(3):
                            colour = colours[i, ch] + t * (colours[i + 1, ch] - colours[i, ch])
                            image[y, x, ch] = colour * (0.45 + 0.55 * bulge)


@njit(cache=True, nogil=True)
def veil_triangles(
    screen: Floats, colours: Floats, alphas: Floats, faces: Ints, depth: Floats, sums: Floats, clear: Floats
) -> None:
    """Accumulate translucent triangles in front of the opaque ones, in any order.

    Alpha (n,) times colour, and alpha, are added to `sums` (h, w, 4); `clear` (h, w) is multiplied by 1 - alpha. It is
    weighted blended order-independent transparency (McGuire and Bavoil 2013, JCGT 2(2), eq. 6 with equal weights).
    """
    height, width = depth.shape
    for f in range(len(faces)):
        i, j, k = _turned(screen, faces[f, 0], faces[f, 1], faces[f, 2])
        p, q, r = screen[i], screen[j], screen[k]
        area = _edge(p, q, r[0], r[1])
        if area == 0.0:
            continue
        # Edge functions are linear along a row. Local copies spare loads: the sums might share their memory.
        share = 1.0 / area
        z_a, z_b, z_c = p[2], q[2], r[2]
        alpha_a, alpha_b, alpha_c = alphas[i], alphas[j], alphas[k]
        red_a, green_a, blue_a = colours[i, 0], colours[i, 1], colours[i, 2]
        red_b, green_b, blue_b = colours[j, 0], colours[j, 1], colours[j, 2]
        red_c, green_c, blue_c = colours[k, 0], colours[k, 1], colours[k, 2]
        a_step, b_step, c_step = q[1] - r[1], r[1] - p[1], p[1] - q[1]
        has_a, has_b, has_c = _holds(0.0, q, r), _holds(0.0, r, p), _holds(0.0, p, q)
        x0, x1, y0, y1 = _box(p, q, r, 0.0, width, height)
        for y in range(y0, y1):
            a0, b0, c0 = _edge(q, r, 0.5, y + 0.5), _edge(r, p, 0.5, y + 0.5), _edge(p, q, 0.5, y + 0.5)
            is_in = False
            for x in range(x0, x1):
                a, b, c = a0 + x * a_step, b0 + x * b_step, c0 + x * c_step
                if not (
                    (a > 0.0 or (a == 0.0 and has_a))
                    and (b > 0.0 or (b == 0.0 and has_b))
                    and (c > 0.0 or (c == 0.0 and has_c))
                ):
                    if is_in:
                        break
                    continue
                is_in = True
                a, b, c = a * share, b * share, c * share
                if a * z_a + b * z_b + c * z_c > depth[y, x]:
                    continue
                alpha = a * alpha_a + b * alpha_b + c * alpha_c
                sums[y, x, 0] += alpha * (a * red_a + b * red_b + c * red_c)
                sums[y, x, 1] += alpha * (a * green_a + b * green_b + c * green_c)
                sums[y, x, 2] += alpha * (a * blue_a + b * blue_b + c * blue_c)
                sums[y, x, 3] += alpha
                clear[y, x] *= 1.0 - alpha


@njit(cache=True, inline="always")
def _edge(p: Floats, q: Floats, x: float, y: float) -> float:
    """Return twice the signed area of the triangle p, q and the point x, y."""
    return (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])


@njit(cache=True, inline="always")
def _holds(edge: float, p: Floats, q: Floats) -> bool:
    """Return whether a point is inside an edge; on an edge it belongs to one of the two triangles (top-left rule)."""
    return edge > 0.0 or (edge == 0.0 and (q[1] < p[1] or (q[1] == p[1] and q[0] > p[0])))


@njit(cache=True, inline="always")
def _turned(screen: Floats, i: int, j: int, k: int) -> tuple[int, int, int]:
    """Return the corners in the order that makes the area positive."""
    if _edge(screen[i], screen[j], screen[k, 0], screen[k, 1]) < 0.0:
        return i, k, j
    return i, j, k


@njit(cache=True, inline="always")
def _box(p: Floats, q: Floats, r: Floats, margin: float, width: int, height: int) -> tuple[int, int, int, int]:
    """Return the pixel ranges x0, x1, y0, y1 of a triangle's bounding box with a margin, limited to the image."""
    x0 = math.floor(min(p[0], q[0], r[0]) - margin)
    x1 = math.ceil(max(p[0], q[0], r[0]) + margin)
    y0 = math.floor(min(p[1], q[1], r[1]) - margin)
    y1 = math.ceil(max(p[1], q[1], r[1]) + margin)
    return max(x0, 0), min(x1, width), max(y0, 0), min(y1, height)


@njit(cache=True, nogil=True)
def resolve(image: Floats, sums: Floats, clear: Floats, supersampling: int) -> Floats:
    """Return colours (h / s, w / s, 3): layers of `veil_triangles` over an opaque image, averaged over s x s pixels."""
    height, width = clear.shape
    result = np.zeros((height // supersampling, width // supersampling, 3))
    share = 1.0 / supersampling**2
    for y in range(height):
        for x in range(width):
            veiled = (1.0 - clear[y, x]) / max(sums[y, x, 3], 1e-12)
            for ch in range(3):
                colour = image[y, x, ch] * clear[y, x] + sums[y, x, ch] * veiled
                result[y // supersampling, x // supersampling, ch] += share * colour
    return result
