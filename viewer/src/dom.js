// Elements, made with few words.

/** A sentence of the program as the page says it: no options, openings by name, signs of typography. */
export const spoken = (words) =>
  words
    .replace(/ \((?:without )?--[^)]*\)/g, "")
    .replace(/\b((?:in|out)let)_(?=\d)/g, "$1 ")
    .replaceAll("+-", "±")
    .replace(/(^|[^\w.–-])-(?=\d)/g, "$1−")
    .replace(/(\d|\d mm) x (?=\d)/g, "$1 × ")
    .replace(/(\d)%/g, "$1\u202f%");

/** An element with properties (role and aria... become attributes, `style` and `data` are objects) and children. */
export function make(tag, properties = {}, children = []) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "role") element.setAttribute("role", value);
    else if (name === "style") Object.assign(element.style, value);
    else if (name === "data") Object.assign(element.dataset, value);
    else if (name.startsWith("aria")) element.setAttribute(`aria-${name.slice(4).toLowerCase()}`, value);
    else if (name.startsWith("on")) element.addEventListener(name.slice(2).toLowerCase(), value);
    else element[name] = value;
  }
  element.append(...children.map((child) => (typeof child === "string" ? spoken(child) : child)));
  return element;
}

/** A button with properties; without words it is for others to fill. */
export const button = (words, onClick, properties = {}) => make("button", { type: "button", onClick, ...properties }, [words]);

/** An SVG element with attributes and children. */
export function svg(tag, attributes = {}, children = []) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}
