// @ts-check
/** Inputs for a job's parameters, generated from the API's OpenAPI document. */
import { h, newId } from "./dom.js";
import { words } from "./words.js";

/**
 * @typedef {{name: string, title: string, help: string, element: HTMLElement, value: () => any, set: (value: any) => void, suggest: (text: string) => void, wrong: (text: string) => void}} Control
 *   `value` is undefined if the preset decides
 */

/** @param {any} schema @returns {any[]} alternatives of a type, without null */
const variants = (schema) => (schema.anyOf ?? [schema]).filter((/** @type {any} */ each) => each.type !== "null");
/** @param {any} schema */
const choices = (schema) => (schema.const !== undefined ? [schema.const] : (schema.enum ?? []));
/** @param {any} schema */
const isNumber = (schema) => schema.type === "number" || schema.type === "integer";
/** @param {string} name */
export const titleOf = (name) => {
  const text = name.replaceAll("_", " ").replace(/\bsos\b/, "SOS").replace(/\bsh\b/, "SH");
  return text[0].toUpperCase() + text.slice(1);
};

/**
 * @param {string} name
 * @param {any} schema schema of the parameter
 * @param {{title?: string, hint?: boolean}} [how]
 * @returns {Control}
 */
export function optionControl(name, schema, { title = titleOf(name), hint = true } = {}) {
  const id = newId(), kinds = variants(schema), fallback = String(schema["x-default"] ?? schema.default ?? "");
  const [input, read] = inputFor(kinds, fallback, id);
  const error = h("p.wrong", { id: `${id}e`, hidden: true });
  const unit = kinds.some(isNumber) && schema["x-unit"] ? h("span.unit", schema["x-unit"]) : null;
  const help = hint && schema.description ? h("p.help", { id: `${id}h` }, schema.description) : null;
  input.id = id;
  input.setAttribute("aria-describedby", [help && `${id}h`, `${id}e`].filter(Boolean).join(" "));
  const element = h("div.option", { "data-name": name }, h("label", { htmlFor: id }, title), h("div.value", input, unit), help, error);
  const wrong = (/** @type {string} */ text) => showWrong(input, error, text);
  input.addEventListener("input", () => wrong(""));
  return { name, title, help: schema.description ?? "", element, value: () => read(input.value), set: (value) => void (input.value = value === undefined || value === null ? "" : String(value)), suggest: (text) => (input.placeholder = text), wrong };
}

/**
 * @param {HTMLElement} input
 * @param {HTMLElement} error
 * @param {string} text
 */
export function showWrong(input, error, text) {
  error.hidden = !text;
  error.textContent = text;
  input.toggleAttribute("aria-invalid", !!text);
  if (text) input.setAttribute("aria-invalid", "true");
}

/**
 * @param {any[]} kinds
 * @param {string} fallback
 * @param {string} id
 * @returns {[any, (text: string) => any]}
 */
function inputFor(kinds, fallback, id) {
  const words_ = kinds.flatMap(choices);
  if (kinds.every((kind) => kind.type === "boolean")) {
    return [select([["true", words.submit.on], ["false", words.submit.off]], fallback), (text) => (text ? text === "true" : undefined)];
  }
  if (kinds.every((kind) => choices(kind).length)) return [select(words_.map((value) => [value, value]), fallback), (text) => text || undefined];
  if (kinds.length === 1 && isNumber(kinds[0])) {
    const [kind] = kinds;
    const input = h("input", { type: "number", step: kind.type === "integer" ? 1 : "any", placeholder: fallback, inputMode: kind.type === "integer" ? "numeric" : "decimal", autocomplete: "off" });
    if (kind.minimum !== undefined) input.min = kind.minimum;
    if (kind.maximum !== undefined) input.max = kind.maximum;
    return [input, (text) => (text === "" ? undefined : Number(text))];
  }
  if (kinds.some((kind) => kind.type === "array")) {
    return [h("input", { type: "text", placeholder: fallback, autocomplete: "off" }), (text) => (text.trim() ? text.split(/[\s,;]+/).filter(Boolean).map((part) => (part === "" || isNaN(Number(part)) ? part : Number(part))) : undefined)];
  }
  const input = h("input", { type: "text", placeholder: fallback, autocomplete: "off" });
  if (!words_.length) return [input, (text) => text || undefined];
  input.setAttribute("list", `${id}l`);
  const holder = h("div.listed", input, h("datalist", { id: `${id}l` }, words_.map((value) => h("option", { value }))));
  Object.defineProperties(holder, { value: { get: () => input.value, set: (text) => (input.value = text) } });
  return [aliased(holder, input), (text) => (text.trim() === "" ? undefined : isNaN(Number(text)) ? text.trim() : Number(text))];
}

/**
 * Make the id and the description of a wrapper those of its input.
 *
 * @param {any} holder
 * @param {HTMLInputElement} input
 */
function aliased(holder, input) {
  Object.defineProperty(holder, "id", { set: (value) => (input.id = value), get: () => input.id });
  holder.setAttribute = (/** @type {string} */ name, /** @type {string} */ value) => input.setAttribute(name, value);
  holder.toggleAttribute = (/** @type {string} */ name, /** @type {boolean} */ on) => input.toggleAttribute(name, on);
  holder.focus = () => input.focus();
  return holder;
}

/**
 * @param {[string, string][]} options
 * @param {string} fallback
 */
function select(options, fallback) {
  return h("select", h("option", { value: "" }, fallback.includes(" ") || !fallback ? fallback || "–" : words.submit.byDefault(fallback)), options.map(([value, text]) => h("option", { value }, text)));
}
