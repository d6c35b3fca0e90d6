// @ts-check
/** Bytes of a stream, taken as they are asked for. */
import { words } from "../words.js";

/** A file that cannot be shown; the message is for people. */
export class SceneError extends Error {}

export class ByteReader {
  /** @param {ReadableStream<Uint8Array>} stream */
  constructor(stream) {
    this.reader = stream.getReader();
    /** What has come and was not taken. @type {Uint8Array} */
    this.rest = new Uint8Array(0);
  }

  /**
   * The next bytes, which stay where they are; fewer where the stream ends.
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
   * The next bytes, at the beginning of a buffer of their own.
   *
   * @param {number} count
   * @returns {Promise<Uint8Array<ArrayBuffer>>}
   * @throws {SceneError} the stream ends before
   */
  async take(count) {
    const found = new Uint8Array(count);
    for (let filled = 0; filled < count;) {
      if (!this.rest.length) {
        const { value, done } = await this.reader.read();
        if (done) throw new SceneError(words.scene.cut);
        this.rest = value;
      }
      const part = this.rest.subarray(0, count - filled);
      found.set(part, filled);
      this.rest = this.rest.subarray(part.length);
      filled += part.length;
    }
    return found;
  }

  /**
   * What has not been taken, through another stream.
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

  /** Nothing more is needed. */
  end() {
    this.reader.cancel().catch(() => {});
  }
}
