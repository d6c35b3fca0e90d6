// @ts-check
/** Files of a new job: chosen or dropped, sorted by their names, checked as far as the page can, and listed. */
import { h, messageOf, newId, put } from "./dom.js";
import { tool } from "./fields.js";
import { showWrong } from "./options.js";
import { editPainting } from "./painting_editor.js";
import { contentOf, StoredFile } from "./stored.js";
import { installed, sceneSuffix } from "./tables.js";
import { size, words } from "./words.js";

/** @typedef {import("./stored.js").Chosen} Chosen */

const say = words.submit;
const HEIC = /\.(heic|heif|hif)$/i;
/** Number of files that a slot lists. */
const SHOWN = 12;

/** Add files to others; a file replaces one of the same name. @param {Chosen[]} old @param {Chosen[]} more */
function withoutDoubles(old, more) {
  const names = new Set(more.map(({ name }) => name));
  return [...old.filter(({ name }) => !names.has(name)), ...more];
}

/** Add camera files: JSON replaces all, parts of a COLMAP model join. @param {Chosen[]} old @param {Chosen[]} more */
export function oneModel(old, more) {
  const isJson = (/** @type {Chosen} */ { name }) => /\.json$/i.test(name);
  return more.some(isJson) ? more : withoutDoubles(old.filter((file) => !isJson(file)), more);
}

export class Slot {
  /**
   * @param {string} name
   * @param {string} hint
   * @param {{accept: string, multiple?: boolean, pictures?: boolean, add?: (old: Chosen[], more: Chosen[]) => Chosen[], problem?: (file: File) => Promise<string>, changed: () => void}} how
   *   `add` returns the files after some were chosen, `problem` why a file cannot be used
   */
  constructor(name, hint, how) {
    this.hint = hint;
    this.how = how;
    /** Why the files cannot be used, as far as the page knows; "" if they can. */
    this.broken = "";
    /** Names of files to choose again, and the text that asks for them. @type {string[]} */
    this.missing = [];
    this.ask = say.expired;
    /** @type {Chosen[]} */
    this.files = [];
    /** @type {string[]} */
    this.urls = [];
    /** Notes under files, by name. @type {Record<string, string>} */
    this.notes = {};
    const id = newId();
    const { accept, multiple } = how;
    this.input = h("input", { type: "file", id, accept, multiple, "aria-describedby": `${id}d ${id}e`, onchange: () => this.add([...this.input.files]) });
    this.detail = h("p.detail", { id: `${id}d` }, hint);
    this.error = h("p.wrong", { id: `${id}e`, hidden: true });
    this.thumbs = h("div.thumbs");
    this.action = h("span.choose", { "aria-hidden": "true" }, say.choose);
    this.pick = h("div.pick", this.input, h("div.text", h("label", { htmlFor: id }, name), this.detail), this.action);
    this.element = h("div.slot", this.pick, this.thumbs, this.error);
  }

  /** @param {Chosen[]} files */
  add(files) {
    if (!files.length) return;
    const unread = installed.heif ? [] : files.filter(({ name }) => HEIC.test(name)), read = files.filter((file) => !unread.includes(file));
    const { multiple, add = withoutDoubles } = this.how;
    if (read.length) this.files = multiple ? add(this.files, read) : [read[0]];
    this.missing = multiple ? this.missing.filter((name) => !files.some((file) => file.name === name)) : [];
    this.input.value = "";
    this.update();
    if (unread.length) this.wrong(say.noHeic(unread[0].name));
  }

  /** @param {Chosen} file */
  remove(file) {
    this.files = this.files.filter((each) => each !== file);
    this.update();
    this.input.focus();
  }

  update() {
    this.broken = "";
    this.show();
    this.how.changed();
    this.check();
  }

  async check() {
    const { files } = this;
    for (const file of files) {
      const wrong = file.size ? file instanceof File && (await this.how.problem?.(file)) : words.contents.empty(file.name);
      if (files !== this.files) return;
      if (wrong) return this.fail(wrong);
    }
  }

  /** @param {string} text why the files cannot be used */
  fail(text) {
    this.broken ||= text;
    this.wrong("");
  }

  show() {
    this.wrong("");
    this.urls.forEach((url) => URL.revokeObjectURL(url));
    this.urls = [];
    const { files } = this;
    this.element.classList.toggle("filled", files.length > 0);
    this.action.textContent = files.length && !this.how.multiple ? say.change : say.choose;
    const total = files.reduce((sum, file) => sum + file.size, 0);
    const told = files.length > 1 ? `${say.nFiles(files.length)} · ${size(total)}` : files.length ? size(total) : this.missing.length ? "" : this.hint;
    this.say([told, this.missing.length && this.ask(this.missing)].filter(Boolean).join(" · "));
    put(this.thumbs, files.slice(0, SHOWN).map((file) => this.thumb(file)), files.length > SHOWN ? h("span.quiet", say.moreFiles(files.length - SHOWN)) : null,
      files.length > 1 ? h("button.quiet.small", { type: "button", onclick: () => this.clear() }, say.removeAll) : null);
  }

  /** Let the user rotate and crop a picture, which replaces the file. @param {Chosen} file */
  async edit(file) {
    try {
      const made = await editPainting(await contentOf(file), file.name);
      if (!made || !this.files.includes(file)) return;
      this.files = this.files.map((each) => (each === file ? made : each));
      this.update();
    } catch (error) {
      this.wrong(messageOf(error));
    }
  }

