// What stands on the page as vectors: text, boxes, colour ramps and charts, each where it is seen.
import { svg } from "../src/dom.js";

/** Properties of drawn shapes that an SVG file states itself, because it has no style sheet. */
const DRAWN = ["fill", "fill-opacity", "stroke", "stroke-opacity", "stroke-width", "stroke-dasharray", "stroke-linecap", "opacity", "paint-order", "text-anchor", "font-size", "font-weight", "font-family"];
/** Those that a length in screen pixels scales. */
const WIDTHS = ["stroke-width", "stroke-dasharray"];
const CLEAR = "rgba(0, 0, 0, 0)";

/** SVG elements of an element and all in it but buttons, in pixels from `origin` [x, y] of the page. */
export function traced(element, origin) {
  const style = getComputedStyle(element);
  if (style.display === "none" || style.visibility === "hidden") return [];
  if (element instanceof SVGSVGElement) return [chart(element, origin)];
  const parts = box(element, style, origin);
  for (const child of element.childNodes) {
    if (child.nodeType === Node.TEXT_NODE) parts.push(...words(child, style, origin));
    else if (child.nodeType === Node.ELEMENT_NODE && !(child instanceof HTMLButtonElement)) parts.push(...traced(child, origin));
  }
  return parts;
}

/** Ground, border and line below of a box. */
function box(element, style, [x0, y0]) {
  const { left, top, width, height } = element.getBoundingClientRect();
  if (!width || !height) return [];
  const place = { x: left - x0, y: top - y0, width, height };
  const rx = Math.min(parseFloat(style.borderTopLeftRadius) * (style.borderTopLeftRadius.endsWith("%") ? width / 100 : 1) || 0, width / 2, height / 2);
  const parts = [];
  if (style.backgroundImage.startsWith("linear-gradient")) parts.push(ramp(style.backgroundImage, { ...place, rx }));
  else if (style.backgroundColor !== CLEAR) parts.push(svg("rect", { ...place, rx, ...paint("fill", style.backgroundColor) }));
  const [all, below] = [parseFloat(style.borderTopWidth), parseFloat(style.borderBottomWidth)];
  if (all) parts.push(svg("rect", { x: place.x + all / 2, y: place.y + all / 2, width: width - all, height: height - all, rx, fill: "none", "stroke-width": all, ...paint("stroke", style.borderTopColor) }));
  else if (below) parts.push(svg("rect", { x: place.x, y: place.y + height - below, width, height: below, ...paint("fill", style.borderBottomColor) }));
  return parts;
}

/** A colour as attributes that every program reads: without an alpha in it. */
function paint(name, colour) {
  const [r, g, b, alpha = 1] = colour.match(/[\d.]+/g).map(Number);
  return { [name]: `rgb(${r},${g},${b})`, ...(alpha < 1 ? { [`${name}-opacity`]: alpha } : {}) };
}

let count = 0;

/** A box with the colours of a CSS gradient from left to right. */
function ramp(css, place) {
  const id = `ramp-${count++}`;
  const colours = css.match(/rgba?\([^)]*\)/g);
  const stops = colours.map((colour, i) => svg("stop", { offset: i / (colours.length - 1), "stop-color": paint("fill", colour).fill }));
  return svg("g", {}, [svg("linearGradient", { id }, stops), svg("rect", { ...place, fill: `url(#${id})` })]);
}

/** The lines that a text is broken into. */
function words(node, style, [x0, y0]) {
  const lines = [];
  for (const { 0: word, index } of node.data.matchAll(/\S+/g)) {
    const range = document.createRange();
    range.setStart(node, index);
    range.setEnd(node, index + word.length);
    const { left, top, width } = range.getBoundingClientRect();
    const line = lines.at(-1);
    if (!width) continue;
    if (line && Math.abs(line.top - top) < 2) line.words.push(word);
    else lines.push({ left, top, words: [word] });
  }
  const halo = style.textShadow === "none" ? {} : { ...paint("stroke", style.textShadow.match(/rgba?\([^)]*\)/)[0]), "stroke-width": 3, "stroke-linejoin": "round", "paint-order": "stroke" };
  const font = { "font-size": parseFloat(style.fontSize), "font-weight": style.fontWeight, "font-family": style.fontFamily };
  return lines.map((line) => svg("text", { x: line.left - x0, y: line.top - y0 + ascent(style), ...font, ...paint("fill", style.color), ...halo }, [line.words.join(" ")]));
}

/** Distance from the top of a line of text to its base line, in pixels. */
function ascent({ fontWeight, fontSize, fontFamily }) {
  const context = document.createElement("canvas").getContext("2d");
  context.font = `${fontWeight} ${fontSize} ${fontFamily}`;
  return context.measureText("x").fontBoundingBoxAscent;
}

/** A chart with its style written into it. */
function chart(element, [x0, y0]) {
  const style = getComputedStyle(element);
  const { left, top, width, height } = element.getBoundingClientRect();
  const sides = (a, b) => parseFloat(style[a]) + parseFloat(style[b]);
  const copy = element.cloneNode(true);
  inline(element, copy);
  copy.setAttribute("overflow", "visible");
  const place = { x: left - x0 + parseFloat(style.paddingLeft), y: top - y0 + parseFloat(style.paddingTop), width: width - sides("paddingLeft", "paddingRight"), height: height - sides("paddingTop", "paddingBottom") };
  for (const [name, value] of Object.entries(place)) copy.setAttribute(name, value);
  return copy;
}

function inline(from, to) {
  const style = getComputedStyle(from);
  const isScreen = style.vectorEffect === "non-scaling-stroke";
  const scale = isScreen ? from.getScreenCTM().a : 1;
  for (const name of DRAWN) {
    const value = style.getPropertyValue(name);
    const isKept = value && !["normal", "auto"].includes(value);
    if (isKept) to.setAttribute(name, WIDTHS.includes(name) && value !== "none" ? value.replaceAll("px", "").split(", ").map((px) => px / scale).join(" ") : value);
  }
  for (const name of ["class", "style", "tabindex", "role", "aria-hidden", "vector-effect"]) to.removeAttribute(name);
  [...from.children].forEach((child, i) => inline(child, to.children[i]));
}
