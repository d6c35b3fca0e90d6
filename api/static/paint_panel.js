// @ts-check
/** Panel to paint on the current view: with a brush, or with an image painted elsewhere. The scene follows as a new job. */
import { announce, h, icon, messageOf, tell } from "./dom.js";
import { button, range } from "./fields.js";
import { statedCamera } from "./cameras.js";
import { PaintLayer, pngText, withPngText } from "./paint_layer.js";
import { Submission } from "./submission.js";
import { words } from "./words.js";

/** @typedef {import("./cameras.js").RestCamera} RestCamera */
/** @typedef {import("./stored.js").Chosen} Chosen */
/** @typedef {{view: string, camera: RestCamera}} StatedView view of an image, as jobs take it and PNGs state it */
/**
 * @typedef {object} Base what is painted on
 * @property {() => import("./viewer/viewer.js").Side | undefined} side scene and colors
 * @property {() => Promise<{scene: Chosen[], cameras: Chosen[]}>} files
 * @property {() => Record<string, any>} parameters parameters of the job that the scene is from, or of the form
 * @property {(open: boolean) => void} opened called before a view is frozen, and after the panel was closed
 * @property {(job: any) => void} created called with the job that paints
 */

const say = words.paint;
/** Keyword of the text in a PNG that states its view. */
const KEYWORD = "sgsst-view";
/** Longer side of a painted view in pixels. */
const LONGEST = 1024;
/** Parameters of other jobs that also apply to a job that paints. */
const SHARED = ["background", "orbit", "up", "elevation", "radius", "views", "resolution", "near", "drop_invalid", "spz_axes", "render_mode", "eps2d", "pad_sh"];

export class PaintPanel {
  /** @param {import("./stage.js").Stage} stage @param {Base} base @param {AbortSignal} leaving */
  constructor(stage, base, leaving) {
    this.stage = stage;
    this.base = base;
    this.leaving = leaving;
    this.layer = new PaintLayer(stage.frame, () => ({ color: this.color.value, size: Number(this.size.input.value) }), () => this.changed());
    this.submission = new Submission(leaving);
    this.submission.sure = false; // the painted view matters, the others hardly
    /** View that is painted on; null while the panel is closed. @type {StatedView | null} */
    this.view = null;
    this.button = h("button.tool.wide", { type: "button", title: say.title, "aria-label": say.paint, onclick: () => this.freeze() }, icon("brush"), h("span", say.paint));
    this.color = h("input", { type: "color", value: "#c8321e" });
    this.size = range(say.size, { min: 2, max: 150, value: 24 });
    this.file = h("input", { type: "file", accept: "image/*", hidden: true, onchange: () => this.file.files[0] && this.use(this.file.files[0]) });
    this.undo = button(say.undo, () => this.layer.undo());
    this.apply = button(say.apply, () => this.send(), "primary");
    this.back = button(words.select.cancel, () => this.cancel());
    this.wrong = h("p.wrong", { hidden: true, role: "alert" });
    this.element = h("section.selecting", { hidden: true, "aria-label": say.title }, h("div.row", h("h2", say.title)), h("p.help", say.help),
      h("div.row", h("label.check", this.color, h("span", say.color)), this.size.element, this.undo),
      h("div.row", button(say.download, () => this.download()), button(say.use, () => this.file.click()), this.file, h("span.grow"), h("div.row", this.back, this.apply)), this.wrong, this.submission.element);
    stage.tools.querySelector(".buttons")?.prepend(this.button);
    stage.element.append(this.element);
    leaving.addEventListener("abort", () => this.submission.end());
    document.addEventListener("keydown", (event) => this.key(event), { signal: leaving });
  }

  /** Freeze the current view, or a stated one. Return whether there is a scene. @param {StatedView} [stated] */
  freeze(stated) {
    const { stage, base } = this, { viewer, controls } = stage, side = base.side();
    if (!viewer || !side?.scene.whole) {
      stage.message(words.viewer.notLoadedYet);
      return false;
    }
    base.opened(true);
    controls?.motion.stop();
    stage.tools.hidden = viewer.canvas.inert = true;
    this.element.hidden = false;
    viewer.frozen = null;
    if (stated) {
      stage.leaveCamera();
      viewer.camera.stand(statedCamera(stated.camera), side.scene.middle);
    }
    const size = stated ? [stated.camera.width, stated.camera.height] : viewer.size(), scale = stated ? 1 : Math.min(1, LONGEST / Math.max(...size));
    viewer.frozen = size.map((pixels) => Math.max(1, Math.round(pixels * scale)));
    viewer.touched = true; // nothing else moves the camera from now on
    this.view = stated ?? { view: stage.viewName, camera: viewer.camera.ofImage(viewer.frozen) };
    stage.show(side);
    stage.drawFrames();
    this.layer.open(viewer.frozen[0], viewer.frozen[1]);
    tell(this.wrong, "");
    stage.element.scrollIntoView({ block: matchMedia("(max-width: 1000px)").matches ? "start" : "nearest" });
    this.color.focus({ preventScroll: true });
    announce(say.frozen);
    return true;
  }

