// @ts-check
/** Card that shows how a form's files are sent, and then how its job is planned or created. */
import { h } from "./dom.js";
import { sendAll, Upload, uploadText } from "./uploads.js";
import { words } from "./words.js";

const say = words.uploads;

export class SendingCard {
  /** @param {() => void} stop called when the user stops the request */
  constructor(stop) {
    /** Uploads of all files that were sent. @type {Map<File, Upload>} */
    this.uploads = new Map();
    /** Uploads that the card shows. @type {Upload[]} */
    this.sending = [];
    this.bar = h("progress", { max: 1, value: 0, "aria-label": say.title });
    this.text = h("span");
    this.pauseButton = h("button.quiet.small", { type: "button", onclick: () => this.pause() }, say.pause);
    this.stopButton = h("button.quiet.small", { type: "button", onclick: stop }, words.submit.stop);
    this.title = h("strong", say.title);
    this.element = h("div.sending", { hidden: true }, h("div.row", this.title, this.text, this.pauseButton, this.stopButton), this.bar);
  }

  /** Send files, and return the ids of their uploads. @param {File[]} files */
  async send(files) {
    for (const file of files) if (!this.uploads.has(file)) this.uploads.set(file, new Upload(file, () => this.show()));
    this.sending = files.map((file) => /** @type {Upload} */ (this.uploads.get(file)));
    for (const upload of this.sending) upload.over = false;
    this.show();
    return sendAll(this.sending);
  }

  show() {
    const { sending } = this, total = sending.reduce((sum, { file }) => sum + file.size, 0), sent = sending.reduce((sum, upload) => sum + upload.sent, 0);
    const now = sending.find(({ state }) => state !== "done");
    this.bar.value = sent / Math.max(total, 1);
    this.text.textContent = now ? `${now.file.name}: ${uploadText(now)}` : "";
    this.pauseButton.hidden = this.title.hidden = !now;
    this.stopButton.hidden = false;
    this.pauseButton.textContent = now?.state === "paused" ? say.resume : say.pause;
  }

  /** Show what the service does after all files were sent. @param {string} text @param {number} [share] */
  tell(text, share) {
    this.text.textContent = text;
    if (share !== undefined) this.bar.value = share;
    else this.bar.removeAttribute("value");
  }

  pause() {
    const paused = this.sending.some(({ state }) => state === "paused");
    for (const upload of this.sending) {
      if (paused) upload.resume();
      else upload.pause();
    }
  }

  stop() {
    for (const upload of this.sending) upload.stop();
  }

  end() {
    for (const upload of this.uploads.values()) upload.stop();
  }
}
