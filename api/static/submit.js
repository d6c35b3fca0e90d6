// @ts-check
/** View for a new job: its files, a preview, its predicted cost, and submission. */
import { ask, eventsOf, get, Problem, randomKey } from "./api.js";
import { readCameras, ringCameras } from "./cameras.js";
import { announce, h, icon, newId, put } from "./dom.js";
import { forgetDraft, keepDraft, keptDraft } from "./draft.js";
import { listenToDrops, sorted } from "./drops.js";
import { Gallery } from "./gallery.js";
import { defaultName } from "./names.js";
import { optionControl, plainly, showWrong } from "./options.js";
import { costCard } from "./plan.js";
import { RegionList } from "./regions.js";
import { accepted } from "./scene_formats.js";
import { SelectPanel } from "./select_panel.js";
import { SendingCard } from "./sending.js";
import { oneModel, Slot } from "./slots.js";
import { Stage } from "./stage.js";
import { contentOf, StoredFile } from "./stored.js";
import { addPictures } from "./strength.js";
import { forgetUnfinished, unfinished } from "./uploads.js";
import { percent, seconds, size, words } from "./words.js";

/** @typedef {import("./options.js").Control} Control */
/** @typedef {import("./stored.js").Chosen} Chosen */

const say = words.submit;
const UPS = /** @type {Record<string, number[]>} */ ({ x: [1, 0, 0], "-x": [-1, 0, 0], y: [0, 1, 0], "-y": [0, -1, 0], z: [0, 0, 1], "-z": [0, 0, -1] });

/** View of a new job. When it ends, its uploads stop: other views have no place to show them. */
export class SubmitView {
  constructor() {
    this.title = say.title;
    const changed = (/** @type {() => void} */ act) => ({ changed: act });
    this.slots = {
      scene: new Slot(say.scene, say.sceneHint, { accept: accepted, ...changed(() => this.sceneChanged()) }),
      style: new Slot(say.style, say.styleHint, { accept: "image/*", multiple: true, pictures: true, ...changed(() => this.styleChanged()) }),
      cameras: new Slot(say.cameras, say.camerasHint, { accept: ".json,.bin,.txt", multiple: true, add: oneModel, ...changed(() => this.camerasChanged()) }),
      photos: new Slot(say.photos, say.photosHint, { accept: "image/*", multiple: true, ...changed(() => this.refresh()) }),
    };
    this.stage = new Stage();
    this.draft = keptDraft();
    /** Why the scene cannot be used, as far as the page knows; "" if it can. */
    this.broken = "";
    this.name = optionControl("name", { type: "string" }, { title: say.name, hint: false });
    /** @type {Map<string, Control>} */
    this.controls = new Map([["name", this.name]]);
    /** Names of options by group, from the API's document. @type {Record<string, string[]>} */
    this.groups = { Essentials: [], Views: [], Look: [], Expert: [] };
    this.leaving = new AbortController();
    this.sending = new SendingCard(() => this.stop());
    /** Inputs for the shares of the paintings in a blend, by the paintings' names. @type {Record<string, any>} */
    this.weights = {};
    /** Scene that the masks of the regions belong to. @type {Chosen | undefined} */
    this.shown = undefined;
    this.selecting = new SelectPanel(this.stage);
    this.regions = new RegionList(() => this.paintingsChanged(), this.stage.viewer ? (row) => this.selectRegion(row) : undefined);
    this.created = false;
    /** Whether the user has chosen between cameras and an orbit; otherwise the files decide. */
    this.viewsChosen = false;
    /** Masks of regions, from an earlier job. @type {Chosen[]} */
    this.masks = [];
    /** Idempotency keys of requests for jobs, by their bodies. @type {Map<string, string>} */
    this.keys = new Map();
    /** Elements with the estimated time of each preset. @type {Map<string, HTMLElement>} */
    this.times = new Map();
    this.build();
    this.restoreFiles();
    this.loadOptions();
    listenToDrops((files) => this.take(files), this.leaving.signal);
  }

