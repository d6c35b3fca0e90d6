// @ts-check
/** View for a new job: it joins the parts of the form, keeps a draft of it, and shows refusals beside their inputs. */
import { Problem } from "./api.js";
import { announce, h, icon, put, tell } from "./dom.js";
import { CropPanel } from "./crop_panel.js";
import { forgetDraft, keepDraft, keptDraft, UnfinishedNotice } from "./stored.js";
import { camerasProblem, imageProblem, listenToDrops, oneModel, Slot, sorted } from "./slots.js";
import { EXAMPLE, ExamplePart, PaintingsPart } from "./paintings_part.js";
import { button } from "./fields.js";
import { defaultName } from "./names.js";
import { optionControl } from "./options.js";
import { OptionsPart } from "./options_part.js";
import { costCard } from "./plan.js";
import { PaintPanel } from "./paint_panel.js";
import { Refusals } from "./refusals.js";
import { RegionList } from "./regions.js";
import { accepted } from "./tables.js";
import { SelectPanel } from "./select_panel.js";
import { Stage } from "./stage.js";
import { Submission } from "./submission.js";
import { upQuestion } from "./upright.js";
import { ScenePart, ViewsPart } from "./views_part.js";
import { words } from "./words.js";

const say = words.submit;

/** View of a new job. When it ends, its uploads stop: other views have no place to show them. */
export class SubmitView {
  constructor() {
    this.title = say.title;
    /** @type {Record<"scene" | "style" | "cameras" | "photos", Slot>} */
    this.slots = {
      scene: new Slot(say.scene, say.sceneHint, { accept: accepted, changed: () => this.sceneChanged() }),
      style: new Slot(say.style, say.styleHint, { accept: "image/*", multiple: true, pictures: true, problem: imageProblem, changed: () => this.styleChanged() }),
      cameras: new Slot(say.cameras, say.camerasHint, { accept: ".json,.bin,.txt", multiple: true, add: oneModel, problem: camerasProblem, changed: () => this.views.filesChanged() }),
      photos: new Slot(say.photos, say.photosHint, { accept: "image/*", multiple: true, problem: imageProblem, changed: () => this.refresh() }),
    };
    this.stage = new Stage();
    this.draft = keptDraft();
    this.unfinished = new UnfinishedNotice(() => Object.values(this.slots).flatMap(({ files }) => files));
    this.leaving = new AbortController();
    /** Ids of the jobs that were created. */
    this.created = "";
    /** Request that the service has not answered yet. @type {false | "planning" | "starting"} */
    this.busy = false;
    /** Scene that the masks of the regions belong to. @type {import("./stored.js").Chosen | undefined} */
    this.shown = undefined;
    /** Name of the scene of the earlier job that the form started from. */
    this.earlier = this.draft?.again ? this.draft.files.scene[0]?.name : undefined;
    this.name = optionControl("name", { type: "string" }, { title: say.name, hint: false });
    this.options = new OptionsPart(this.name);
    this.selecting = new SelectPanel(this.stage);
    this.regions = new RegionList(() => this.paintingsChanged(), this.stage.viewer ? (row) => this.selectRegion(row) : undefined);
    this.crop = new CropPanel(this.stage, (box) => this.regions.crop(box), () => this.views.showCameras());
    this.paint = new PaintPanel(this.stage, {
      side: () => this.stage.viewer?.sides?.left,
      files: async () => this.sceneFiles(),
      parameters: () => this.options.parameters(this.views.orbiting),
      opened: (open) => open && (this.selecting.close(null), this.crop.close()),
      created: (job) => this.enter([job]),
    }, this.leaving.signal);
    this.example = new ExamplePart(() => this.startExample());
    this.paintings = new PaintingsPart(this.slots.style, this.regions, () => this.styleChanged());
    this.views = new ViewsPart(this.slots, this.stage, this.options, this.crop, () => this.refresh());
    this.scene = new ScenePart(this.slots.scene, this.stage, { loaded: () => this.views.showCameras(false), reload: () => this.sceneChanged() });
    this.submission = new Submission(this.leaving.signal);
    this.refusals = new Refusals(this.slots, this.options, this.regions);
    this.build();
    this.restoreFiles();
    this.options.load(this.leaving.signal, () => this.optionsLoaded());
    listenToDrops((files) => this.take(files), this.leaving.signal);
  }

