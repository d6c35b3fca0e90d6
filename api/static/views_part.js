// @ts-check
/** Scene of a new job, shown in the 3D view or refused, and its views: those of camera files, or an orbit around it. */
import { readCameras, ringCameras } from "./cameras.js";
import { h, put } from "./dom.js";
import { contentOf, StoredFile } from "./stored.js";
import { directionOf, uprightButtons, UPS } from "./upright.js";
import { words } from "./words.js";

/** @typedef {import("./slots.js").Slot} Slot */
/** @typedef {import("./stage.js").Stage} Stage */
/** @typedef {import("./cameras.js").JobCamera} JobCamera */

const say = words.submit;

/** @param {string} group @param {string} name @param {boolean} checked @param {() => void} changed */
export function choice(group, name, checked, changed) {
  const input = h("input", { type: "radio", name: group, checked, onchange: changed });
  return { input, element: h("label", input, h("span", name)) };
}

export class ViewsPart {
  /**
   * @param {Record<"scene" | "cameras" | "photos", Slot>} slots
   * @param {Stage} stage
   * @param {import("./options_part.js").OptionsPart} options
   * @param {import("./crop_panel.js").CropPanel} crop
   * @param {() => void} changed called when the views change
   */
  constructor(slots, stage, options, crop, changed) {
    this.slots = slots;
    this.stage = stage;
    this.options = options;
    this.crop = crop;
    this.changed = changed;
    /** Whether the user has chosen between cameras and an orbit; otherwise the files decide. */
    this.chosen = false;
    /** Number of the last request to show the cameras. */
    this.turn = 0;
    /** Number of views that the service has chosen for an orbit; 0 until it has. */
    this.planned = 0;
    this.around = choice("views", say.around, false, () => this.choose());
    this.fromFiles = choice("views", say.fromFiles, true, () => this.choose());
    this.automatic = h("p.help", say.noCameras);
    this.body = h("div.views-body");
    this.found = h("p.quiet");
    this.upright = uprightButtons(stage, (up, front) => this.standUp(up, front));
    stage.tools.prepend(this.upright);
    options.ring.addEventListener("input", (/** @type {Event} */ event) => {
      const up = options.controls.get("up");
      if (up?.element.contains(/** @type {Node} */ (event.target))) this.showUp(up.value());
      else this.showCameras();
    });
    this.element = h("section", h("h2", say.views), h("fieldset.segments.wide", h("legend.away", say.views), this.fromFiles.element, this.around.element), this.body, this.found);
  }

  /** Whether the views orbit the scene. */
  get orbiting() {
    return this.around.input.checked;
  }

  /** Choose the up direction. @param {string} up value of the option `up` @param {number[]} [front] see `Viewer.frame` */
  standUp(up, front) {
    this.options.controls.get("up")?.set(up);
    this.showUp(up, front);
  }

  /** Turn the scene and its orbit to an up direction. @param {string} up @param {number[]} [front] see `Viewer.frame` */
  showUp(up, front) {
    this.stage.standUp(directionOf(up) ?? UPS["-y"], front);
    this.showCameras();
  }

  choose() {
    this.chosen = true;
    this.show();
  }

  /** Follow the camera files, or their absence. */
  filesChanged() {
    if (this.slots.cameras.files.length) this.chosen = false;
    this.show();
  }

  /** Show what belongs to the choice of views. Without it, a scene without cameras is orbited. */
  show() {
    this.planned = 0;
    const { scene, cameras, photos } = this.slots, { ring } = this.options, orbits = !this.chosen && scene.files.length > 0 && !cameras.files.length;
    if (!this.chosen) (orbits ? this.around : this.fromFiles).input.checked = true;
    this.options.controls.get("views")?.element.toggleAttribute("hidden", this.orbiting); // an orbit has a number of views of its own
    put(this.body, orbits ? [this.automatic, cameras.element, ring] : this.orbiting ? [ring] : [cameras.element, photos.element]);
    this.upright.hidden = !this.orbiting || !scene.files.length;
    this.showCameras();
  }

  /** Show the cameras. Report a change before files are read, because a later report would clear answers that have come meanwhile. @param {boolean} [changed] whether the views have changed */
  async showCameras(changed = true) {
    const { cameras: slot } = this.slots, { viewer } = this.stage, turn = ++this.turn;
    if (changed) this.changed();
    let cameras = /** @type {JobCamera[]} */ ([]), told = "";
    if (this.orbiting) [cameras, told] = this.ringNow();
    else if (slot.files.length) {
      try {
        cameras = await readCameras(await Promise.all(slot.files.map(async (file) => ({ name: file.name, blob: await contentOf(file) }))));
        told = words.cameras.found(cameras.length);
      } catch {
        told = words.cameras.notReadHere;
      }
    }
    if (turn !== this.turn) return;
    this.found.textContent = told;
    if (viewer) this.stage.setCameras(cameras, { frames: true, stand: !this.orbiting && !viewer.touched });
  }

  /** @returns {[JobCamera[], string]} */
  ringNow() {
    const { controls } = this.options, middle = this.crop.remaining();
    const count = controls.get("orbit")?.value(), number = typeof count === "number" && count >= 1 ? Math.min(count, 400) : 0;
    const shown = number || this.planned || 24;
    const told = number || this.planned ? words.cameras.ring(shown) : words.cameras.ringAuto(shown);
    if (!middle) return [[], told];
    const up = UPS[controls.get("up")?.value()] ?? this.stage.up;
    return [ringCameras(middle, { count: shown, up, elevation: controls.get("elevation")?.value() ?? 10, radius: controls.get("radius")?.value() }), told];
  }
}

export class ScenePart {
  /**
   * @param {Slot} slot
   * @param {Stage} stage
   * @param {{loaded: () => void, reload: () => void}} how called once the scene is shown, and if the GPU has lost it
   */
  constructor(slot, stage, how) {
    this.slot = slot;
    this.stage = stage;
    this.how = how;
    /** @type {import("./viewer/splat_scene.js").SplatScene | null} */
    this.opened = null;
  }

  async show() {
    const [file] = this.slot.files, { viewer } = this.stage;
    this.opened?.end();
    this.opened = null;
    if (!viewer) return;
    viewer.touched = false;
    viewer.sides = null;
    if (!file) {
      this.stage.bar.hidden = true;
      this.stage.message("");
      return viewer.draw();
    }
    const scene = (this.opened = viewer.open(file instanceof StoredFile ? file.url : file));
    viewer.onReload = this.how.reload;
    this.stage.show({ scene, colors: "own" });
    try {
      const header = await scene.headerRead;
      this.slot.say(words.scene.header(header));
      await scene.ready;
      this.how.loaded();
    } catch (error) {
      if (this.opened !== scene) return;
      this.stage.bar.hidden = true;
      viewer.sides = null;
      viewer.draw();
      const { message, cut } = /** @type {import("./viewer/splat_scene.js").SceneFailure} */ (error);
      this.stage.message(message);
      if (cut || message === words.scene.notScene) this.slot.fail(message);
    }
  }

  end() {
    if (this.stage.viewer) this.opened?.end(); // else another stage shows it
  }
}