  restoreFiles() {
    const { draft } = this;
    if (!draft) return;
    this.weights = Object.fromEntries(Object.entries(draft.weights).map(([name, value]) => [name, { value }]));
    for (const [role, slot] of Object.entries(this.slots)) slot.add(draft.files[role]);
    this.masks = draft.files.mask ?? [];
    this.regions.restore(draft.regions);
    this.regionFold.open = draft.regions.length > 0;
    if (this.apart) this.apart.input.checked = draft.apart;
    for (const [role, names] of Object.entries(draft.expired)) if (names.length) this.slots[/** @type {keyof typeof this.slots} */ (role)]?.askAgain(names);
    this.styleChanged();
    this.restoreMasks().catch(() => {}); // a region without its mask still names the file
  }

  async restoreMasks() {
    const { shown } = this;
    for (const row of this.regions.rows) {
      const file = this.masks.find(({ name }) => row.value().select === `mask=${name}` && /\.bin$/i.test(name));
      if (!file || row.mask()) continue;
      const bits = new Uint8Array(await (await contentOf(file)).arrayBuffer());
      if (this.shown === shown) this.regions.restoreMask(row, bits, file);
    }
  }

  /** Let the user select the Gaussians of a region. @param {import("./regions.js").Row} row */
  selectRegion(row) {
    const opened = this.selecting.open(row.value().name, row.mask(), (mask) => {
      if (mask) row.setMask(mask);
      /** @type {HTMLElement} */ (row.element.querySelector(".handmade button")).focus();
    });
    row.wrong(opened ? "" : words.select.notLoaded);
  }

