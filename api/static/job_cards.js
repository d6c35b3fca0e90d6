// @ts-check
/** Cards of a job's view: the download of its result, its files, and what it was made from. */
import { artifactPath } from "./api.js";
import { h, icon } from "./dom.js";
import { titleOf, valueText } from "./options.js";
import { downloads } from "./scene_formats.js";
import { size, words } from "./words.js";

const say = words.job;

/** @param {string} id id of the job @param {number} bytes size of the PLY */
export function downloadCard(id, bytes) {
  const link = h("a.button.primary", { download: "" }, icon("down"), h("span", say.download)), note = h("p.help");
  const chooser = h("select", { "aria-label": say.format, onchange: () => choose() },
    downloads.map(({ name, title }, i) => h("option", { value: name }, i ? title : `${title} · ${size(bytes)}`)));
  const choose = () => {
    const path = artifactPath(id, "stylized.ply"), first = chooser.value === downloads[0].name;
    link.href = first ? path : `${path}?format=${encodeURIComponent(chooser.value)}`;
    note.textContent = first ? "" : say.converting;
  };
  choose();
  return [h("h2", say.result), h("div.row.download", link, chooser), note];
}

/** @param {string} id id of the job @param {any[]} list its artifacts */
export function filesCard(id, list) {
  const report = list.some(({ name }) => name === "report.html");
  return [h("h2", say.files), report ? h("p", h("a.button.quiet", { href: artifactPath(id, "report.html"), target: "_blank", rel: "noopener" }, say.openReport)) : null,
    list.length ? h("ul.files", list.map(({ name, size: bytes }) => h("li", h("a", { href: artifactPath(id, name), download: name }, icon("down"), h("span", name)), h("small", size(bytes))))) : h("p.quiet", say.noFiles)];
}

/** @param {any} job */
export function factsCard(job) {
  const told = Object.entries(job.parameters).filter(([name, value]) => value !== null && value !== "" && name !== "name" && value !== false);
  const files = Object.values(job.input_counts).reduce((sum, count) => sum + Number(count), 0);
  const fact = (/** @type {string} */ name, /** @type {string} */ value) => h("div", h("dt", name), h("dd", value));
  return [h("h2", say.inputs), h("dl.facts", job.inputs.slice(0, 12).map((/** @type {any} */ input) => fact(input.role, `${input.name} · ${size(input.size)}`)), files > Math.min(job.inputs.length, 12) ? fact("", words.submit.nFiles(files)) : null),
    h("details.fold", h("summary", say.settings), h("dl.facts", told.map(([name, value]) => fact(titleOf(name), valueText(name, value)))))];
}
