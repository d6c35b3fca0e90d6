// @ts-check
/** 3D view with its controls: wipe, cameras, screenshots and messages. */
import { announce, h, icon, messageOf, newId, put, tell } from "./dom.js";
import { cameraLines, frameSize, upOf } from "./cameras.js";
import { radios, tool } from "./fields.js";
import { fileName } from "./names.js";
import { Controls } from "./viewer/controls.js";
import { canShow, Headset } from "./viewer/headset.js";
import { dot } from "./viewer/vectors.js";
import { Viewer } from "./viewer/viewer.js";
import { words } from "./words.js";

/** @typedef {import("./cameras.js").JobCamera} JobCamera */
/** @typedef {import("./viewer/viewer.js").Side} Side */
/** @typedef {import("./viewer/headset.js").Mode} Mode */

const say = words.viewer;

export class Stage {
  /** @param {Stage} [before] stage whose viewer this one takes over, with its scene and camera */
  constructor(before) {
    this.canvas = before?.canvas ?? h("canvas.view", { tabIndex: 0, role: "application", "aria-label": say.name, "aria-description": say.instructions });
    this.overlay = h("div.overlay");
    this.note = h("p.note", { hidden: true });
    this.bar = h("div.loading", { hidden: true }, h("span"));
    this.divider = h("div.divider", {
      hidden: true, "aria-hidden": "true", onwheel: (/** @type {WheelEvent} */ event) => this.controls?.wheel(event),
      onpointerdown: (/** @type {PointerEvent} */ event) => this.divider.setPointerCapture(event.pointerId),
      onpointermove: (/** @type {PointerEvent} */ event) => {
        const { left, width } = this.canvas.getBoundingClientRect();
        if (event.buttons) this.setWipe(Math.max(0, Math.min(1, (event.clientX - left) / width)));
      },
    }, h("span"));
    this.leftName = h("span.side.left", { hidden: true });
    this.rightName = h("span.side.right", { hidden: true });
    this.tools = h("div.tools", { role: "toolbar", "aria-label": say.name });
    this.frame = h("div.frame", this.canvas, this.leftName, this.rightName, this.divider, this.overlay, this.note, this.bar);
    this.element = h("section.stage", { "aria-label": say.name }, this.frame, this.tools);
    /** Start of the names of saved images. */
    this.title = "";
    /** @type {JobCamera[]} */
    this.cameras = [];
    this.stood = -1;
    /** Viewpoint at which the view opens, instead of the first camera. @type {JobCamera | null} */
    this.start = null;
    /** @type {[string, string] | null} */
    this.names = null;
    /** Side that is shown while a key is held. @type {Side | null} */
    this.original = null;
    /** Sides that are shown again when the key is released. @type {{left: Side, right: Side} | null} */
    this.covered = null;
    /** @type {Viewer | null} */
    this.viewer = null;
    /** Lines of the selection's box or sphere, as pairs of points. */
    this.outline = new Float32Array(0);
    /** Lines of the box that the scene is cropped to. */
    this.cropped = new Float32Array(0);
    this.framesShown = true;
    this.up = before?.up ?? [0, -1, 0];
    try {
      this.viewer = before?.viewer ?? new Viewer(this.canvas);
    } catch (error) {
      this.element.classList.add("flat");
      this.message(messageOf(error));
      return;
    }
    this.viewer.told = () => this.told();
    this.controls = before?.controls ?? new Controls(this.viewer);
    this.controls.keys = { moved: () => this.leaveCamera(), toggle: () => this.toggle(), camera: (by) => this.stand(this.stood + by), home: () => this.home(), hold: (held) => this.hold(held) };
    this.controls.motion.orbit = true;
    this.makeTools();
    if (before) {
      before.viewer = null;
      this.drawFrames();
    }
  }