  build() {
    this.invite = h("label.invite", { htmlFor: this.slots.scene.input.id }, h("span.plus", icon("plus")), h("strong.pointer", say.drop), h("strong.touch", say.dropTouch), h("span", say.dropMore));
    this.stage.overlay.append(this.invite);
    this.presets = h("fieldset.presets", h("legend", say.preset));
    this.main = h("div.options");
    this.ring = h("div.options");
    this.around = this.choice("views", say.around, false, () => this.chooseViews());
    this.fromFiles = this.choice("views", say.fromFiles, true, () => this.chooseViews());
    this.automatic = h("p.help", say.noCameras, " ", h("button.quiet.small", { type: "button", onclick: () => this.slots.cameras.input.click() }, say.chooseCameras));
    this.viewsBody = h("div.views-body");
    this.found = h("p.quiet");
    this.gallery = new Gallery((painting) => this.slots.style.add([painting]), this.leaving.signal);
    this.blended = this.choice("paintings", say.blended, true, () => this.styleChanged());
    this.apart = this.choice("paintings", say.apart, false, () => this.styleChanged());
    this.together = h("fieldset.segments.wide", { hidden: true }, h("legend.away", say.paintings), this.blended.element, this.apart.element);
    this.shares = h("div.options.shares", { hidden: true });
    this.shareError = h("p.wrong", { hidden: true });
    this.lookOptions = h("div.options");
    this.expertOptions = h("div.options");
    this.search = h("input", { type: "search", "aria-label": say.find, placeholder: say.find, oninput: () => this.filter() });
    this.none = h("p.quiet", { hidden: true }, say.noOptions);
    this.lookFold = h("details.fold.group", h("summary", say.lookOptions), this.lookOptions);
    this.expertFold = h("details.fold.group", h("summary", say.expertOptions), h("p.help", say.expertHint), this.expertOptions);
    this.regionFold = h("details.fold", h("summary", say.regions), h("p.help", say.regionsHint), this.regions.element);
    this.problem = h("p.wrong.block", { hidden: true, role: "alert" });
    this.costButton = h("button.quiet", { type: "button", onclick: () => this.act(true) }, say.cost);
    this.startButton = h("button.primary", { type: "submit" }, say.start);
    this.result = h("div.result", { "aria-live": "polite" });
    this.notice = h("div.notice", { hidden: true });
    this.unused = h("p.wrong.block", { hidden: true, role: "alert" });
    this.form = h("form.panel", { noValidate: true, onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.act(false)) },
      h("header", h("h1", say.heading), h("p.lead", say.lead)), this.notice, this.name.element,
      h("section", h("h2", say.files), this.unused, this.slots.scene.element, this.slots.style.element, this.gallery.element, this.together, this.shares),
      h("section", h("h2", say.views), h("fieldset.segments.wide", h("legend.away", say.views), this.fromFiles.element, this.around.element), this.viewsBody, this.found),
      h("section", h("h2", say.essentials), this.presets, this.main),
      h("section", h("h2", say.more), this.search, this.none, h("div", this.lookFold, this.regionFold, this.expertFold)),
      h("div.actions", this.problem, this.sending.element, h("div.row", this.costButton, this.startButton)), this.result);
    this.element = h("div.split", h("div.pinned", this.stage.element), this.form);
    this.showViews();
    this.showUnfinished();
  }

  /**
   * @param {string} group
   * @param {string} name
   * @param {boolean} checked
   * @param {() => void} changed
   */
  choice(group, name, checked, changed) {
    const input = h("input", { type: "radio", name: group, checked, onchange: changed });
    return { input, element: h("label", input, h("span", name)) };
  }

  get orbiting() {
    return this.around?.input.checked ?? false;
  }

  chooseViews() {
    this.viewsChosen = true;
    this.showViews();
  }

  /** Show what belongs to the choice of views. Without it, a scene without cameras is orbited. */
  showViews() {
    const { scene, cameras, photos } = this.slots, open = !this.viewsChosen, orbits = open && scene.files.length > 0 && !cameras.files.length;
    if (open && this.around && this.fromFiles) (orbits ? this.around : this.fromFiles).input.checked = true;
    const parts = orbits ? [this.automatic, cameras.element, this.ring] : this.orbiting ? [this.ring] : [cameras.element, photos.element];
    if (this.viewsBody) put(this.viewsBody, parts);
    this.showCameras();
  }

  showUnfinished() {
    const chosen = Object.values(this.slots).flatMap(({ files }) => files).filter((file) => file instanceof File);
    const isOf = (/** @type {File} */ file, /** @type {any} */ { size, modified }) => file.size === size && file.lastModified === modified;
    const first = unfinished().find((upload) => chosen.every((file) => file.name !== upload.name || isOf(file, upload)));
    /** @type {any} */ (this.notice).hidden = !first;
    if (!first) return;
    const again = chosen.some(({ name }) => name === first.name), share = percent(first.sent / first.size);
    put(/** @type {Element} */ (this.notice), h("p", again ? say.resumed(first.name, share) : say.resumable(first.name, size(first.size), share)),
      h("button.quiet", { type: "button", onclick: () => (forgetUnfinished(), this.showUnfinished()) }, say.forget));
  }

  async loadOptions() {
    let schema;
    try {
      const document = await get("openapi.json", this.leaving.signal), parameters = document.components.schemas.JobParameters;
      schema = parameters.properties;
      this.groups = parameters["x-groups"];
    } catch {
      if (!this.leaving.signal.aborted) put(this.main, h("p.quiet", say.optionsAway));
      return;
    }
    for (const [name, each] of Object.entries(schema)) {
      if (["name", "style_weights", "regions", "preset"].includes(name)) continue;
      this.controls.set(name, optionControl(name, each, name === "orbit" ? { title: say.howMany } : {}));
    }
    this.makePresets(schema.preset);
    const elements = (/** @type {string[]} */ names) => names.map((name) => this.controls.get(name)?.element).filter(Boolean);
    put(this.main, ...elements(this.groups.Essentials));
    put(this.ring, ...elements(this.groups.Views));
    put(this.lookOptions, ...elements(this.groups.Look));
    put(this.expertOptions, ...elements(this.groups.Expert));
    this.ring.addEventListener("input", () => this.showCameras());
    const followStrength = addPictures(/** @type {Control} */ (this.controls.get("content_weight")));
    this.schema = schema;
    this.restoreOptions();
    followStrength();
    this.form.addEventListener("input", (/** @type {Event} */ event) => {
      this.saveDraft();
      if (!this.presets.contains(event.target)) this.forgetTimes();
    });
  }

  /** @param {any} schema */
  makePresets(schema) {
    const name = newId();
    this.choosePreset(schema.default);
    put(this.presets, h("legend", say.preset), schema.enum.map((/** @type {string} */ value) => h("label",
      h("input", { type: "radio", name, value, checked: value === schema.default, onchange: () => this.choosePreset(value) }),
      h("span", h("strong", value), h("small", say.presets[value] ?? ""), this.times.get(value) ?? this.newTime(value)))));
  }

  /** Create the element for the estimated time of a preset. @param {string} preset */
  newTime(preset) {
    const element = h("small.time");
    this.times.set(preset, element);
    return element;
  }

  /** Discard the estimated times of the presets, which were made for other files or options. */
  forgetTimes() {
    this.timing?.abort();
    for (const element of this.times.values()) element.textContent = "";
  }

  /**
   * Show the estimated time at each preset. The other presets are estimated one after another; the service remembers
   * what it has planned.
   *
   * @param {any} body job whose plan is known
   * @param {any} view its plan
   */
  async showTimes(body, view) {
    this.forgetTimes();
    const { signal } = (this.timing = new AbortController());
    const tell = (/** @type {string} */ preset, /** @type {any} */ { total_seconds: total }) => void (/** @type {any} */ (this.times.get(preset)).textContent = total === null ? "" : say.about(seconds(total)));
    tell(body.parameters.preset, view);
    for (const preset of this.times.keys()) {
      if (preset === body.parameters.preset || signal.aborted) continue;
      try {
        tell(preset, await (await ask("POST", "v1/jobs?dry_run=true", { json: { ...body, parameters: { ...body.parameters, preset } }, signal })).json());
      } catch {
        // this preset is shown without a time
      }
    }
  }

  /** @param {string} preset */
  choosePreset(preset) {
    this.preset = preset;
    for (const control of this.controls.values()) control.follow(preset);
  }

  filter() {
    const wanted = this.search.value.trim().toLowerCase();
    let shown = 0;
    for (const { name, title, help, element } of this.controls.values()) {
      if (!this.groups.Look.includes(name) && !this.groups.Expert.includes(name)) continue;
      element.hidden = !!wanted && !`${title} ${name.replaceAll("_", " ")} ${name} ${help}`.toLowerCase().includes(wanted);
      shown += element.hidden ? 0 : 1;
    }
    this.none.hidden = shown > 0;
    for (const fold of [this.lookFold, this.expertFold]) {
      if (wanted) fold.open = true;
      fold.hidden = ![...fold.querySelectorAll(".option")].some((/** @type {any} */ element) => !element.hidden);
    }
  }

  saveDraft() {
    const values = Object.fromEntries([...this.controls].map(([name, control]) => [name, control.value()]).filter(([, value]) => value !== undefined));
    keepDraft({
      ...(this.schema || !this.draft ? { values, preset: this.preset, orbiting: this.orbiting } : this.draft), // until the options have loaded
      files: { ...Object.fromEntries(Object.entries(this.slots).map(([role, slot]) => [role, slot.files])), mask: this.masks }, expired: {}, regions: this.regions.kept(),
      weights: Object.fromEntries(Object.entries(this.weights).map(([name, input]) => [name, input.value])), apart: !!this.apart?.input.checked,
    });
  }

  restoreOptions() {
    const { draft } = this;
    if (!draft) return;
    const given = Object.entries(draft.values).filter(([name, value]) => JSON.stringify(value) !== JSON.stringify(this.schema?.[name]?.default));
    for (const [name, value] of given) this.controls.get(name)?.set(Array.isArray(value) ? value.join(", ") : value);
    const preset = [...this.presets.querySelectorAll("input")].find((/** @type {any} */ input) => input.value === draft.preset);
    if (preset && draft.preset) {
      /** @type {any} */ (preset).checked = true;
      this.choosePreset(draft.preset);
    }
    if (draft.orbiting && this.around) {
      this.around.input.checked = true;
      this.viewsChosen = this.slots.cameras.files.length > 0;
    }
    this.showViews();
  }

  /** @param {File[]} files */
  take(files) {
    const found = sorted(files);
    for (const role of /** @type {const} */ (["cameras", "photos", "style", "scene"])) this.slots[role].add(found[role]);
    this.tellUnused(found.unknown.map(({ name }) => name));
  }

  /** @param {string[]} names names of dropped files that no input takes */
  tellUnused(names) {
    /** @type {any} */ (this.unused).hidden = !names.length;
    /** @type {any} */ (this.unused).textContent = names.length ? say.unused(names) : "";
  }

  async sceneChanged() {
    const [file] = this.slots.scene.files;
    this.broken = "";
    this.refresh();
    this.selecting.close(null);
    if (file !== this.shown) this.regions.dropMasks();
    this.shown = file;
    this.opened?.end();
    this.opened = null;
    if (this.invite) this.invite.hidden = !!file;
    if (file) this.showViews();
    const { viewer } = this.stage;
    if (!viewer) return;
    viewer.touched = false;
    viewer.sides = null;
    if (!file) {
      this.stage.bar.hidden = true;
      this.stage.message("");
      return viewer.draw();
    }
    const scene = (this.opened = viewer.open(file instanceof StoredFile ? file.url : file));
    viewer.onReload = () => this.sceneChanged();
    this.stage.show({ scene, colors: "own" });
    try {
      const header = await scene.headerRead;
      this.slots.scene.say(words.scene.header(header));
      await scene.ready;
      this.showCameras();
    } catch (error) {
      if (this.opened !== scene) return;
      this.stage.bar.hidden = true;
      viewer.sides = null;
      viewer.draw();
      const { message, cut } = /** @type {import("./viewer/splat_scene.js").SceneFailure} */ (error);
      this.stage.message(message);
      this.broken = cut ? message : "";
      this.slots.scene.wrong(this.broken);
    }
  }

  styleChanged() {
    this.regions.setStyles(this.slots.style.files.map(({ name }) => name));
    this.paintingsChanged();
  }

  /** Show which paintings belong to regions, and the shares of the others in a blend. */
  paintingsChanged() {
    const own = this.ownStyles, several = own.length > 1;
    this.slots.style.annotate(Object.fromEntries(Object.entries(this.regions.painted()).map(([name, regions]) => [name, say.paintingOf(regions)])));
    this.weights = Object.fromEntries(several ? own.map(({ name }) => [name, h("input", { type: "number", min: 0, step: "any", value: this.weights[name]?.value ?? "1", "aria-label": name })]) : []);
    this.together.hidden = !several;
    this.shares.hidden = !several || !!this.apart?.input.checked;
    this.startButton.textContent = this.jobs > 1 ? say.startAll(this.jobs) : say.start;
    put(this.shares, h("p.help", say.weights), Object.entries(this.weights).map(([name, input]) => h("div.option.inline", h("span", name), input)), this.shareError);
    this.refresh();
  }

  /** Paintings that belong to no region. */
  get ownStyles() {
    const painted = this.regions.painted();
    return this.slots.style.files.filter(({ name }) => !painted[name]);
  }

  /** Number of jobs to create: one, or one per painting that belongs to no region. */
  get jobs() {
    return this.apart?.input.checked ? Math.max(1, this.ownStyles.length) : 1;
  }

  /** Follow the camera files, or their absence. */
  camerasChanged() {
    if (this.slots.cameras.files.length) this.viewsChosen = false;
    this.showViews();
  }

  async showCameras() {
    const { cameras: slot } = this.slots, turn = (this.camerasTurn = (this.camerasTurn ?? 0) + 1);
    slot.wrong("");
    let cameras = /** @type {import("./cameras.js").JobCamera[]} */ ([]), told = "";
    if (this.orbiting) [cameras, told] = this.ringNow();
    else if (slot.files.length) {
      try {
        cameras = await readCameras(await Promise.all(slot.files.map(async (file) => ({ name: file.name, blob: await contentOf(file) }))));
        told = words.cameras.found(cameras.length);
      } catch {
        told = words.cameras.notReadHere;
      }
    }
    if (turn !== this.camerasTurn) return;
    /** @type {any} */ (this.found).textContent = told;
    if (this.stage.viewer) this.stage.setCameras(cameras, { frames: true, stand: !this.orbiting && !this.stage.viewer.touched });
    this.refresh();
  }

  /** @returns {[import("./cameras.js").JobCamera[], string]} */
  ringNow() {
    const middle = this.opened?.middle, count = this.controls.get("orbit")?.value(), number = typeof count === "number" && count >= 1 ? Math.min(count, 400) : 0;
    const told = number ? words.cameras.ring(number) : words.cameras.ringAuto;
    if (!middle) return [[], told];
    const up = UPS[this.controls.get("up")?.value()] ?? [0, -1, 0];
    return [ringCameras(middle, { count: number || 24, up, elevation: this.controls.get("elevation")?.value() ?? 10, radius: this.controls.get("radius")?.value() }), told];
  }

  /** Discard the displayed plan, which was made for other files or parameters. */
  refresh() {
    if (this.result && !this.busy) put(this.result);
    this.forgetTimes();
    const scene = this.slots.scene.files[0]?.name;
    this.name.suggest(defaultName(scene, this.ownStyles.map(({ name }) => name)));
    this.stage.title = this.name.value() ?? defaultName(scene, []);
    this.clearWrong();
    if (!this.notice) return; // the form is being built
    this.showUnfinished();
    if (this.schema) this.saveDraft();
  }

  clearWrong() {
    for (const slot of Object.values(this.slots)) slot.wrong(slot === this.slots.scene ? this.broken : "");
    for (const control of this.controls.values()) control.wrong("");
    this.regions.clearWrong();
    for (const weight of Object.values(this.weights)) showWrong(weight, this.shareError, "");
    if (this.problem) this.problem.hidden = true;
  }

  parameters() {
    /** @type {Record<string, any>} */
    const values = {};
    for (const [name, control] of this.controls) {
      if (!this.orbiting && this.groups.Views.includes(name)) continue;
      const value = control.value();
      if (value !== undefined) values[name] = value;
    }
    if (this.orbiting) values.orbit ??= "auto";
    if (this.preset) values.preset = this.preset;
    const regions = this.regions.value(), own = Object.values(this.weights).map((input) => Number(input.value));
    if (regions.length) values.regions = regions;
    if (this.jobs === 1 && own.some((weight) => weight !== own[0])) values.style_weights = own;
    return values;
  }

  /** Mark the slots of missing inputs, as far as the page can check them. */
  markMissing() {
    const { scene, style, cameras } = this.slots, needStyle = style.files.length ? say.needOwnStyle : say.needStyle;
    /** @type {[Slot, string, boolean][]} */
    const needed = [[scene, say.needScene, !scene.files.length], [style, needStyle, !this.ownStyles.length], [cameras, say.needCameras, !this.orbiting && !cameras.files.length]];
    for (const [slot, text, absent] of needed) if (absent) slot.wrong(text);
    this.regions.markMissing();
  }

  /** Mark inputs whose text is not what they ask for. */
  markInvalid() {
    for (const control of this.controls.values()) if (this.orbiting || !this.groups.Views.includes(control.name)) control.wrong(control.problem());
    const weight = this.jobs === 1 && Object.values(this.weights).find((input) => !(Number(input.value) > 0) || !Number.isFinite(Number(input.value)));
    if (weight) showWrong(weight, this.shareError, words.refusals.weight(weight.getAttribute("aria-label")));
  }

  /** Stop sending and planning; the form stays as it is. */
  stop() {
    this.stopped = true;
    this.stopping?.abort();
    this.sending.stop();
  }

  /** @param {boolean} dry whether to plan only */
  async act(dry) {
    if (this.busy) return;
    this.clearWrong();
    this.markMissing();
    this.markInvalid();
    if (this.reveal()) return;
    this.setBusy(true, dry);
    this.stopping = new AbortController();
    try {
      const bodies = this.bodies(await this.send());
      if (dry) await this.plan(bodies[0]);
      else await this.create(bodies);
    } catch (error) {
      if (!this.leaving.signal.aborted && !this.stopped) this.refuse(error);
    } finally {
      this.stopping = undefined;
      this.setBusy(false, dry);
    }
  }

  /** @param {boolean} busy @param {boolean} dry */
  setBusy(busy, dry) {
    this.busy = busy;
    this.stopped = false;
    for (const button of [this.costButton, this.startButton]) button.disabled = busy;
    this.startButton.textContent = busy && !dry ? say.starting : this.jobs > 1 ? say.startAll(this.jobs) : say.start;
    this.sending.element.hidden = !busy;
    if (busy) put(this.result);
  }

  /** Return the masks of the regions: those selected by hand, and those from an earlier job that a region still names. */
  maskFiles() {
    const made = this.regions.masks(), names = made.map(({ name }) => name), selections = this.regions.value().map(({ select }) => String(select ?? ""));
    const used = (/** @type {string} */ name) => selections.some((select) => select === `mask=${name}` || (select.startsWith("masks=") && name.startsWith(select.slice(6))));
    return [...made, ...this.masks.filter(({ name }) => used(name) && !names.includes(name))];
  }

  /** Upload the files that the service lacks, and return the body of `POST /v1/jobs`. */
  async send() {
    const { scene, style, cameras, photos } = this.slots, files = this.orbiting ? [] : [cameras.files, photos.files], masks = this.maskFiles();
    const all = /** @type {File[]} */ ([scene.files, style.files, ...files, masks].flat().filter((file) => !(file instanceof StoredFile)));
    const ids = await this.sending.send(all), idOf = new Map(all.map((file, i) => [/** @type {Chosen} */ (file), ids[i]]));
    const named = (/** @type {Chosen[]} */ chosen) => chosen.map((file) => (file instanceof StoredFile ? `/${file.path}` : idOf.get(file)));
    return {
      scene: named(scene.files)[0], style: named(style.files), cameras: this.orbiting ? [] : named(cameras.files),
      photos: this.orbiting ? [] : named(photos.files), mask: named(masks), parameters: this.parameters(),
    };
  }

  /** Return the bodies of the jobs: the given one, or one per painting. Paintings of regions belong to all of them. @param {any} body */
  bodies(body) {
    if (this.jobs === 1) return [body];
    const { files } = this.slots.style, own = this.ownStyles, { name } = body.parameters;
    const shared = body.style.filter((/** @type {string} */ _, /** @type {number} */ i) => !own.includes(files[i]));
    return files.flatMap((file, i) => !own.includes(file) ? [] : [{
      ...body, style: [body.style[i], ...shared], parameters: { ...body.parameters, ...(name ? { name: defaultName(name, [file.name]).slice(0, 200) } : {}) },
    }]);
  }

  /** @param {any} body */
  async plan(body) {
    this.sending.tell(say.planning);
    const answer = await ask("POST", "v1/jobs?dry_run=true", { json: body, headers: { Accept: "text/event-stream" }, signal: AbortSignal.any([this.leaving.signal, /** @type {AbortController} */ (this.stopping).signal]) });
    if (!answer.headers.get("content-type")?.includes("event-stream")) return void this.showPlan(body, await answer.json());
    for await (const { event, data } of eventsOf(answer)) {
      if (event === "planning") this.sending.tell(data.stage === "planning" ? say.planned(data.step, data.total) : words.job.stages[data.stage], data.total ? data.fraction : undefined);
      else if (event === "problem") throw new Problem(data.status, data);
      else if (event === "plan") {
        this.showPlan(body, data);
        this.result.scrollIntoView({ block: "nearest", behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" });
      }
    }
  }

  /** @param {any} body @param {any} view */
  showPlan(body, view) {
    this.showTimes(body, view);
    put(this.result, costCard(view), this.jobs > 1 ? h("p.help", say.eachTakes(this.jobs)) : null);
  }

  /** @param {any[]} bodies */
  async create(bodies) {
    this.sending.tell(say.starting);
    this.sending.stopButton.hidden = true; // the service may already have accepted the job
    /** @type {any[]} */
    const jobs = [];
    for (const body of bodies) {
      const text = JSON.stringify(body), key = this.keys.get(text) ?? randomKey();
      this.keys.set(text, key); // a second attempt creates only those jobs that are missing
      try {
        jobs.push(await (await ask("POST", "v1/jobs", { json: body, headers: { "Idempotency-Key": key } })).json());
      } catch (error) {
        if (jobs.length && error instanceof Error) error.message += ` ${say.createdSome(jobs.length, bodies.length)}`;
        throw error;
      }
    }
    if (this.leaving.signal.aborted) return announce(say.created(jobs.map(({ name }) => name).join(", ")));
    this.created = true;
    forgetDraft();
    location.hash = jobs.length > 1 ? `#/compare/${jobs.map(({ id }) => id).join("/")}` : `#/jobs/${jobs[0].id}`;
  }

  /** Show an error beside the input that caused it. @param {unknown} error */
  refuse(error) {
    const text = error instanceof Error ? error.message : String(error);
    if (error instanceof Problem) {
      if (error.code === "unknown-upload") this.sending.uploads.clear();
      if (error.code === "unknown-input") this.askAgain(error.input);
      const told = error.errors.length ? error.errors : [{ at: "", message: text }];
      const placed = [...told].reverse().map(({ at, message }) => this.mark(error.input, at, plainly(message)));
      if (this.reveal() && placed.every(Boolean)) return;
    }
    this.problem.hidden = false;
    this.problem.textContent = text;
  }

  /** Ask for files of a slot that have expired on the service. @param {string | undefined} role */
  askAgain(role) {
    const slot = this.slots[/** @type {keyof typeof this.slots} */ (role)];
    slot?.askAgain(slot.files.filter((file) => file instanceof StoredFile).map(({ name }) => name));
    slot?.changed();
  }

  /**
   * Mark the input that the service has refused. Return whether the form has it.
   *
   * @param {string | undefined} role role of the refused file, or name of the refused parameter
   * @param {string} at path of the refused parameter, such as "regions.0.select"
   * @param {string} message
   */
  mark(role, at, message) {
    if (this.regions.refuse(at, message)) return true;
    const names = [role, ...at.split(".").reverse(), /^Settings? (\w+)/.exec(message)?.[1]];
    const places = names.map((name) => this.slots[/** @type {keyof typeof this.slots} */ (name)] ?? this.controls.get(name ?? ""));
    const place = places.find((each) => each?.element.isConnected);
    place?.wrong(message);
    return !!place;
  }

  /** Scroll to the first input that is marked as wrong, focus it and announce why. Return whether there is one. */
  reveal() {
    const input = this.form.querySelector("[aria-invalid=true]"), place = input?.closest(".region") ?? input?.closest(".option, .slot, .shares");
    if (!input || !place) return false;
    for (let fold = input.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.hidden = !(fold.open = true);
    place.hidden = false;
    place.scrollIntoView({ block: "center" });
    input.focus({ preventScroll: true });
    announce(place.querySelector(".wrong:not([hidden])")?.textContent ?? "");
    return true;
  }

  end() {
    if (!this.created) this.saveDraft();
    this.leaving.abort();
    this.timing?.abort();
    this.selecting.end();
    this.sending.end();
    for (const slot of Object.values(this.slots)) slot.end();
    this.stage.end();
    this.opened?.end();
  }
}
