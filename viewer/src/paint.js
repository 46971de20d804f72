// Materials: shaded surfaces (plain, coloured by a scale, or glass) and round lines that never get thinner than a hair.
import * as THREE from "three";

const FAINT = 0.35;

/** Colour behind everything. */
export const PAPER = 0xf6f8f9;

const LIGHT = "const vec3 LIGHT = vec3(-0.3504, 0.5005, 0.7909);";

const MAPPED = `
  uniform vec3 colour;
  uniform sampler2D lut;
  uniform vec2 span;
  varying float vValue;
  vec3 baseColour() {
    if (span.y <= span.x) return colour;
    float place = clamp((vValue - span.x) / (span.y - span.x), 0.0, 1.0);
    return texture2D(lut, vec2((place * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  }`;

const SURFACE_VERTEX = `
  attribute float value;
  varying float vValue;
  varying vec3 vNormal;
  varying vec3 vEye;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    vValue = value;
    vNormal = normalMatrix * normal;
    vEye = -seen.xyz;
    gl_Position = projectionMatrix * seen;
  }`;

const SURFACE_FRAGMENT = `
  ${LIGHT}
  ${MAPPED}
  uniform float opacity;
  uniform float strength;
  varying vec3 vNormal;
  varying vec3 vEye;
  void main() {
    vec3 eye = normalize(vEye);
    vec3 normal = normalize(vNormal);
    float facing = dot(normal, eye);
    if (facing < 0.0) normal = -normal;
    float ambient = span.y > span.x ? 0.72 : 0.50; // colours that mean something stay near what the bar shows
    float light = ambient + (1.0 - ambient) * max(dot(normal, LIGHT), 0.0);
    float gloss = 0.10 * pow(max(dot(reflect(-LIGHT, normal), eye), 0.0), 32.0);
    float grazing = pow(1.0 - min(abs(facing), 1.0), 3.0);
    float alpha = opacity < 1.0 ? opacity + (1.0 - opacity) * 0.75 * grazing : 1.0;
    gl_FragColor = vec4(baseColour() * light + gloss, alpha * strength);
  }`;

// A line is a ribbon that faces the eye, as wide as its diameter and at least `hair` pixels, shaded like a cylinder.
const LINE_VERTEX = `
  attribute vec3 along;
  attribute float side;
  attribute float radius;
  attribute float value;
  uniform float pixel;
  uniform float hair;
  varying float vValue;
  varying float vSide;
  varying float vDepth;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    vec3 direction = (modelViewMatrix * vec4(along, 0.0)).xyz;
    vec3 across = cross(direction, seen.xyz);
    across /= max(length(across), 1e-6);
    float reach = max(radius, 0.5 * hair * pixel * -seen.z);
    vValue = value;
    vSide = side;
    vDepth = -seen.z;
    seen.xyz += side * reach * across;
    gl_Position = projectionMatrix * seen;
  }`;

const LINE_FRAGMENT = `
  ${MAPPED}
  uniform vec3 paper;
  uniform float middle;
  uniform float fade;
  varying float vSide;
  varying float vDepth;
  void main() {
    float bulge = sqrt(max(1.0 - vSide * vSide, 0.0));
    float pale = fade > 0.0 ? 0.65 * clamp(0.15 + (vDepth - middle) / fade, 0.0, 1.0) : 0.0;
    gl_FragColor = vec4(mix(baseColour() * (0.45 + 0.55 * bulge), paper, pale), 1.0);
  }`;

const BLANK = lookup(new Uint8Array(3));

/** Texture of a colour table (256 x 3 bytes). */
export function lookup(bytes) {
  const texels = new Uint8Array(4 * 256).fill(255);
  for (let i = 0; i < bytes.length / 3; i++) texels.set(bytes.subarray(3 * i, 3 * i + 3), 4 * i);
  const texture = new THREE.DataTexture(texels, 256, 1);
  texture.minFilter = texture.magFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

function uniforms(layer, scale) {
  return {
    colour: { value: new THREE.Vector3(...layer.colour) },
    lut: { value: scale ? scale.texture : BLANK },
    span: { value: new THREE.Vector2(scale ? scale.low : 0, scale ? scale.high : 0) },
  };
}

/** Draw a surface that others have replaced faintly, or as it is. */
export function weaken(object, isFaint) {
  object.traverse(({ material }) => material?.uniforms.strength && (material.uniforms.strength.value = isFaint ? FAINT : 1));
}

/** A surface; a translucent one is drawn far side first, then near side. */
export function surface(layer, geometry, scale) {
  const glass = layer.opacity < 1;
  const make = (side) =>
    new THREE.ShaderMaterial({
      vertexShader: SURFACE_VERTEX,
      fragmentShader: SURFACE_FRAGMENT,
      uniforms: { ...uniforms(layer, scale), opacity: { value: layer.opacity }, strength: { value: 1 } },
      transparent: glass,
      depthWrite: !glass,
      // Glass that lies on an opaque wall must not flicker with it: it is drawn a little behind.
      polygonOffset: glass,
      polygonOffsetFactor: 4,
      polygonOffsetUnits: 40,
      side,
    });
  const sides = glass ? [THREE.BackSide, THREE.FrontSide] : [THREE.DoubleSide];
  const group = new THREE.Group();
  sides.forEach((side, order) => {
    const mesh = new THREE.Mesh(geometry, make(side));
    mesh.renderOrder = glass ? 10 + order : 0;
    group.add(mesh);
  });
  return group;
}

/** Lines from points (3 p), starts (w + 1), radii (w) and values (p or none); wires on the far side are paler. */
export function lines(layer, { points, starts, radii, values }, scale, shared) {
  const material = new THREE.ShaderMaterial({
    vertexShader: LINE_VERTEX,
    fragmentShader: LINE_FRAGMENT,
    uniforms: {
      ...uniforms(layer, scale),
      pixel: shared.pixel,
      middle: shared.middle,
      paper: { value: new THREE.Color(PAPER) },
      fade: { value: layer.id === "wires" ? shared.fade : 0 },
      hair: { value: 1.1 },
    },
    side: THREE.DoubleSide,
  });
  const mesh = new THREE.Mesh(ribbons(points, starts, radii, values), material);
  mesh.frustumCulled = false;
  return mesh;
}

function ribbons(points, starts, radii, values) {
  const n = points.length / 3;
  const position = new Float32Array(6 * n);
  const along = new Float32Array(6 * n);
  const side = new Float32Array(2 * n);
  const radius = new Float32Array(2 * n);
  const value = new Float32Array(2 * n);
  const index = [];
  for (let w = 0; w < radii.length; w++) {
    const [first, last] = [starts[w], starts[w + 1] - 1];
    for (let i = first; i <= last; i++) {
      const [before, after] = [Math.max(i - 1, first), Math.min(i + 1, last)];
      for (const k of [0, 1]) {
        for (let c = 0; c < 3; c++) {
          position[6 * i + 3 * k + c] = points[3 * i + c];
          along[6 * i + 3 * k + c] = points[3 * after + c] - points[3 * before + c];
        }
        side[2 * i + k] = 2 * k - 1;
        radius[2 * i + k] = radii[w];
        value[2 * i + k] = values ? values[i] : 0;
      }
      if (i < last) index.push(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 1, 2 * i + 3, 2 * i + 2);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setAttribute("along", new THREE.BufferAttribute(along, 3));
  geometry.setAttribute("side", new THREE.BufferAttribute(side, 1));
  geometry.setAttribute("radius", new THREE.BufferAttribute(radius, 1));
  geometry.setAttribute("value", new THREE.BufferAttribute(value, 1));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(index), 1));
  return geometry;
}
