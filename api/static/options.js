// @ts-check
/** Inputs for a job's parameters, generated from the API's OpenAPI document; the strength is chosen by pictures. */
import { h, newId, tell } from "./dom.js";
import { seconds, words } from "./words.js";

/**
 * @typedef {object} Control
 * @property {string} name
 * @property {HTMLElement} element
 * @property {() => any} value undefined if the preset decides
 * @property {(value: any) => void} set
 * @property {(text: string) => void} suggest show a default while there is no value
 * @property {(preset: string) => void} follow show the default of a preset
 * @property {() => string} problem why the value cannot be sent; "" if it can
 * @property {(text: string) => void} wrong
 */

/** @param {any} schema @returns {any[]} alternatives of a type, without null */
const variants = (schema) => (schema.anyOf ?? [schema]).filter((/** @type {any} */ each) => each.type !== "null");
/** @param {any} schema */
const choices = (schema) => (schema.const !== undefined ? [schema.const] : (schema.enum ?? []));
/** @param {any} schema */
const isNumber = (schema) => schema.type === "number" || schema.type === "integer";
/** @param {string} name */
export const titleOf = (name) => {
  const text = words.options.titles[name] ?? name.replaceAll("_", " ");
  return text[0].toUpperCase() + text.slice(1);
};

/** @param {string} name @param {any} schema @param {{title?: string, hint?: boolean}} [how] @returns {Control} */
export function optionControl(name, schema, { title = titleOf(name), hint = true } = {}) {
  const id = newId(), kinds = variants(schema), shown = words.options.defaults[name];
  const preset = schema["x-default"] ?? schema.default ?? "", onOff = preset === true ? words.submit.on : preset === false ? words.submit.off : preset;
  const fallback = shown ?? String(onOff);
  const [input, read, suggest, listed = []] = inputFor(kinds);
  suggest(fallback);
  const error = h("p.wrong", { id: `${id}e`, hidden: true });
  const unit = words.options.units[name] ?? (kinds.some(isNumber) ? schema["x-unit"] : ""), told = words.options.help[name] ?? schema.description;
  const help = hint && told ? h("p.help", { id: `${id}h` }, told) : null;
  const list = listed.length ? h("datalist", { id: `${id}l` }, listed.map((value) => h("option", { value }))) : null;
  input.id = id;
  if (list) input.setAttribute("list", list.id);
  input.setAttribute("aria-describedby", [help && `${id}h`, `${id}e`].filter(Boolean).join(" "));
  const element = h("div.option", { "data-name": name }, h("label", { htmlFor: id }, title), h("div.value", input, list, unit ? h("span.unit", unit) : null), help, error);
  const factor = words.options.factors[name] ?? 1, parsed = (/** @type {string} */ text) => (typeof read(text) === "number" ? factor * read(text) : read(text));
  const wrong = (/** @type {string} */ text) => showWrong(input, error, text);
  input.addEventListener("input", () => wrong(""));
  return {
    name, element, wrong, suggest,
    value: () => parsed(input.value),
    set: (value) => void (input.value = value === undefined || value === null ? "" : String(factor === 1 ? value : value / factor)),
    follow: (preset) => suggest(schema["x-presets"]?.[preset] ?? fallback),
    problem: () => (input.validity.badInput ? words.refusals.notNumber : problemOf(kinds, read(input.value))),
  };
}

/** Return why a value does not fit its type, or "". @param {any[]} kinds @param {any} value @returns {string} */
function problemOf(kinds, value) {
  if (value === undefined || typeof value === "boolean") return "";
  const array = kinds.find((kind) => kind.type === "array"), numeric = kinds.find(isNumber);
  if (Array.isArray(value)) return array?.items ? value.map((each) => problemOf([array.items], each)).find(Boolean) ?? "" : "";
  const listed = kinds.flatMap(choices), free = kinds.some((kind) => kind.type === "string" && !choices(kind).length);
  if (typeof value === "string") return free || listed.includes(value) ? "" : listed.length ? words.refusals.notListed(listed, !!numeric) : words.refusals.notNumber;
  if (!numeric) return "";
  if (!Number.isFinite(value)) return words.refusals.notNumber;
  if (numeric.type === "integer" && !Number.isInteger(value)) return words.refusals.notWhole;
  const { minimum, maximum, exclusiveMinimum, exclusiveMaximum } = numeric;
  if (minimum !== undefined && value < minimum) return words.refusals.noLess(minimum);
  if (maximum !== undefined && value > maximum) return words.refusals.noMore(maximum);
  if (exclusiveMinimum !== undefined && value <= exclusiveMinimum) return words.refusals.above(exclusiveMinimum);
  if (exclusiveMaximum !== undefined && value >= exclusiveMaximum) return words.refusals.below(exclusiveMaximum);
  return "";
}

