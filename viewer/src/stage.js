// The scene on one canvas: several panes, one camera.
import * as THREE from "three";
import { integers, numbers } from "./decode.js";
import { Orbit } from "./orbit.js";
import * as paint from "./paint.js";

export class Stage {
  /** @param canvas where to draw @param manifest what a scene holds @param buffer its bytes. Throws without WebGL. */
  constructor(canvas, manifest, buffer) {
    THREE.ColorManagement.enabled = false;
    this.manifest = manifest;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.setClearColor(paint.PAPER);
    this.renderer.setScissorTest(true);
    this.camera = new THREE.PerspectiveCamera(22);
    this.scene = new THREE.Scene();
    this.shared = { pixel: { value: 0.001 }, middle: { value: 1 }, fade: manifest.fade };
    this.waiting = false;
    this.drawn = () => {};
    this.orbit = new Orbit(this.camera, () => this.redraw());
    this.scales = {};
    this.ranges = {};
    this.layers = [];
    this.panes = [];
    this.shown = new Set();
    this.put(manifest, buffer);
  }

  /** Add layers and their scales; a layer of the same name in the same pane is replaced. */
  put(manifest, buffer) {
    for (const scale of manifest.scales) {
      const { id, low, high } = scale;
      this.scales[id] = { ...scale, given: { low, high }, ...this.ranges[id], texture: paint.lookup(integers(buffer, scale.colours)) };
    }
    for (const { id, pane } of manifest.layers) this.drop((layer) => layer.id === id && layer.pane === pane);
    for (const layer of manifest.layers) {
      const built = this.build(layer, buffer);
      this.layers.push(built);
      this.scene.add(built.object);
    }
    for (const { id } of manifest.scales) this.span(id);
    this.redraw();
  }

  /** Colour by a range {low, high} of one's own; null: by the one that the messages state. */
  setRange(id, range) {
    this.ranges[id] = range;
    if (!this.scales[id]) return; // it comes with its layer
    Object.assign(this.scales[id], range ?? this.scales[id].given);
    this.span(id);
    this.redraw();
  }

  /** All layers of a scale have its range: what an earlier message brought as well. */
  span(id) {
    const { low, high } = this.scales[id];
    for (const { object } of this.layers.filter(({ scale }) => scale === id)) object.traverse((part) => part.material?.uniforms.span.value.set(low, high));
  }

  /** Lowest and highest value of the layers that `isChosen`; null where there are none. */
  extent(isChosen) {
    let [low, high] = [Infinity, -Infinity];
    for (const { object } of this.layers.filter(isChosen))
      object.traverse((part) => part.geometry?.attributes.value?.array.forEach((value) => ([low, high] = [Math.min(low, value), Math.max(high, value)])));
    return low < high ? { low, high } : null;
  }

  /** Take away the layers that `isChosen`. */
  drop(isChosen) {
    for (const layer of this.layers.filter(isChosen)) {
      this.scene.remove(layer.object);
      layer.object.traverse((part) => {
        part.geometry?.dispose();
        part.material?.dispose();
      });
    }
    this.layers = this.layers.filter((layer) => !isChosen(layer));
    this.redraw();
  }

  build(layer, buffer) {
    const scale = this.scales[layer.scale];
    const values = layer.values ? numbers(buffer, layer.values) : null;
    if (layer.kind === "lines") {
      const points = numbers(buffer, layer.points);
      const starts = integers(buffer, layer.starts);
      const radii = numbers(buffer, layer.radii);
      return { ...layer, object: paint.lines(layer, { points, starts, radii, values }, scale, this.shared) };
    }
    const geometry = new THREE.BufferGeometry();
    const frames = layer.frames ? numbers(buffer, layer.frames) : null;
    const frameValues = layer.frame_values ? numbers(buffer, layer.frame_values) : null;
    const points = frames ? frames.slice(-3 * layer.n_points) : numbers(buffer, layer.points);
    const painted = frameValues ? frameValues.slice(-layer.n_points) : values || new Float32Array(layer.n_points);
    geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
    geometry.setAttribute("value", new THREE.BufferAttribute(painted, 1));
    geometry.setIndex(new THREE.BufferAttribute(integers(buffer, layer.faces), 1));
    geometry.computeVertexNormals();
    return { ...layer, geometry, frames, frameValues, object: paint.surface(layer, geometry, scale) };
  }

