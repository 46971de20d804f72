// What stands on a picture: colour bars, the length bar, the compass.
import { Vector3 } from "three";
import { button, make, svg } from "./dom.js";

/** CSS gradient of a scale's colours. */
export function gradient(scale) {
  const texels = scale.texture.image.data;
  const stops = Array.from({ length: 17 }, (_, i) => `rgb(${texels.slice(4 * Math.min(16 * i, 255), 4 * Math.min(16 * i, 255) + 3)})`);
  return `linear-gradient(90deg, ${stops.join(", ")})`;
}

/** A scale with its quantity, unit and three numbers; `more` stands behind the unit. */
export function colourBar(scale, more = []) {
  const bar = make("i", { className: "viewer-ramp", style: { background: gradient(scale) } });
  const middle = (scale.low + scale.high) / 2;
  const ticks = [scale.low, middle, scale.high].map((value) => make("span", {}, [String(Number(value.toPrecision(3)))]));
  return make("div", { className: "viewer-bar" }, [
    make("span", { className: "viewer-quantity" }, [scale.title, make("em", {}, [` ${scale.unit}`]), ...more]),
    make("div", {}, [bar, make("div", { className: "viewer-ticks" }, ticks)]),
  ]);
}

/** A pane with title, length bar and compass, which `annotate` keeps true, and a button that calls `solo` to show it alone. */
export function makePane({ id, title, note }, solo) {
  const length = make("span", { className: "viewer-length" });
  const compass = svg("svg", { class: "viewer-compass", viewBox: "-26 -26 52 52", "aria-hidden": "true" });
  const head = make("div", { className: "viewer-title" }, [make("strong", {}, [title || ""]), make("span", {}, [note || ""])]);
  const alone = button("⤢", () => solo(id), { className: "viewer-solo", title: "Show this alone, or all again", ariaLabel: `Show ${title || "this"} alone, or all again` });
  return { id, title, note, element: make("div", { className: "viewer-pane" }, [head, alone, length, compass]), head, length, compass, button: alone };
}

/** Width and height of a pane in pixels. */
export const sizeOf = ({ element }) => [Math.max(element.clientWidth, 1), Math.max(element.clientHeight, 1)];

/** Bring length bars and compasses to the camera as it is; `height` is that of a pane in pixels. */
export function annotate(panes, { camera, orbit, isOriented }, height) {
  const perMm = height / (2 * orbit.distance * Math.tan((camera.fov * Math.PI) / 360));
  const length = [50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1].find((mm) => mm * perMm < 110) || 0.1;
  const inverse = orbit.turned.clone().invert();
  // Without an orientation in the file the arms are the axes of its grid.
  const names = isOriented === false ? ["x", "y", "z"] : ["L", "P", "S"];
  const arms = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((axis, i) => {
    const { x, y, z } = new Vector3(...axis).applyQuaternion(inverse);
    return { name: names[i], x: 17 * x, y: -17 * y, z };
  });
  for (const pane of panes) {
    pane.length.style.width = `${length * perMm}px`;
    pane.length.textContent = `${length} mm`;
    pane.compass.replaceChildren(...arms.sort((a, b) => a.z - b.z).flatMap(arm));
  }
}

function arm({ name, x, y, z }) {
  const ink = z < -0.05 ? "#9fb0b8" : "#2c4650";
  return [svg("line", { x1: 0, y1: 0, x2: x, y2: y, stroke: ink, "stroke-width": 1.6 }), svg("text", { x: 1.32 * x, y: 1.32 * y, fill: ink }, [name])];
}
