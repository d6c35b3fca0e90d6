// @ts-check
/** Errors of the form for a new job, shown beside the inputs that caused them. */
import { Problem } from "./api.js";
import { announce, h, messageOf, tell } from "./dom.js";
import { plainly } from "./options.js";
import { StoredFile } from "./stored.js";

export class Refusals {
  /**
   * @param {Record<string, import("./slots.js").Slot>} slots by role
   * @param {import("./options_part.js").OptionsPart} options
   * @param {import("./regions.js").RegionList} regions
   */
  constructor(slots, options, regions) {
    this.slots = slots;
    this.options = options;
    this.regions = regions;
    this.element = h("p.wrong.block", { hidden: true, role: "alert" });
  }

  /** Remove all marks but those of files that cannot be used. */
  clear() {
    for (const slot of Object.values(this.slots)) slot.wrong("");
    for (const control of this.options.controls.values()) control.wrong("");
    this.regions.clearWrong();
    tell(this.element, "");
  }

  /** Show an error beside the input that caused it. @param {unknown} error */
  show(error) {
    const text = messageOf(error);
    if (error instanceof Problem) {
      if (error.code === "unknown-input") this.askAgain(error.input);
      const told = error.errors.length ? error.errors : [{ at: "", message: text }];
      const placed = [...told].reverse().map(({ at, message }) => this.mark(error.input, at, plainly(message)));
      if (this.reveal() && placed.every(Boolean)) return;
    }
    tell(this.element, text);
  }

  /** Ask for files of a slot that have expired on the service. @param {string | undefined} role */
  askAgain(role) {
    const slot = this.slots[role ?? ""];
    slot?.askAgain(slot.files.filter((file) => file instanceof StoredFile).map(({ name }) => name));
    slot?.dropStored();
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
    const places = names.map((name) => this.slots[name ?? ""] ?? this.options.controls.get(name ?? ""));
    const place = places.find((each) => each?.element.isConnected);
    place?.wrong(message);
    return !!place;
  }

  /** Scroll to the first input that is marked as wrong, focus it and announce why. Return whether there is one. */
  reveal() {
    const input = this.element.closest("form")?.querySelector("[aria-invalid=true]"), place = input?.closest(".region") ?? input?.closest(".option, .slot, .shares");
    if (!(input instanceof HTMLElement) || !(place instanceof HTMLElement)) return false;
    for (let fold = input.closest("details"); fold; fold = fold.parentElement?.closest("details") ?? null) fold.open = true;
    place.scrollIntoView({ block: "center" });
    input.focus({ preventScroll: true });
    announce(place.querySelector(".wrong:not([hidden])")?.textContent ?? "");
    return true;
  }
}
