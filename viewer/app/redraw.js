// Drawing a part of the page anew: what has the focus, what is typed, unfolded and explained is found again in it.
import { giveTip, tipOwner } from "./tips.js";

/** Fields with text that is not committed yet, and those of them that were taken over when they were drawn anew. */
const [typed, carried] = [new WeakSet(), new WeakSet()];
const CLICKED = "button, a, input, label, summary, tr";
let isChanging = false;
let pressed = null; // by the mouse
let isAnew = false; // since then

addEventListener("input", ({ target }) => typed.add(target));
addEventListener("change", committed, { capture: true });
addEventListener("focusout", ({ target }) => commit(target));
addEventListener("keyup", ({ key, target }) => key === "Enter" && commit(target));

addEventListener("pointerdown", press, { capture: true });
addEventListener("pointerup", release, { capture: true });

function press({ target, button, pointerType }) {
  [pressed, isAnew] = [button === 0 && pointerType === "mouse" ? target.closest(CLICKED) : null, false];
}

/** Click what was drawn anew between press and release: a browser does not. */
function release({ target }) {
  if (isAnew && pressed?.contains(target)) pressed.click();
  pressed = null;
}

/** Note a committed text; a browser also commits what is typed into a field that is taken away, and that is too early. */
function committed(event) {
  if (isChanging) return event.stopImmediatePropagation();
  if (event.target.dataset.isKeyed) return; // a list in which keys look for a word
  typed.delete(event.target);
  carried.delete(event.target);
}

/** Commit the text of a field that was taken over: for the browser it is committed already. */
function commit(field) {
  if (!isChanging && carried.has(field)) field.dispatchEvent(new Event("change", { bubbles: true }));
}

/** What an element is called in its part: by its key, or its words. */
const nameOf = (element) => element.dataset.key ?? (element.id || element.getAttribute("aria-label") || element.textContent);

/** A function that finds an element in `box` again, or the one drawn in its place: of its kind and name, and as many before it. */
function finder(box, element) {
  const name = nameOf(element);
  const same = () => [...box.querySelectorAll(element.localName)].filter((one) => nameOf(one) === name);
  const place = same().indexOf(element);
  return () => (box.contains(element) ? element : same()[place]);
}

/**
 * Give the focus to what was drawn in place of an element; else to the heading of the box.
 * A field with text that is not committed yet stays itself: only it knows what is no number yet, and where the cursor is.
 */
function refocus(box, before, after) {
  const heading = box.querySelector("h2");
  if (!after && heading) heading.tabIndex = -1;
  const isTyped = typed.has(before);
  if (isTyped && after) carried.add(before);
  if (isTyped && after !== before) after?.replaceWith(before);
  (isTyped && after ? before : (after ?? heading))?.focus({ preventScroll: true });
  if (isTyped && !after) before.dispatchEvent(new Event("change")); // the field is not there any more
}

/** Change what is in `box` and return the focus, the unfolded details and the definition to the elements that correspond. */
export function keeping(box, change) {
  const { activeElement } = document;
  const owner = tipOwner();
  const find = (element) => (box.contains(element) ? finder(box, element) : () => element);
  const focused = box !== activeElement && box.contains(activeElement) && find(activeElement);
  const described = owner && find(owner);
  const held = pressed && box.contains(pressed) && find(pressed);
  const unfolded = [...box.querySelectorAll("details[open] > summary")].map(find);
  isChanging = true;
  try {
    change();
  } finally {
    isChanging = false;
  }
  for (const summary of unfolded) summary()?.parentElement.toggleAttribute("open", true);
  if (held) [pressed, isAnew] = [held(), true];
  if (focused) refocus(box, activeElement, focused());
  if (focused || described) giveTip(described?.());
}

/** Draw the children of `box` anew. */
export function redraw(box, ...children) {
  keeping(box, () => box.replaceChildren(...children));
}