/** Return the value of a parameter of a job as text. @param {string} name @param {any} value @returns {string} */
export function valueText(name, value) {
  if (name === "content_weight") return strengthName(value);
  if (name === "within") return seconds(value);
  if (/background$/.test(name) && Array.isArray(value)) return value.map((part) => Math.round(255 * part)).join(", ");
  if (Array.isArray(value)) return value.map((each) => valueText("", each)).join(typeof value[0] === "object" ? "; " : ", ");
  if (value === true) return words.submit.on;
  if (typeof value !== "object") return String(value);
  const { name: own, ...parts } = value, shown = Object.entries(parts).filter(([, part]) => part !== null && part !== false);
  return [own && `${own}: `, shown.map(([key, part]) => `${titleOf(key).toLowerCase()} ${valueText(key, part)}`).join(", ")].filter(Boolean).join("");
}

/** Return a message of the service's schema in words for users. @param {string} message */
export function plainly(message) {
  const bound = /^Input should be (greater|less) than( or equal to)? ([-+.\deE]+)$/.exec(message);
  if (bound) {
    const way = /** @type {const} */ ({ greater: ["above", "noLess"], less: ["below", "noMore"] })[/** @type {"greater" | "less"} */ (bound[1])][bound[2] ? 1 : 0];
    return words.refusals[way](Number(bound[3]));
  }
  if (/^Input should be a (valid|finite) (number|integer)/.test(message)) return words.refusals.notNumber;
  return message.replace(/^Value error, /, "");
}

/** @param {HTMLElement} input @param {HTMLElement} error @param {string} text */
export function showWrong(input, error, text) {
  tell(error, text);
  input.toggleAttribute("aria-invalid", !!text);
  if (text) input.setAttribute("aria-invalid", "true");
}

/**
 * @param {any[]} kinds
 * @returns {[any, (text: string) => any, (fallback: string) => void, string[]?]} input, parser of its text, how it shows a default, and values to list
 */
function inputFor(kinds) {
  const listed = kinds.flatMap(choices);
  /** @type {(options: string[][], read: (text: string) => any) => [any, (text: string) => any, (fallback: string) => void]} */
  const chosen = (options, read) => {
    const first = h("option", { value: "" });
    const suggest = (/** @type {string} */ fallback) => (first.textContent = fallback ? words.submit.byDefault(fallback) : "–");
    return [h("select", first, options.map(([value, text]) => h("option", { value }, text))), read, suggest];
  };
  if (kinds.every((kind) => kind.type === "boolean")) {
    return chosen([["true", words.submit.on], ["false", words.submit.off]], (text) => (text ? text === "true" : undefined));
  }
  if (kinds.every((kind) => choices(kind).length)) return chosen(listed.map((value) => [value, value]), (text) => text || undefined);
  const input = h("input", { type: "text", autocomplete: "off" }), suggest = (/** @type {string} */ fallback) => void (input.placeholder = fallback);
  if (kinds.length === 1 && isNumber(kinds[0])) {
    const [kind] = kinds;
    Object.assign(input, { type: "number", step: kind.type === "integer" ? 1 : "any", inputMode: kind.type === "integer" ? "numeric" : "decimal" });
    if (kind.minimum !== undefined) input.min = kind.minimum;
    if (kind.maximum !== undefined) input.max = kind.maximum;
    return [input, (text) => (text === "" ? undefined : Number(text)), suggest];
  }
  if (kinds.some((kind) => kind.type === "array") && !kinds.some((kind) => kind.type === "string")) {
    return [input, (text) => (text.trim() ? text.split(/[\s,;]+/).filter(Boolean).map((part) => (isNaN(Number(part)) ? part : Number(part))) : undefined), suggest];
  }
  if (!listed.length) return [input, (text) => text.trim() || undefined, suggest];
  return [input, (text) => (text.trim() === "" ? undefined : isNaN(Number(text)) ? text.trim() : Number(text)), suggest, listed];
}

const say = words.strengths;
/** Content weight of each strength. @type {Record<string, number>} */
const WEIGHTS = /** @type {any} */ ("{{strengths}}");

/** Return the strength that a content weight is, or else the weight as text. @param {string | number} weight */
export const strengthName = (weight) => Object.keys(WEIGHTS).find((name) => WEIGHTS[name] === Number(weight)) ?? String(weight);

/** Add pictures of strengths. Return a function that checks that of the input's value. @param {Control} control */
export function addPictures(control) {
  const name = newId();
  /** @type {HTMLInputElement[]} */
  const inputs = Object.keys(say.titles).map((value) => h("input", { type: "radio", name, value, onchange: () => {
    control.set(value);
    control.element.dispatchEvent(new Event("input", { bubbles: true }));
  } }));
  const follow = () => inputs.forEach((input) => (input.checked = input.value === strengthName(control.value() ?? words.options.defaults.content_weight)));
  const pictures = inputs.map((input) => h("label", input, h("span", h("img", { src: new URL(`./strength/${input.value}.jpg`, import.meta.url).href, alt: "", loading: "lazy" }), h("strong", say.titles[input.value]))));
  control.element.prepend(h("fieldset.strengths", h("legend", say.legend), pictures));
  control.element.addEventListener("input", follow);
  follow();
  return follow;
}