  build() {
    const { options, slots, submission } = this;
    this.invite = h("label.invite", { htmlFor: slots.scene.input.id }, h("span.plus", icon("plus")), h("strong.pointer", say.drop), h("strong.touch", say.dropTouch), h("span", say.dropMore));
    this.stage.overlay.append(this.invite, this.example.element);
    this.regionFold = h("details.fold", h("summary", say.regions), h("p.help", say.regionsHint), this.regions.element);
    this.paint.button.hidden = true;
    this.costButton = h("button.quiet", { type: "button", onclick: () => this.act(true) }, say.cost);
    this.startButton = h("button.primary", { type: "submit" }, say.start);
    this.result = h("div.result", { "aria-live": "polite" });
    this.unused = h("p.wrong.block", { hidden: true, role: "alert" });
    this.form = h("form.panel", { noValidate: true, onsubmit: (/** @type {Event} */ event) => (event.preventDefault(), this.act(false)) },
      h("header", h("h1", say.heading), h("p.lead", say.lead)), this.unfinished.element, this.name.element,
      h("section", h("h2", say.files), this.unused, slots.scene.element, this.paintings.elements),
      this.views.element,
      h("section", h("h2", say.essentials), options.presets, options.main),
      h("section", h("h2", say.more), h("div", options.lookFold, this.regionFold, options.expertFold)),
      h("div.actions", this.refusals.element, submission.element, h("div.row", this.costButton, this.startButton)), this.result);
    this.element = h("div.split", h("div.pinned", this.stage.element), this.form);
    this.views.show();
    this.unfinished.show();
  }

  restoreFiles() {
    const { draft, regions } = this;
    if (!draft) return;
    this.paintings.restore(draft);
    for (const [role, slot] of Object.entries(this.slots)) slot.add(draft.files[role]);
    regions.earlier = draft.files.mask ?? [];
    for (const region of draft.regions) regions.add().set(region);
    this.regionFold.open = draft.regions.length > 0;
    for (const [all, ask] of /** @type {const} */ ([[draft.expired, say.expired], [draft.lost ?? {}, say.lost]]))
      for (const [role, names] of Object.entries(all)) if (names.length) this.slots[/** @type {keyof typeof this.slots} */ (role)]?.askAgain(names, ask);
    this.styleChanged();
    const { shown } = this;
    regions.restoreMasks(() => this.shown === shown).catch(() => {}); // a region without its mask still names the file
  }

  optionsLoaded() {
    const { draft, options } = this;
    if (draft) {
      options.restore(draft.values, draft.preset);
      if (draft.orbiting) {
        this.views.around.input.checked = true;
        this.views.chosen = this.slots.cameras.files.length > 0;
      }
    } else options.useBudget();
    this.views.show();
    this.form.addEventListener("input", () => this.saveDraft());
  }

  /** Let the user select the Gaussians of a region. @param {import("./regions.js").Row} row */
  selectRegion(row) {
    this.paint.cancel();
    const opened = this.selecting.open(row.value().name, row.mask(), (mask) => {
      if (mask) row.setMask(mask);
      /** @type {HTMLElement} */ (row.element.querySelector(".handmade button")).focus();
    });
    row.wrong(opened ? "" : words.select.notLoaded);
  }

  saveDraft() {
    const { options, regions, views } = this;
    if (this.created || this.leaving.signal.aborted) return; // what is still loading belongs to the job
    /** @template T @param {(slot: Slot) => T} of @returns {Record<string, T>} */
    const ofSlots = (of) => Object.fromEntries(Object.entries(this.slots).map(([role, slot]) => [role, of(slot)]));
    keepDraft({
      ...(options.schema || !this.draft ? { values: options.values(), preset: options.preset, orbiting: views.orbiting } : this.draft), // until the options have loaded
      files: { ...ofSlots((slot) => slot.files), mask: regions.earlier }, expired: {}, lost: ofSlots((slot) => slot.missing), again: this.earlier !== undefined, regions: regions.kept(), ...this.paintings.kept(),
    });
  }

