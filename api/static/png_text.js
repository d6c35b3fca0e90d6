// @ts-check
/** Texts in PNG images: chunks tEXt and iTXt of the PNG specification. */

/** Bytes of the signature and of the first chunk (IHDR), after which texts may stand. */
const START = 33;

/**
 * Return a text of an image; undefined if there is none.
 *
 * @param {Blob} image
 * @param {string} keyword
 */
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

/**
 * Return a PNG with a text.
 *
 * @param {Blob} png
 * @param {string} keyword
 * @param {string} text ASCII
 */
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
