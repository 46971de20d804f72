// Definitions and hints: shown where the pointer rests, on focus by keys and on touch, and read to those who cannot see them.
import { make } from "../src/dom.js";

const REST_MS = 350;
const tip = make("div", { className: "tip", role: "tooltip", id: "tip", hidden: true });
let owner = null;
let timer;

/** Take over every `title` of the page: a title alone is not shown on focus and on touch. */
export function listenForTips(root) {
  root.append(tip);
  const find = (event) => taken(event.target instanceof Element ? event.target.closest("[title], [data-tip]") : null);
  // The page moves and changes below a pointer that rests: that takes no definition away from what has the focus.
  const pointer = { x: NaN, y: NaN };
  document.addEventListener("pointermove", ({ clientX, clientY }) => Object.assign(pointer, { x: clientX, y: clientY }), { passive: true });
  document.addEventListener("pointerover", (event) => {
    const found = find(event);
    const rests = event.clientX === pointer.x && event.clientY === pointer.y;
    if (found === owner || ((!found || rests) && isHeld())) return;
    hide();
    if (found && event.pointerType !== "touch") timer = setTimeout(() => show(found), REST_MS);
  });
  document.addEventListener("focusin", (event) => {
    const found = find(event);
    if (found && event.target.matches(":focus-visible")) show(found);
    else hide();
  });
  document.addEventListener("focusout", hide);
  document.addEventListener("click", (event) => {
    const found = find(event);
    // A button does what it does; what only explains itself is opened and closed.
    if (!found || event.target.closest("button, a, input, select, label")) return hide();
    if (found === owner) hide();
    else show(found);
  });
  document.addEventListener("keydown", (event) => event.key === "Escape" && hide());
  document.addEventListener("scroll", () => (isHeld() ? place() : hide()), { capture: true, passive: true });
}

/** Whether the tip belongs to what has the focus: bringing that into view scrolls, and moves other things below the pointer. */
function isHeld() {
  return Boolean(owner?.contains(document.activeElement));
}

/** The element with its title taken over. */
function taken(element) {
  if (element?.title) {
    element.dataset.tip = element.title;
    if (!element.textContent.trim() && !element.ariaLabel) element.ariaLabel = element.title;
    element.removeAttribute("title");
  }
  return element;
}

/** The element whose definition is shown, or null. */
export const tipOwner = () => owner;

/** Show the definition of the element that was drawn in place of the tip's owner; without one the tip goes. */
export function giveTip(element) {
  if (element?.isConnected && taken(element).dataset.tip) show(element);
  else hide();
}

function show(element) {
  clearTimeout(timer);
  if (!element.isConnected) return;
  owner?.removeAttribute("aria-describedby");
  owner = element;
  element.setAttribute("aria-describedby", "tip");
  tip.textContent = element.dataset.tip;
  tip.hidden = false;
  place();
}

/** Put the tip below its element, or above it where there is no room. */
function place() {
  const box = owner.getBoundingClientRect();
  const [width, height] = [tip.offsetWidth, tip.offsetHeight];
  const top = box.bottom + 8 + height > innerHeight ? box.top - height - 8 : box.bottom + 8;
  tip.style.left = `${Math.max(8, Math.min(box.left, innerWidth - width - 8))}px`;
  tip.style.top = `${Math.max(8, top)}px`;
}

function hide() {
  clearTimeout(timer);
  owner?.removeAttribute("aria-describedby");
  owner = null;
  tip.hidden = true;
}
