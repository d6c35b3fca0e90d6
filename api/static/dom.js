// @ts-check
/** Creation of DOM elements; text is never parsed as markup. */

/** @typedef {Node | string | number | null | undefined | false} Child */

const SVG = "http://www.w3.org/2000/svg";

/**
 * Create an element: `h("p.note", {id: "x", onclick}, "text", child)`. Properties of the element are set, `on...`
 * functions become event listeners, and all others become attributes.
 *
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K | string} name tag, with classes after dots
 * @param {Record<string, any> | Child | Child[]} [properties]
 * @param {...(Child | Child[])} children
 * @returns {any}
 */
export function h(name, properties, ...children) {
  const [tag, ...classes] = name.split("."), made = document.createElement(tag);
  made.className = classes.join(" ");
  fill(made, properties, children, (key, value) => {
    if (key in made && !key.startsWith("aria") && key !== "list" && key !== "form") /** @type {any} */ (made)[key] = value;
    else made.setAttribute(key, value);
  });
  return made;
}

/** Create an SVG element. @param {string} name @param {any} [attributes] @param {...(Child | Child[])} children */
export function svg(name, attributes, ...children) {
  const [tag, ...classes] = name.split("."), made = document.createElementNS(SVG, tag);
  if (classes.length) made.setAttribute("class", classes.join(" "));
  fill(made, attributes, children, (key, value) => made.setAttribute(key, value));
  return made;
}

/** @param {Element} made @param {any} given @param {any[]} children @param {(key: string, value: any) => void} set */
function fill(made, given, children, set) {
  const plain = given && typeof given === "object" && !Array.isArray(given) && !(given instanceof Node);
  if (!plain) children.unshift(given);
  for (const [key, value] of Object.entries(plain ? given : {})) {
    if (value === undefined || value === null) continue;
    if (key.startsWith("on") && typeof value === "function") made.addEventListener(key.slice(2), value);
    else set(key, value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false).map((child) => (child instanceof Node ? child : String(child))));
}

/** Replace the children of an element. @param {Element} element @param {...(Child | Child[])} children */
export function put(element, ...children) {
  element.replaceChildren();
  fill(element, null, children, () => {});
  return element;
}

/** Show a text in an element, or hide it without one. @param {HTMLElement} element @param {string} text */
export function tell(element, text) {
  element.hidden = !text;
  element.textContent = text;
}

/** Return the message of an error. @param {unknown} error */
export const messageOf = (error) => (error instanceof Error ? error.message : String(error));

let last = 0;
/** Return an id that no other element has. */
export const newId = () => `i${++last}`;

/** Paths of icons of 20 x 20 units, drawn as lines. */
const ICONS = {
  home: "M4 9.5 10 4l6 5.5M6 8.5V16h8V8.5",
  picture: "M3 6h3l1.5-2h5L14 6h3v10H3zM10 8.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6",
  swap: "M4 7h11l-3-3M16 13H5l3 3",
  full: "M4 8V4h4M12 4h4v4M16 12v4h-4M8 16H4v-4",
  help: "M7.6 7.4a2.5 2.5 0 1 1 3.6 2.3c-.8.4-1.2.9-1.2 1.8M10 14.4v.2",
  cameras: "M3 7h9v7H3zM12 9.5 17 7v7l-5-2.5",
  left: "M12 5 7 10l5 5", right: "m8 5 5 5-5 5",
  down: "M10 4v9M6 9.5l4 4 4-4M4 16.5h12", bin: "M4 6h12M8 6V4h4v2M6 6l.7 10h6.6L14 6",
  turn: "M15.5 7.5A6.5 6.5 0 1 0 16.5 11M16 3.5v4h-4", tip: "M4 8h12v8H4zM7 8V4.5h6V8M10 10.5v4M8.3 13l1.7 1.8 1.7-1.8", crop: "M6 2.5V14h11.5M2.5 6H14v11.5",
  brush: "M16.5 3.5 9 11l-2-2 7.5-7.5zM7.5 12c-2.5-1-4 .5-4 4.5 4 0 5.5-1.5 4.5-4",
  pen: "m4 16 .8-3.4L13 4.4l2.6 2.6-8.2 8.2z",
  play: "M7 5l8 5-8 5z", close: "M5 5l10 10M15 5 5 15", plus: "M10 4v12M4 10h12", out: "M9 4H4v12h5M8 10h8m-3-3 3 3-3 3",
};

/** @param {keyof typeof ICONS} name */
export const icon = (name) =>
  svg("svg.icon", { viewBox: "0 0 20 20", "aria-hidden": "true", focusable: "false" }, svg("path", { d: ICONS[name] }));

/** Announce a text to users of screen readers. @param {string} text */
export function announce(text) {
  const region = document.querySelector("#said");
  if (region) region.textContent = text;
}
