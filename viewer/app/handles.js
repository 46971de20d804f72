// Handles that lie on the picture and are pulled by a pointer or by keys.
import { make } from "../src/dom.js";

const STEPS = { ArrowLeft: [-1, 0], ArrowDown: [0, -1], ArrowRight: [1, 0], ArrowUp: [0, 1], PageUp: [10, 0], PageDown: [-10, 0] };
const PAUSE_MS = 350;

/**
 * A knob with words beside it.
 * @param pulled(event) while it is in hand @param nudged([right, up]) by keys, in steps @param released() when it is let go
 */
export function makeHandle(kind, label, { pulled, nudged, released }) {
  const element = make("button", { type: "button", className: `handle ${kind}`, ariaLabel: `${label}: drag, or arrow keys` }, [
    make("span", { className: "knob" }),
    make("span", { className: "handle-word" }),
  ]);
  let isGrabbed = false;
  let timer;
  element.addEventListener("pointerdown", (event) => {
    event.stopPropagation();
    element.setPointerCapture(event.pointerId);
    isGrabbed = true;
    element.classList.add("grabbed");
  });
  element.addEventListener("pointermove", (event) => {
    if (!isGrabbed) return;
    event.stopPropagation();
    pulled(event);
  });
  // However it ends: let go, cancelled by the system, or taken away.
  element.addEventListener("lostpointercapture", () => {
    isGrabbed = false;
    element.classList.remove("grabbed");
    released();
  });
  element.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!step || event.altKey || event.ctrlKey) return;
    event.preventDefault();
    event.stopPropagation();
    nudged(step);
    clearTimeout(timer);
    timer = setTimeout(released, PAUSE_MS);
  });
  return element;
}

/** Write the words beside a knob. */
export function label(element, words) {
  element.querySelector(".handle-word").textContent = words;
}
