// Where voxels lie: the axes of a scan against those of the patient, and the way from an index to a point and back.

/** By the axis of the world (to the left, to the back, to the head) that a slice is across. */
const PLANES = [
  { title: "Sagittal", right: [1, 1], down: [2, -1], letters: ["A", "P", "H", "F"], colour: "#e0b020" },
  { title: "Coronal", right: [0, 1], down: [2, -1], letters: ["R", "L", "H", "F"], colour: "#35b779" },
  { title: "Axial", right: [0, 1], down: [1, 1], letters: ["R", "L", "A", "P"], colour: "#f0705c" },
];
/** Titles of the same slices where the file has no orientation. */
const BARE = ["Slice across x", "Slice across y", "Slice across z"];

/** Axis of the world that each axis of the voxels runs along, one each: the best of the six ways. */
export function worldAxes(a) {
  const ways = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
  const along = (way) => way.reduce((sum, world, axis) => sum + Math.abs(a[4 * world + axis]) / Math.hypot(a[axis], a[4 + axis], a[8 + axis]), 0);
  return ways.reduce((best, way) => (along(way) > along(best) ? way : best));
}

/** How the slice across an axis of the voxels is laid: its plane, and the axes and directions to the right and down. */
export function laid({ affine_mm, is_oriented, oblique_deg }, axis) {
  const across = worldAxes(affine_mm);
  const plane = PLANES[across[axis]];
  const [right, down] = [plane.right, plane.down].map(([world, wanted]) => {
    const voxels = across.indexOf(world);
    return { axis: voxels, sign: wanted * (affine_mm[4 * world + voxels] < 0 ? -1 : 1) };
  });
  const angle = Math.round(oblique_deg[axis]);
  const oblique = angle ? { title: `Oblique to ${plane.title.toLowerCase()} by ${angle}°` } : {};
  const words = is_oriented ? oblique : { title: BARE[across[axis]], letters: ["", "", "", ""] };
  return { ...plane, ...words, world: across[axis], right, down };
}

/** Point in LPS mm of a voxel index. */
export function toMm(a, index) {
  return [0, 1, 2].map((row) => a[4 * row] * index[0] + a[4 * row + 1] * index[1] + a[4 * row + 2] * index[2] + a[4 * row + 3]);
}

/** Voxel index of a point: the affine's inverse by Cramer's rule. */
export function toIndex(a, point) {
  const [x, y, z] = [point[0] - a[3], point[1] - a[7], point[2] - a[11]];
  const det = (u, v, w) => u[0] * (v[1] * w[2] - v[2] * w[1]) - v[0] * (u[1] * w[2] - u[2] * w[1]) + w[0] * (u[1] * v[2] - u[2] * v[1]);
  const [i, j, k] = [0, 1, 2].map((column) => [a[column], a[4 + column], a[8 + column]]);
  const b = [x, y, z];
  const whole = det(i, j, k);
  return [det(b, j, k) / whole, det(i, b, k) / whole, det(i, j, b) / whole];
}

/** Segments x1, y1, x2, y2 of the line on which a slice has a value: linear along the edges between voxels. */
export function isoline({ width, height, values }, level) {
  const found = [];
  for (let y = 0; y + 1 < height; y++) {
    for (let x = 0, at = y * width; x + 1 < width; x++, at++) {
      const [a, b, c, d] = [values[at], values[at + 1], values[at + width + 1], values[at + width]];
      const kind = (a >= level) | ((b >= level) << 1) | ((c >= level) << 2) | ((d >= level) << 3);
      if (kind === 0 || kind === 15) continue;
      const top = [x + (level - a) / (b - a), y];
      const right = [x + 1, y + (level - b) / (c - b)];
      const bottom = [x + (level - d) / (c - d), y + 1];
      const left = [x, y + (level - a) / (d - a)];
      const isHigh = a + b + c + d >= 4 * level; // of a saddle the middle decides
      for (const [from, to] of CASES[kind === 5 && isHigh ? 10 : kind === 10 && isHigh ? 5 : kind]) {
        const [p, q] = [[top, right, bottom, left][from], [top, right, bottom, left][to]];
        found.push(p[0], p[1], q[0], q[1]);
      }
    }
  }
  return found;
}

/** Edges (top, right, bottom, left) that the line joins, by the corners above the level. */
const CASES = [
  [], [[3, 0]], [[0, 1]], [[3, 1]], [[1, 2]], [[3, 0], [1, 2]], [[0, 2]], [[3, 2]],
  [[2, 3]], [[2, 0]], [[0, 1], [2, 3]], [[2, 1]], [[1, 3]], [[1, 0]], [[0, 3]], [],
];

/** Lines of points [x, y], joined from segments x1, y1, x2, y2 that share an end: dashes run along them. */
export function joined(segments) {
  const count = segments.length / 4;
  const point = (segment, end) => [segments[4 * segment + 2 * end], segments[4 * segment + 2 * end + 1]];
  if (count > MOST_JOINED) return Array.from({ length: count }, (_, i) => [point(i, 0), point(i, 1)]);
  const ends = new Map();
  for (let i = 0; i < 2 * count; i++) {
    const key = point(i >> 1, i & 1).join();
    ends.set(key, [...(ends.get(key) || []), i]);
  }
  const isUsed = new Uint8Array(count);
  /** Points from an end onwards, as far as the line goes. */
  const walk = (from) => {
    const found = [];
    for (let at = from; at !== undefined; ) {
      isUsed[at >> 1] = 1;
      const other = point(at >> 1, 1 - (at & 1));
      found.push(other);
      at = (ends.get(other.join()) || []).find((end) => !isUsed[end >> 1]);
    }
    return found;
  };
  const lines = [];
  for (let i = 0; i < count; i++) {
    if (isUsed[i]) continue;
    const forward = walk(2 * i);
    const start = (ends.get(point(i, 0).join()) || []).find((end) => !isUsed[end >> 1]);
    lines.push([...(start === undefined ? [] : walk(start).reverse()), point(i, 0), ...forward]);
  }
  return lines;
}

/** Number of segments above which they stay apart: that many are noise. */
const MOST_JOINED = 20000;
