// @ts-check
/** Painted views: a layer of strokes and images over a view, and PNGs whose text chunks (tEXt, iTXt) state the view. */
import { h } from "./dom.js";

/** @typedef {{image?: ImageBitmap, color?: string, size?: number, points?: number[][]}} Mark image of the layer's size, or stroke, with its width and points in pixels of the layer */

export class PaintLayer {
  /** @type {Mark[]} */
  marks = [];
  /** Pointer that paints, and its stroke. @type {{id: number, points: number[][]} | null} */
  stroke = null;

  /**
   * @param {HTMLElement} frame element with the 3D view
   * @param {() => {color: string, size: number}} brush returns the color of the brush, and its diameter in CSS pixels
   * @param {() => void} changed called after each change of the marks
   */
  constructor(frame, brush, changed) {
    this.frame = frame;
    this.brush = brush;
    this.changed = changed;
    this.tip = h("span.tip", { hidden: true });
    const up = (/** @type {PointerEvent} */ event) => event.pointerId === this.stroke?.id && (this.stroke = null);
    this.canvas = h("canvas.surface.paint", {
      "aria-hidden": "true", onpointerup: up, onpointercancel: up, onpointerleave: () => (this.tip.hidden = true),
      onpointerdown: (/** @type {PointerEvent} */ event) => this.down(event),
      onpointermove: (/** @type {PointerEvent} */ event) => this.move(event),
      oncontextmenu: (/** @type {Event} */ event) => event.preventDefault(),
    });
  }

  /** Start with an empty layer. @param {number} width pixels @param {number} height */
  open(width, height) {
    [this.canvas.width, this.canvas.height] = [width, height];
    this.tip.hidden = true;
    this.frame.append(this.canvas, this.tip);
    this.marks = [];
    this.changed();
  }

  close() {
    this.canvas.remove();
    this.tip.remove();
    this.stroke = null;
  }

  /** Pixels of the layer per CSS pixel. The frame shows the whole layer, with its own aspect ratio. */
  get ratio() {
    const { width, height, clientWidth, clientHeight } = this.canvas;
    return Math.max(width / clientWidth, height / clientHeight);
  }

  /** @param {PointerEvent} event @returns {number[]} pixel of the layer */
  pixelOf(event) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect(), { ratio } = this;
    return [this.canvas.width / 2 + (event.clientX - left - width / 2) * ratio, this.canvas.height / 2 + (event.clientY - top - height / 2) * ratio];
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (event.button !== 0 || this.stroke) return;
    event.preventDefault();
    this.canvas.setPointerCapture(event.pointerId);
    const { color, size } = this.brush(), [x, y] = this.pixelOf(event), points = [[x, y], [x + 0.01, y]]; // a line of no length would not be drawn
    this.stroke = { id: event.pointerId, points };
    this.add({ color, size: size * this.ratio, points });
  }

  /** @param {PointerEvent} event */
  move(event) {
    const box = this.canvas.getBoundingClientRect(), size = `${this.brush().size}px`;
    this.tip.hidden = event.pointerType === "touch";
    Object.assign(this.tip.style, { left: `${event.clientX - box.left}px`, top: `${event.clientY - box.top}px`, width: size, height: size });
    if (event.pointerId !== this.stroke?.id) return;
    const { points } = this.stroke, known = points.length, coalesced = event.getCoalescedEvents?.() ?? [];
    points.push(...(coalesced.length ? coalesced : [event]).map((each) => this.pixelOf(each)));
    this.draw(this.marks[this.marks.length - 1], known - 1);
  }

  /** @param {Mark} mark */
  add(mark) {
    this.marks.push(mark);
    this.draw(mark);
    this.changed();
  }

  undo() {
    if (this.stroke || !this.marks.pop()) return;
    this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    for (const mark of this.marks) this.draw(mark);
    this.changed();
  }

  get context() {
    return /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
  }

  /** Draw an image, or a stroke from one of its points. @param {Mark} mark @param {number} [first] */
  draw({ image, color, size, points = [] }, first = 0) {
    const { context } = this;
    if (image) return context.drawImage(image, 0, 0);
    Object.assign(context, { strokeStyle: color, lineWidth: size, lineCap: "round", lineJoin: "round" });
    context.beginPath();
    for (const [x, y] of points.slice(first)) context.lineTo(x, y);
    context.stroke();
  }

  /** Return the layer as a PNG, transparent where nothing is painted. @returns {Promise<Blob>} */
  png() {
    return new Promise((done) => this.canvas.toBlob(done, "image/png"));
  }
}

/** Bytes of the signature and of the first chunk (IHDR), after which texts may stand. */
const START = 33;

/** Return a text of an image; undefined if there is none. @param {Blob} image @param {string} keyword */
export async function pngText(image, keyword) {
  const bytes = new Uint8Array(await image.arrayBuffer()), view = new DataView(bytes.buffer);
  for (let at = 8; at + 12 <= bytes.length; at += 12 + view.getUint32(at)) {
    const type = String.fromCharCode(...bytes.subarray(at + 4, at + 8)), data = bytes.subarray(at + 8, at + 8 + view.getUint32(at));
    if (type !== "tEXt" && type !== "iTXt") continue;
    const content = new TextDecoder(type === "tEXt" ? "latin1" : "utf-8").decode(data), start = keyword.length + 1;
    if (!content.startsWith(`${keyword}\0`)) continue;
    // an iTXt has two bytes about compression, a language and a translated keyword before its text
    return type === "tEXt" ? content.slice(start) : content.slice(start + 2).split("\0").slice(2).join("\0");
  }
}

/** Return a PNG with a text. @param {Blob} png @param {string} keyword @param {string} text ASCII */
export function withPngText(png, keyword, text) {
  const data = new TextEncoder().encode(`tEXt${keyword}\0${text}`), chunk = new Uint8Array(data.length + 8), view = new DataView(chunk.buffer);
  view.setUint32(0, data.length - 4);
  chunk.set(data, 4);
  view.setUint32(chunk.length - 4, crc32(data));
  return new Blob([png.slice(0, START), chunk, png.slice(START)], { type: "image/png" });
}

/** Return the checksum of a chunk's type and data. @param {Uint8Array} bytes */
function crc32(bytes) {
  let rest = 0xffffffff;
  for (const byte of bytes) {
    rest ^= byte;
    for (let bit = 0; bit < 8; bit++) rest = (rest >>> 1) ^ (rest & 1 ? 0xedb88320 : 0);
  }
  return ~rest >>> 0;
}
