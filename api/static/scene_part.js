// @ts-check
/** Scene of a new job: it is read, shown in the 3D view, and refused if it is incomplete. */
import { StoredFile } from "./stored.js";
import { words } from "./words.js";

/** @typedef {import("./viewer/splat_scene.js").SplatScene} SplatScene */

export class ScenePart {
  /**
   * @param {import("./slots.js").Slot} slot
   * @param {import("./stage.js").Stage} stage
   * @param {{loaded: () => void, reload: () => void}} how `loaded` is called once the scene is shown, `reload` if the
   *   graphics card has lost it
   */
  constructor(slot, stage, { loaded, reload }) {
    this.slot = slot;
    this.stage = stage;
    this.loaded = loaded;
    this.reload = reload;
    /** @type {SplatScene | null} */
    this.opened = null;
  }

  /** Show the scene of the slot, or nothing. */
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
    viewer.onReload = () => this.reload();
    this.stage.show({ scene, colors: "own" });
    try {
      const header = await scene.headerRead;
      this.slot.say(words.scene.header(header));
      await scene.ready;
      this.loaded();
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