  /** @param {File[]} files */
  take(files) {
    if (this.paint.view) return void this.paint.use(files[0]);
    const found = sorted(files);
    for (const role of /** @type {const} */ (["cameras", "photos", "style", "scene"])) this.slots[role].add(found[role]);
    const names = found.unknown.map(({ name }) => name);
    tell(this.unused, names.length ? say.unused(names) : "");
  }

  sceneChanged() {
    const [file] = this.slots.scene.files;
    this.refresh();
    this.selecting.close(null);
    this.crop.close();
    this.paint.cancel();
    this.paint.button.hidden = !file;
    if (file !== this.shown) for (const row of this.regions.rows) row.setMask(null); // those of another scene
    this.shown = file;
    if (file && this.earlier && file.name !== this.earlier) this.leaveEarlier();
    for (const offer of [this.invite, this.example.element]) offer.hidden = !!file;
    this.crop.button.hidden = !file;
    this.scene.show();
    if (file) this.views.show();
  }

  /** Drop what belongs to the scene of an earlier job, after another one was chosen: of the example, everything. */
  leaveEarlier() {
    const { cameras, photos, style } = this.slots, example = this.earlier === EXAMPLE;
    this.earlier = undefined;
    for (const slot of [cameras, photos, ...(example ? [style] : [])]) slot.dropStored();
    if (example) this.options.reset();
  }

  /** Start a job of the example, in its painting unless one is chosen. Nothing of it remains in the form. */
  async startExample() {
    const { files: chosen } = this.slots.style, files = await this.example.files().catch((error) => void this.refuse(error));
    if (!files || this.busy || this.leaving.signal.aborted) return;
    this.clearWrong();
    this.setBusy("starting");
    await this.request(false, async () => {
      const { scene: [scene], ...sent } = await this.submission.send({ ...files, ...(chosen.length ? { style: chosen } : {}) });
      return [{ ...sent, scene, parameters: { preset: "preview", resolution: 480, within: this.options.budget || undefined } }];
    });
  }

  styleChanged() {
    this.regions.setStyles(this.slots.style.files.map(({ name }) => name));
    this.paintingsChanged();
  }

  /** Follow the paintings, and which of them belong to regions. */
  paintingsChanged() {
    this.paintings.show();
    this.crop.show(this.regions.box);
    this.nameStart();
    this.refresh();
  }

  nameStart() {
    const { jobs } = this.paintings;
    this.startButton.textContent = this.busy === "starting" ? say.starting : jobs > 1 ? say.startAll(jobs) : say.start;
  }

  /** Discard the displayed plan, which was made for other files or parameters. */
  refresh() {
    if (!this.busy) put(this.result);
    const scene = this.slots.scene.files[0]?.name;
    this.name.suggest(defaultName(scene, this.paintings.own.map(({ name }) => name)));
    this.stage.title = this.name.value() ?? defaultName(scene, []);
    this.clearWrong();
    this.unfinished.show();
    if (this.options.schema) this.saveDraft();
  }

  clearWrong() {
    this.refusals.clear();
    this.paintings.clearWrong();
  }

  /** Mark the slots of missing inputs, and inputs whose text is not what they ask for, as far as the page can check them. */
  markWrong() {
    const { scene, style, cameras } = this.slots, { orbiting } = this.views, needStyle = style.files.length ? say.needOwnStyle : say.needStyle;
    /** @type {[Slot, string, boolean][]} */
    const needed = [[scene, say.needScene, !scene.files.length], [style, needStyle, !this.paintings.own.length], [cameras, say.needCameras, !orbiting && !cameras.files.length]];
    for (const [slot, text, absent] of needed) if (absent) slot.wrong(text);
    this.regions.markMissing();
    for (const control of this.options.applying(orbiting)) control.wrong(control.problem());
    this.paintings.markInvalid();
  }

  /** Plan a job, or start it and end its plan. @param {boolean} dry @param {boolean} [sure] refuse doubtful cameras */
  async act(dry, sure = true) {
    await this.selecting.settle();
    if (this.busy === "starting" || (dry && this.busy)) return;
    this.submission.sure = sure;
    this.clearWrong();
    this.markWrong();
    if (this.refusals.reveal()) return;
    const planning = !!this.busy;
    this.setBusy(dry ? "planning" : "starting");
    if (planning) this.submission.stopping.abort();
    else await this.request(dry);
  }