  thaw() {
    const { viewer } = this.stage;
    if (!viewer || !this.view) return;
    this.view = viewer.frozen = null;
    this.element.hidden = true;
    this.stage.tools.hidden = viewer.canvas.inert = false;
    this.layer.close();
    this.stage.drawFrames();
  }

  cancel() {
    if (!this.view) return;
    this.thaw();
    this.base.opened(false);
    this.button.focus();
  }

  /** Show what can be done with the marks. */
  changed() {
    this.undo.disabled = this.apply.disabled = !this.layer.marks.length;
  }

  async download() {
    const { viewer } = this.stage;
    if (!viewer) return;
    const text = JSON.stringify(this.view).replace(/[^ -~]/g, (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`);
    this.stage.download(withPngText(await viewer.picturePng(), KEYWORD, text));
  }

  /** Put a painted image on the view that it states, or on the current one. @param {File} file */
  async use(file) {
    this.file.value = "";
    const image = await createImageBitmap(file).catch(() => null), stated = await statedView(file);
    if (!this.view && !this.freeze()) return;
    const { width, height } = (stated ?? /** @type {StatedView} */ (this.view)).camera;
    if (!image) return tell(this.wrong, say.notImage(file.name));
    if (image.width !== width || image.height !== height) return tell(this.wrong, say.otherSize(file.name, [image.width, image.height], [width, height]));
    if (stated && JSON.stringify(stated) !== JSON.stringify(this.view)) this.freeze(stated);
    tell(this.wrong, "");
    this.layer.add({ image });
  }

  /** Create the job in which the scene follows. */
  async send() {
    const { submission, view, base } = this, parameters = Object.entries(base.parameters()).filter(([name, value]) => SHARED.includes(name) && value !== null && value !== undefined);
    tell(this.wrong, "");
    this.apply.disabled = this.back.disabled = true;
    submission.restart();
    submission.element.hidden = false;
    try {
      const painted = new File([await this.layer.png()], "painted.png", { type: "image/png" });
      const { scene: [scene], ...sent } = await submission.send({ ...(await base.files()), painted: [painted] });
      const name = paintedName(this.stage.title).slice(0, 200);
      const [job] = await submission.create([{ scene, ...sent, parameters: { ...Object.fromEntries(parameters), painted: [view], name } }]);
      if (this.leaving.aborted) return;
      this.thaw();
      base.created(job);
    } catch (error) {
      if (!this.leaving.aborted && !submission.stopped) tell(this.wrong, messageOf(error));
    } finally {
      submission.element.hidden = true;
      this.back.disabled = false;
      this.changed();
    }
  }

  /** Handle the shortcuts of the panel, except where a text is edited. @param {KeyboardEvent} event */
  key(event) {
    const { input } = this.size, target = /** @type {Node} */ (event.target), undoes = (event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z";
    if (!this.view || !(target === document.body || this.stage.element.contains(target)) || !(undoes || event.key === "[" || event.key === "]")) return;
    event.preventDefault();
    if (undoes) this.layer.undo();
    else input.value = String(Number(input.value) + (event.key === "[" ? -4 : 4));
  }
}

/** Return the view that a PNG states; null if it states none. @param {File} file @returns {Promise<StatedView | null>} */
async function statedView(file) {
  try {
    const stated = JSON.parse((await pngText(file, KEYWORD)) ?? "");
    statedCamera(stated.camera);
    return { view: String(stated.view), camera: stated.camera };
  } catch {
    return null;
  }
}

/** Return the name of a painted scene: "comb, painted", then "comb, painted 2". @param {string} name */
function paintedName(name) {
  const [, base, number] = /^(.*?)(?:, painted(?: (\d+))?)?$/s.exec(name) ?? [];
  return `${base}, painted${base === name ? "" : ` ${Number(number ?? 1) + 1}`}`;
}