  /** Number of steps of the longest expansion. */
  get nFrames() {
    return Math.max(0, ...this.layers.map((layer) => (layer.frames ? layer.frames.length / 3 / layer.n_points : 0)));
  }

  /** Put every contour at a moment of its expansion: 0 as it starts, 1 deployed. */
  expand(moment) {
    for (const layer of this.layers) {
      if (!layer.frames) continue;
      const n = layer.n_points;
      const last = layer.frames.length / 3 / n - 1;
      const at = Math.min(Math.max(moment, 0), 1) * last;
      const [a, b] = [Math.floor(at), Math.ceil(at)];
      const { position, value } = layer.geometry.attributes;
      mix(position.array, layer.frames, 3 * n, a, b, at - a);
      mix(value.array, layer.frameValues, n, a, b, at - a);
      position.needsUpdate = value.needsUpdate = true;
      layer.geometry.computeVertexNormals();
      layer.geometry.computeBoundingSphere();
    }
    this.redraw();
  }

  /** Where the panes lie: [{id, left, bottom, width, height}] in CSS pixels, on a canvas of that size. */
  arrange(panes, width, height) {
    this.panes = panes;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.redraw();
  }

  /** Draw once with `scale` pixels per CSS pixel and hand the canvas over; then the picture is as before. */
  photograph(scale, taken) {
    const { renderer } = this;
    const [before, width, height] = [renderer.getPixelRatio(), renderer.domElement.width / renderer.getPixelRatio(), renderer.domElement.height / renderer.getPixelRatio()];
    renderer.setPixelRatio(scale);
    renderer.setSize(width, height, false);
    this.draw();
    taken(renderer.domElement);
    renderer.setPixelRatio(before);
    renderer.setSize(width, height, false);
    this.draw();
  }

  /** Show the layers of these ids, hide all others. */
  show(ids) {
    this.shown = new Set(ids);
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame((now) => {
      this.waiting = false;
      if (this.orbit.flight) this.orbit.flight(now);
      this.draw();
    });
  }

  draw() {
    this.shared.middle.value = this.orbit.distance;
    for (const pane of this.panes) {
      if (pane.width < 1 || pane.height < 1) continue;
      this.camera.aspect = pane.width / pane.height;
      this.camera.updateProjectionMatrix();
      const ratio = this.renderer.getPixelRatio();
      this.shared.pixel.value = (2 * Math.tan((this.camera.fov * Math.PI) / 360)) / (pane.height * ratio);
      const own = new Set(this.layers.filter((layer) => layer.pane === pane.id).map(({ id }) => id));
      for (const layer of this.layers) {
        const isReplaced = layer.pane === "" && own.has(layer.id); // by one of the pane's own: of the wall an outline is left
        layer.object.visible = this.shown.has(layer.id) && (layer.pane === pane.id || (layer.pane === "" && (!isReplaced || layer.id === "lumen")));
        if (layer.id === "lumen") paint.weaken(layer.object, isReplaced);
      }
      this.renderer.setViewport(pane.left, pane.bottom, pane.width, pane.height);
      this.renderer.setScissor(pane.left, pane.bottom, pane.width, pane.height);
      this.renderer.render(this.scene, this.camera);
    }
    this.drawn();
  }
}

function mix(target, frames, n, a, b, t) {
  for (let i = 0; i < n; i++) target[i] = (1 - t) * frames[a * n + i] + t * frames[b * n + i];
}