  /**
   * @param {boolean} dry whether to plan first; the job is started nevertheless if the user wants that meanwhile
   * @param {() => Promise<any[]>} [bodies] sends the files, and returns the bodies of the jobs
   */
  async request(dry, bodies = () => this.bodies()) {
    this.submission.restart();
    try {
      if (dry) {
        const [body] = await bodies();
        this.showPlan(await this.submission.plan(body));
      }
      if (this.busy === "starting") this.enter(await this.submission.create(await bodies()));
    } catch (error) {
      if (!this.leaving.signal.aborted && !this.submission.stopped) this.refuse(error);
    } finally {
      this.setBusy(false);
    }
  }

  sceneFiles() {
    return { scene: this.slots.scene.files, cameras: this.views.orbiting ? [] : this.slots.cameras.files };
  }

  /** Send the files, and return the bodies of the jobs. */
  async bodies() {
    const { style, photos } = this.slots, { orbiting } = this.views;
    const files = { ...this.sceneFiles(), style: style.files, photos: orbiting ? [] : photos.files, mask: this.regions.maskFiles() };
    const sent = await this.submission.send(files), regions = this.regions.value(), shares = this.paintings.shareValues();
    const parameters = { ...this.options.parameters(orbiting), ...(regions.length ? { regions } : {}), ...(shares ? { style_weights: shares } : {}) };
    return this.paintings.bodies({ ...sent, scene: sent.scene[0], parameters });
  }

  /** @param {false | "planning" | "starting"} busy */
  setBusy(busy) {
    this.busy = busy;
    [this.costButton.disabled, this.startButton.disabled] = [!!busy, busy === "starting"];
    this.nameStart();
    this.submission.element.hidden = !busy;
    if (busy) put(this.result);
  }

  /** @param {any} plan */
  showPlan(plan) {
    if (!plan || this.busy === "starting") return;
    const { jobs } = this.paintings;
    if (plan.up) {
      this.views.planned = plan.views;
      this.views.showUp(plan.up.direction);
    }
    if (plan.up?.sure === false) return this.askUp(plan.up.candidates, true);
    this.answer(costCard(plan, this.options.controls.has("within") ? () => (this.options.useBudget(), this.act(true)) : null), jobs > 1 ? h("p.help", say.eachTakes(jobs)) : null);
  }

  /** Ask which way is up, and then continue. @param {string[]} candidates @param {boolean} dry whether to plan only */
  askUp(candidates, dry) {
    this.answer(upQuestion(this.stage, candidates, (up) => (this.views.standUp(up), this.act(dry))));
  }

  /** Ask whether to start although the cameras hardly show the scene. @param {string} why */
  askCameras(why) {
    this.slots.cameras.wrong(why);
    this.answer(h("section.card", { role: "alert" }, h("h2", say.foreign), h("p", why),
      h("div.row", button(say.around, () => this.views.around.input.click(), "primary"), button(say.anyway, () => this.act(false, false)))));
  }

  /** Show what the service has answered. @param {...(HTMLElement | null)} elements */
  answer(...elements) {
    put(this.result, ...elements);
    this.result.scrollIntoView({ block: "nearest" });
  }

  /** Open the view of created jobs. @param {any[]} jobs */
  enter(jobs) {
    if (this.leaving.signal.aborted) return announce(say.created(jobs.map(({ name }) => name).join(", ")));
    this.selecting.close(null);
    this.created = jobs.map(({ id }) => id).join("/");
    forgetDraft();
    location.hash = `#/${jobs.length > 1 ? "compare" : "jobs"}/${this.created}`;
  }

  /** Give the 3D view to that of the job that was created. @param {string} id */
  handOver(id) {
    return id === this.created && this.stage.viewer?.sides ? this.stage : undefined;
  }

  /** @param {unknown} error */
  refuse(error) {
    if (error instanceof Problem && error.code === "unsure-up") return this.askUp(error.body.candidates, false);
    if (error instanceof Problem && error.code === "unsure-cameras") return this.askCameras(error.message);
    if (error instanceof Problem && error.code === "unknown-upload") this.submission.uploads.clear();
    this.refusals.show(error);
  }

  end() {
    this.saveDraft();
    this.leaving.abort();
    for (const part of [this.selecting, this.submission, ...Object.values(this.slots), this.stage, this.scene]) part.end();
  }
}
