// Drawing a part of the page anew: what has the focus, what is typed, unfolded and explained is found again in it.
import { giveTip, tipOwner } from "./tips.js";

/** Fields with text that is not committed yet, and those of them into which it was written when they were drawn anew. */
const [typed, carried] = [new WeakSet(), new WeakSet()];
let isChanging = false;

addEventListener("input", ({ target }) => typed.add(target));
addEventListener("change", committed, { capture: true });
addEventListener("focusout", ({ target }) => commit(target));
addEventListener("keyup", ({ key, target }) => key === "Enter" && commit(target));

/** Note a committed text; a browser also commits what is typed into a field that is taken away, and that is too early. */
function committed(event) {
  if (isChanging) return event.stopImmediatePropagation();
  typed.delete(event.target);
  carried.delete(event.target);
}

/** Commit the text that was written into a field: the browser commits only what was typed into it. */
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

/** Give the focus to what was drawn in place of an element, with the text typed into it; else to the heading of the box. */
function refocus(box, before, after) {
  const heading = box.querySelector("h2");
  if (!after && heading) heading.tabIndex = -1;
  (after ?? heading)?.focus({ preventScroll: true });
  if (after === before || !typed.has(before)) return;
  if (after) carry(before, after);
  else before.dispatchEvent(new Event("change")); // the field is not there any more
}

/** Write text that is not committed yet into the field drawn in place of its own, with the cursor where it was. */
function carry({ value, selectionStart, selectionEnd }, field) {
  field.value = value;
  typed.add(field);
  carried.add(field);
  if (selectionStart != null) field.setSelectionRange(selectionStart, selectionEnd);
}

/** Change what is in `box` and return the focus, the unfolded details and the definition to the elements that correspond. */
export function keeping(box, change) {
  const { activeElement } = document;
  const owner = tipOwner();
  const find = (element) => (box.contains(element) ? finder(box, element) : () => element);
  const focused = box !== activeElement && box.contains(activeElement) && find(activeElement);
  const described = owner && find(owner);
  const unfolded = [...box.querySelectorAll("details[open] > summary")].map(find);
  isChanging = true;
  try {
    change();
  } finally {
    isChanging = false;
  }
  for (const summary of unfolded) summary()?.parentElement.toggleAttribute("open", true);
  if (focused) refocus(box, activeElement, focused());
  if (focused || described) giveTip(described?.());
}

/** Draw the children of `box` anew. */
export function redraw(box, ...children) {
  keeping(box, () => box.replaceChildren(...children));
}
