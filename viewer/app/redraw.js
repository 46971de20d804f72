// Drawing a part of the page anew: what has the focus, what is unfolded and the definition on show are found again in it.
import { giveTip, tipOwner } from "./tips.js";

/** What an element is called in its part: by its key, or its words. */
const nameOf = (element) => element.dataset.key ?? (element.id || element.getAttribute("aria-label") || element.textContent);

/** A function that finds an element in `box` again, or the one drawn in its place: of its kind and name, and as many before it. */
function finder(box, element) {
  const name = nameOf(element);
  const same = () => [...box.querySelectorAll(element.localName)].filter((one) => nameOf(one) === name);
  const place = same().indexOf(element);
  return () => (box.contains(element) ? element : same()[place]);
}

/** Change what is in `box` and return the focus, the unfolded details and the definition to the elements that correspond. */
export function keeping(box, change) {
  const { activeElement } = document;
  const owner = tipOwner();
  const find = (element) => (box.contains(element) ? finder(box, element) : () => element);
  const focused = box !== activeElement && box.contains(activeElement) && find(activeElement);
  const described = owner && find(owner);
  const unfolded = [...box.querySelectorAll("details[open] > summary")].map(find);
  change();
  for (const summary of unfolded) summary()?.parentElement.toggleAttribute("open", true);
  if (focused) focused()?.focus({ preventScroll: true });
  if (focused || described) giveTip(described?.());
}

/** Draw the children of `box` anew. */
export function redraw(box, ...children) {
  keeping(box, () => box.replaceChildren(...children));
}
