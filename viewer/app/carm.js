// The direction of a C-arm in words and as the axes of the picture, as in DICOM: positive LAO and CRA, coordinates in LPS.

const NAMED = { AP: [0, 0], PA: [0, 0], FRONTAL: [0, 0], LATERAL: [90, 0] };
const SIGNS = { LAO: [1, 0], RAO: [-1, 0], CRA: [0, 1], CAU: [0, -1] };
/** Largest angles in degrees, LAO or RAO and CRA or CAU. */
export const REACH = [180, 90];
const RADIAN = Math.PI / 180;

/** Angles in degrees in words: ``LAO 30 CRA 10``. */
export function inWords([primary, secondary]) {
  const words = (angle, names) => `${names[Math.round(angle) < 0 ? 1 : 0]} ${Math.abs(Math.round(angle))}`;
  return `${words(primary, ["LAO", "RAO"])} ${words(secondary, ["CRA", "CAU"])}`;
}

/** Angles in degrees of words such as ``LAO 30 CRA 10``, ``AP`` or ``lateral``. Throws where they are no direction. */
export function fromWords(text) {
  const words = text.trim().toUpperCase();
  if (NAMED[words]) return NAMED[words];
  const given = [...words.matchAll(/(LAO|RAO|CRA|CAU)\s*(\d+(?:\.\d+)?)/g)];
  const rest = words.replace(/(LAO|RAO|CRA|CAU)\s*\d+(?:\.\d+)?|[,/°\s]/g, "");
  const angles = [0, 1].map((k) => given.filter(([, side]) => SIGNS[side][k]).map(([, side, angle]) => SIGNS[side][k] * Number(angle)));
  const isFine = given.length && !rest && angles.every((some, k) => some.length < 2 && Math.abs(some[0] ?? 0) <= REACH[k]);
  if (!isFine) throw new Error(`“${text}” is not a C-arm direction. Give one such as LAO 30 CRA 10, RAO 45, AP or lateral.`);
  return angles.map(([angle]) => angle ?? 0);
}

/** Rows of the picture along a direction in degrees: right, up, towards the detector. */
export function axesOf([primary, secondary]) {
  const [p, s] = [primary * RADIAN, secondary * RADIAN];
  const toward = [Math.sin(p) * Math.cos(s), -Math.cos(p) * Math.cos(s), Math.sin(s)];
  const right = [Math.cos(p), Math.sin(p), 0];
  const up = [toward[1] * right[2] - toward[2] * right[1], toward[2] * right[0] - toward[0] * right[2], toward[0] * right[1] - toward[1] * right[0]];
  return [...right, ...up, ...toward];
}

/** Angles in degrees of a unit direction towards the detector. */
export function anglesOf([x, y, z]) {
  return [Math.atan2(x, -y) / RADIAN, Math.asin(Math.min(Math.max(z, -1), 1)) / RADIAN];
}
