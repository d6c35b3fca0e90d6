// @ts-check
/** Reading of bytes from a stream on demand, of half-precision floats (rounded to nearest, clamped), and of ZIP archives below 4 GB. */
import { words } from "../words.js";

/** Error of a file that cannot be shown; its message is shown to the user. */
export class SceneError extends Error {
  constructor(message = words.scene.unreadable) {
    super(message);
  }
}

/** Error of a file that ends too early. */
export class CutError extends SceneError {}

export class ByteReader {
  /** @param {ReadableStream<Uint8Array>} stream */
  constructor(stream) {
    this.reader = stream.getReader();
    /** Bytes that have arrived and are not taken yet. @type {Uint8Array} */
    this.rest = new Uint8Array(0);
  }

  /** Return the next bytes without taking them; fewer at the end of the stream. @param {number} count */
  async peek(count) {
    while (this.rest.length < count) {
      const { value, done } = await this.reader.read();
      if (done) break;
      const both = new Uint8Array(this.rest.length + value.length);
      both.set(this.rest);
      both.set(value, this.rest.length);
      this.rest = both;
    }
    return this.rest.subarray(0, count);
  }

  /** Take the next bytes, in a buffer of their own. @param {number} count @throws {CutError} if it ends before */
  async take(count) {
    const found = new Uint8Array(count);
    for (let filled = 0; filled < count;) {
      const some = await this.some();
      if (!some) throw new CutError(words.scene.cut);
      const part = some.subarray(0, count - filled);
      found.set(part, filled);
      this.rest = some.subarray(part.length);
      filled += part.length;
    }
    return found;
  }

  /** Take the bytes that arrive next; null at the end. @returns {Promise<Uint8Array | null>} */
  async some() {
    const { rest } = this;
    this.rest = new Uint8Array(0);
    return rest.length ? rest : (await this.reader.read()).value ?? null;
  }

  /** Take all remaining bytes. @returns {Promise<Uint8Array<ArrayBuffer>>} */
  async all() {
    const parts = [];
    for (let part = await this.some(); part; part = await this.some()) parts.push(part);
    return new Uint8Array(await new Blob(/** @type {BlobPart[]} */ (parts)).arrayBuffer());
  }

  /** Return a reader of the remaining bytes, converted. @param {ReadableWritablePair<Uint8Array, any>} through */
  piped(through) {
    const all = new ReadableStream({
      pull: async (out) => {
        const part = await this.some();
        if (part) out.enqueue(part);
        else out.close();
      },
      cancel: () => this.end(),
    });
    return new ByteReader(all.pipeThrough(through));
  }

  end() {
    this.reader.cancel().catch(() => {});
  }
}

/** @param {number} bits bits of a float32 @returns {number} bits of a half */
export function halfOf(bits) {
  const sign = (bits >>> 16) & 0x8000, exponent = ((bits >>> 23) & 255) - 127, fraction = bits & 0x7fffff;
  if (exponent > 15) return sign | 0x7bff;
  if (exponent >= -14) return sign | Math.min(((exponent + 15) << 10) + ((fraction + 0x1000) >>> 13), 0x7bff);
  if (exponent < -25) return sign;
  return sign | (((fraction | 0x800000) + (1 << (-exponent - 2))) >>> (-exponent - 1)); // in units of 2^-24
}

/** @param {number} half bits of a half */
export function fromHalf(half) {
  const sign = half & 0x8000 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

/** @typedef {Map<string, () => Promise<Uint8Array<ArrayBuffer>>>} Files functions that unpack a file, by its name */

const END = 0x06054b50, END_BYTES = 22, MAX_COMMENT = 65535, ENTRY = 0x02014b50, ENTRY_BYTES = 46;
const STORED = 0, DEFLATED = 8;

/** Return the files of an archive. @param {Uint8Array<ArrayBuffer>} data @throws {CutError} if it ends too early */
export async function unzipped(data) {
  const view = new DataView(data.buffer, data.byteOffset, data.length), { length } = data;
  let end = length - END_BYTES;
  while (end >= 0 && end >= length - END_BYTES - MAX_COMMENT && view.getUint32(end, true) !== END) end--;
  if (end < 0 || view.getUint32(end, true) !== END) throw new CutError(words.scene.cut);
  /** @type {Files} */
  const files = new Map();
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0 && at + ENTRY_BYTES <= end && view.getUint32(at, true) === ENTRY; left--) {
    const method = view.getUint16(at + 10, true), bytes = view.getUint32(at + 20, true), local = view.getUint32(at + 42, true);
    const [name, extra, comment] = [28, 30, 32].map((place) => view.getUint16(at + place, true));
    files.set(new TextDecoder().decode(data.subarray(at + ENTRY_BYTES, at + ENTRY_BYTES + name)), async () => {
      const begin = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true), packed = data.subarray(begin, begin + bytes);
      if (method === STORED) return packed;
      if (method !== DEFLATED) throw new SceneError();
      return new Uint8Array(await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"))).arrayBuffer());
    });
    at += ENTRY_BYTES + name + extra + comment;
  }
  return files;
}
