// @ts-check
/** Reader that takes bytes from a stream on demand. */
import { words } from "../words.js";

/** Error of a file that cannot be shown; its message is shown to the user. */
export class SceneError extends Error {}

/** Error of a file that ends too early. */
export class CutError extends SceneError {}

export class ByteReader {
  /** @param {ReadableStream<Uint8Array>} stream */
  constructor(stream) {
    this.reader = stream.getReader();
    /** Bytes that have arrived and are not taken yet. @type {Uint8Array} */
    this.rest = new Uint8Array(0);
  }

  /**
   * Return the next bytes without taking them; fewer at the end of the stream.
   *
   * @param {number} count
   * @returns {Promise<Uint8Array>}
   */
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

  /**
   * Take the next bytes, in a buffer of their own.
   *
   * @param {number} count
   * @returns {Promise<Uint8Array<ArrayBuffer>>}
   * @throws {SceneError} if the stream ends before
   */
  async take(count) {
    const found = new Uint8Array(count);
    for (let filled = 0; filled < count;) {
      if (!this.rest.length) {
        const { value, done } = await this.reader.read();
        if (done) throw new CutError(words.scene.cut);
        this.rest = value;
      }
      const part = this.rest.subarray(0, count - filled);
      found.set(part, filled);
      this.rest = this.rest.subarray(part.length);
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
    const parts = [this.rest];
    for (;;) {
      const { value, done } = await this.reader.read();
      if (done) return new Uint8Array(await new Blob(/** @type {BlobPart[]} */ (parts)).arrayBuffer());
      parts.push(value);
    }
  }

  /**
   * Return a reader of the remaining bytes, piped through another stream.
   *
   * @param {ReadableWritablePair<Uint8Array, any>} through
   * @returns {ByteReader}
   */
  piped(through) {
    const { reader, rest } = this;
    const all = new ReadableStream({
      start: (out) => out.enqueue(rest),
      pull: async (out) => {
        const { value, done } = await reader.read();
        if (done) out.close();
        else out.enqueue(value);
      },
      cancel: (why) => reader.cancel(why),
    });
    return new ByteReader(all.pipeThrough(through));
  }

  /** Cancel the stream. */
  end() {
    this.reader.cancel().catch(() => {});
  }
}