  makeTools() {
    const wipeId = newId();
    this.slider = h("input", { type: "range", id: wipeId, min: 0, max: 1000, step: 1, value: 500, oninput: () => this.setWipe(Number(this.slider.value) / 1000) });
    this.wipe = h("div.wipe", { hidden: true }, h("label", { htmlFor: wipeId }, say.wipe), this.slider, tool("swap", say.toggle, () => this.toggle()));
    const modes = radios(say.movement, { orbit: say.orbit, fly: say.fly }, (mode) => {
      if (this.controls) this.controls.motion.orbit = mode === "orbit"; // otherwise about the eye
      this.setHelp();
    });
    this.framesButton = tool("cameras", say.frames, () => {
      this.framesShown = !this.framesShown;
      this.framesButton.setAttribute("aria-pressed", String(this.framesShown));
      this.drawFrames();
    }, { hidden: true, "aria-pressed": "true" });
    this.chooser = h("select", { "aria-label": say.camera, onchange: () => this.stand(Number(this.chooser.value)) });
    this.cameraTools = h("div.cameras", { hidden: true },
      tool("left", say.previous, () => this.stand(this.stood - 1)), this.chooser, tool("right", say.next, () => this.stand(this.stood + 1)));
    this.helpList = h("dl");
    const help = h("details.help", h("summary", { title: say.keys, "aria-label": say.keys }, icon("help")), this.helpList);
    this.setHelp();
    help.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => event.key === "Escape" && help.open && (event.stopPropagation(), (help.open = false)));
    put(this.tools, this.wipe, this.cameraTools, modes,
      h("div.buttons", this.framesButton, tool("home", say.home, () => this.home()), tool("picture", say.screenshot, () => this.save()), tool("full", say.full, () => (document.fullscreenElement ? document.exitFullscreen() : this.element.requestFullscreen?.())), help));
    this.offerHeadsets();
  }

  /** Add a button for each way in which a headset can show the scene. */
  async offerHeadsets() {
    for (const [mode, name] of /** @type {const} */ ([["immersive-vr", say.vr], ["immersive-ar", say.ar]])) {
      if (!(await canShow(mode))) continue;
      const button = h("button.tool.wide", { type: "button", title: say.headset, "aria-pressed": "false", onclick: () => this.enter(mode, button) }, name);
      this.tools.append(button);
    }
  }

  /** Show the scene in the headset, or end that. @param {Mode} mode @param {HTMLElement} button */
  async enter(mode, button) {
    const { viewer } = this;
    if (!viewer || viewer.headset) return viewer?.headset?.end();
    try {
      await new Headset(viewer, mode, () => button.setAttribute("aria-pressed", "false")).start();
      button.setAttribute("aria-pressed", "true");
    } catch (error) {
      this.message(messageOf(error));
    }
  }

  /** Show the keys of the mode, and those of another part. @param {string[][]} [others] */
  setHelp(others = []) {
    const mode = this.controls?.motion.orbit === false ? say.flyHelp : say.orbitHelp;
    put(this.helpList, [...mode, ...others, ...say.help].map(([keys, what]) => h("div", h("dt", keys), h("dd", what))));
  }

  /** Update the stage after a change in the viewer. */
  told() {
    const { viewer } = this;
    if (!viewer) return;
    this.element.dataset.frames = String(viewer.frames);
    const scene = viewer.sides?.left.scene;
    if (viewer.lost) return this.message(say.lost);
    if (!scene?.header) return;
    const { header, loaded, degree } = scene, share = loaded / header.count;
    this.bar.hidden = scene.whole;
    this.bar.firstChild.style.width = `${100 * share}%`;
    this.message(!scene.whole ? words.scene.loading(loaded, header.count) : degree < header.degree ? words.scene.dropped(degree, header.degree) : "");
  }

  /** @param {string} text */
  message(text) {
    tell(this.note, text);
  }

  /** @param {Side} left @param {Side} [right] @param {[string, string]} [names] */
  show(left, right, names) {
    if (!this.viewer) return;
    this.names = right && names ? names : null;
    this.covered = null;
    this.viewer.camera.up = this.up;
    this.viewer.show(left, right ?? left);
    for (const part of [this.wipe, this.divider, this.leftName, this.rightName]) part.hidden = !this.names;
    if (names) [this.leftName.textContent, this.rightName.textContent] = names;
    if (this.names) this.setWipe(this.share ?? 0.5);
    else this.viewer.wipe(0);
  }

  /** Show the original on both sides while a key is held. @param {boolean} held */
  hold(held) {
    const { viewer, original } = this;
    if (!viewer?.sides || !original || held === !!this.covered) return;
    const sides = this.covered ?? { left: original, right: original };
    this.covered = held ? viewer.sides : null;
    viewer.show(sides.left, sides.right);
    if (held) announce(say.original);
  }

  /** @param {number} share fraction of the width that shows the left side */
  setWipe(share) {
    this.share = share;
    this.viewer?.wipe(share);
    this.slider.value = String(Math.round(share * 1000));
    if (this.names) this.slider.setAttribute("aria-valuetext", say.wipeAt(this.names[0], this.names[1], share));
    this.divider.style.left = `${share * 100}%`;
    this.leftName.classList.toggle("gone", share < 0.08);
    this.rightName.classList.toggle("gone", share > 0.92);
  }

  toggle() {
    if (!this.names) return;
    this.setWipe((this.share ?? 0) >= 0.5 ? 0 : 1);
    announce(this.names[this.share ? 0 : 1]);
  }

  /** @param {JobCamera[]} cameras @param {{frames?: boolean, stand?: boolean}} [how] draw them; move to the first */
  setCameras(cameras, { frames = false, stand = false } = {}) {
    this.cameras = cameras;
    if (!this.viewer) return;
    this.framesButton.hidden = !frames || !cameras.length;
    if (cameras.length > 1) this.up = upOf(cameras);
    this.cameraTools.hidden = !cameras.length;
    put(this.chooser, h("option", { value: "-1" }, say.free), cameras.map((camera, i) => h("option", { value: String(i) }, say.cameraOf(i + 1, cameras.length, camera.name.slice(-40)))));
    this.stood = -1;
    if (stand && cameras.length) this.stand(0, false);
    this.drawFrames();
  }

  drawFrames() {
    const { viewer } = this;
    if (!viewer) return;
    const middle = viewer.sides?.left.scene.middle ?? null, length = frameSize(this.cameras, middle);
    const shown = this.framesButton.hidden || !this.framesShown ? [] : this.cameras.filter((_, i) => i !== this.stood);
    viewer.lines = viewer.frozen ? new Float32Array(0) : Float32Array.of(...cameraLines(shown, length), ...this.outline, ...this.cropped);
    viewer.draw();
  }

  /** @param {number} index index of a camera; wraps around @param {boolean} [aloud] whether to announce it */
  stand(index, aloud = true) {
    const { viewer, cameras } = this;
    if (!viewer || !cameras.length) return;
    this.stood = index === -1 && this.stood === -1 ? cameras.length - 1 : Math.max(-1, index >= cameras.length ? 0 : index);
    this.chooser.value = String(this.stood);
    if (this.stood < 0) return;
    viewer.camera.up = this.up;
    viewer.camera.stand(cameras[this.stood], viewer.sides?.left.scene.middle ?? null);
    if (aloud) viewer.moved();
    this.drawFrames();
    if (aloud) announce(say.cameraOf(this.stood + 1, cameras.length, cameras[this.stood].name));
  }

  /** Move to the start again, or to the first camera, unless the user has moved; its target depends on the scene. */
  open() {
    const { viewer, start, stood } = this;
    if (!viewer || viewer.touched || (!start && stood < 0)) return;
    if (!start) return this.stand(stood, false);
    this.leaveCamera();
    viewer.camera.up = this.up;
    viewer.camera.stand(start, viewer.sides?.left.scene.middle ?? null);
    viewer.draw();
  }

  /** Return the present view as a viewpoint. @param {string} name @returns {JobCamera} */
  viewpoint(name) {
    const { canvas } = this, { camera } = /** @type {Viewer} */ (this.viewer), { clientWidth: width, clientHeight: height } = canvas;
    const [fx, fy] = camera.pixels(width, height);
    return { name, position: camera.eye, axes: camera.axes, fx, fy, width, height };
  }

  /** Move smoothly through viewpoints, unless the view is frozen. @param {JobCamera[]} viewpoints */
  fly(viewpoints) {
    if (!this.viewer || this.viewer.frozen) return;
    this.leaveCamera();
    this.viewer.camera.up = this.up;
    this.controls?.motion.fly(viewpoints);
  }

  leaveCamera() {
    if (this.stood < 0) return;
    this.stood = -1;
    this.chooser.value = "-1";
    this.drawFrames();
  }

  home() {
    if (!this.viewer?.sides?.left.scene.middle) return;
    this.leaveCamera();
    this.viewer.frame(this.up);
    this.viewer.moved();
  }

  /** Turn the scene so that a direction points up. @param {number[]} up @param {number[]} [front] see `Viewer.frame` */
  standUp(up, front) {
    const { viewer } = this;
    if (!viewer || dot(up, this.up) > 0.999) return;
    this.up = viewer.camera.up = up;
    this.leaveCamera();
    viewer.reframe(front);
  }

  async save() {
    if (this.viewer) this.download(await this.viewer.picturePng());
  }

  /** Let the browser save an image of the view. @param {Blob} png */
  download(png) {
    const url = URL.createObjectURL(png), name = [this.title, this.viewName].map(fileName).filter(Boolean).join("-");
    h("a", { href: url, download: `${name}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  }

  /** Name of the camera that the view is that of, without folder and suffix. */
  get viewName() {
    return this.cameras[this.stood]?.name.replace(/^.*\/|\.[^.]*$/g, "") || say.view;
  }

  end() {
    this.viewer?.end();
  }
}