  /** Show notes under files. @param {Record<string, string>} notes by the files' names */
  annotate(notes) {
    if (JSON.stringify(notes) === JSON.stringify(this.notes)) return;
    this.notes = notes;
    this.show();
  }

  clear() {
    this.files = [];
    this.update();
    this.input.focus();
  }

  dropStored() {
    this.files = this.files.filter((file) => !(file instanceof StoredFile));
    this.update();
  }

  /** Ask for files again. @param {string[]} names @param {(names: string[]) => string} [ask] text that asks for them */
  askAgain(names, ask = say.expired) {
    [this.missing, this.ask] = [names, ask];
    this.show();
  }

  /** @param {Chosen} file */
  thumb(file) {
    const remove = tool("close", say.remove(file.name), () => this.remove(file));
    if (!this.how.pictures) return h("div.thumb.plain", h("span", file.name), remove);
    const edit = tool("crop", words.painting.edit(file.name), () => this.edit(file));
    edit.classList.add("edit");
    const url = file instanceof StoredFile ? file.url : URL.createObjectURL(file);
    this.urls.push(url);
    return h("div.thumb", h("img", { src: url, alt: file.name }), edit, remove, this.notes[file.name] && h("small", this.notes[file.name]));
  }

  /** @param {string} text */
  say(text) {
    this.detail.textContent = text;
  }

  /** @param {string} text */
  wrong(text) {
    showWrong(this.input, this.error, text || this.broken);
  }

  end() {
    this.urls.forEach((url) => URL.revokeObjectURL(url));
  }
}

/** Starts of images that browsers decode, and the suffixes that promise one. */
const STARTS = ["\xff\xd8\xff", "\x89PNG", "RIFF", "GIF8", "BM"], DECODED = /\.(png|jpe?g|webp|gif|bmp)$/i;
/** Bytes above which an image is not decoded for the check. */
const LARGE = 5e7;
/** Names of the files of a COLMAP model. */
const MODEL = /^(cameras|images|points3D|frames|rigs)[^/]*\.(bin|txt)$/i;
const PICTURE = /\.(png|jpe?g|webp|tiff?|bmp|heic|heif|hif)$/i;

/** Sort dropped files into slots. Up to four images are styles; more are photos. @param {File[]} files */
export function sorted(files) {
  const pictures = files.filter((file) => PICTURE.test(file.name)), many = pictures.length > 4;
  const [scene, ...others] = files.filter((file) => sceneSuffix(file.name));
  return {
    scene: scene ? [scene] : [], cameras: files.filter((file) => namesCameras(file.name)),
    style: many ? [] : pictures, photos: many ? pictures : [],
    unknown: [...others, ...files.filter(({ name }) => !PICTURE.test(name) && !namesCameras(name) && !sceneSuffix(name))],
  };
}

/** Return the files of a drop, including those in folders. @param {DataTransfer} data @returns {Promise<File[]>} */
async function droppedFiles(data) {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.()).filter((entry) => entry);
  if (!entries.some((entry) => entry?.isDirectory)) return [...data.files];
  /** @type {File[]} */
  const found = [];
  const walk = async (/** @type {any} */ entry) => {
    if (found.length > 10000) return;
    if (entry.isFile) found.push(await new Promise((done, wrong) => entry.file(done, wrong)));
    else {
      const reader = entry.createReader();
      for (;;) {
        const part = await new Promise((done, wrong) => reader.readEntries(done, wrong));
        if (!part.length) break;
        for (const each of part) await walk(each);
      }
    }
  };
  for (const entry of entries) await walk(entry);
  return found;
}

/** Take files that are dropped anywhere. @param {(files: File[]) => void} take @param {AbortSignal} signal ends this */
export function listenToDrops(take, signal) {
  const hint = h("div.dropping", { "aria-hidden": "true" }, words.submit.dropNow);
  let depth = 0;
  document.addEventListener("dragenter", (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return;
    if (!depth++) document.body.append(hint);
  }, { signal });
  document.addEventListener("dragleave", () => !--depth && hint.remove(), { signal });
  document.addEventListener("dragover", (event) => event.preventDefault(), { signal });
  document.addEventListener("drop", async (event) => {
    event.preventDefault();
    depth = 0;
    hint.remove();
    if (event.dataTransfer) take(await droppedFiles(event.dataTransfer));
  }, { signal });
}

/** Return whether a file may hold cameras, by its name. @param {string} name */
const namesCameras = (name) => /\.json$/i.test(name) || MODEL.test(name);

/** @param {File} file @returns {Promise<string>} "" if nothing is wrong */
export async function imageProblem(file) {
  const start = String.fromCharCode(...new Uint8Array(await file.slice(0, 4).arrayBuffer()));
  if (!STARTS.some((each) => start.startsWith(each))) return DECODED.test(file.name) ? words.contents.notImage(file.name) : "";
  if (file.size > LARGE) return "";
  return createImageBitmap(file).then((image) => (image.close(), ""), () => words.contents.brokenImage(file.name));
}

/** @param {File} file @returns {Promise<string>} "" if nothing is wrong */
export async function camerasProblem(file) {
  if (!namesCameras(file.name)) return words.contents.notCameras(file.name);
  if (MODEL.test(file.name)) return "";
  return file.text().then(JSON.parse).then(() => "", () => words.contents.notJson(file.name));
}
