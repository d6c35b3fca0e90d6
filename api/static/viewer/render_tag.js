// @ts-check
/** Render mode that a scene's file states, read as `sgsst_core/files/formats/render_tag.py` does. */

/** @typedef {{antialiased: boolean, eps2d: number}} Rendering `eps2d`: variance in square pixels that blurs Gaussians */

const EPS2D = 0.3, MIP_EPS2D = 0.1, MAX_EPS2D = 100;
/** @type {Rendering} */
export const CLASSIC = { antialiased: false, eps2d: EPS2D };
/** @type {Rendering} */
export const ANTIALIASED = { antialiased: true, eps2d: EPS2D };

const MODE = /^splatrendermode:\s*(mip|default|2dgs)\s*$/i;
const FLAG = /^(?:antialiased\s+|fvdb_ply_\w+antialias\|int64\|)([01])\s*$/i;
const BLUR = /^(?:eps2d\s+|fvdb_ply_\w+eps2d\|double\|)([\d.eE+-]+)\s*$/i;

/** @param {string[]} comments the last one counts @param {string[]} names those of properties @returns {Rendering} */
export function plyRendering(comments, names) {
  const filtered = names.includes("filter_3D"), flat = isFlat(names);
  /** @type {boolean | null} */
  let antialiased = null;
  /** @type {number | null} */
  let eps2d = null;
  for (const comment of comments) {
    const mode = MODE.exec(comment), flag = FLAG.exec(comment), blur = BLUR.exec(comment);
    if (mode) antialiased = mode[1].toLowerCase() === "mip";
    if (flag) antialiased = flag[1] === "1";
    if (blur) eps2d = usable(Number(blur[1]));
  }
  antialiased = (antialiased ?? filtered) && !flat;
  const usual = antialiased && (filtered || comments.includes("Exported from Brush")) ? MIP_EPS2D : EPS2D;
  return { antialiased, eps2d: eps2d ?? usual };
}

/** @param {any} extras value that should be a JSON object with `model` and `eps2d` @returns {Rendering} */
export function extrasRendering(extras) {
  const eps2d = typeof extras?.eps2d === "number" ? usable(extras.eps2d) : null;
  return { antialiased: extras?.model === "antialiased", eps2d: eps2d ?? EPS2D };
}

/** Return whether properties are those of 2DGS, whose Gaussians have no third axis. @param {string[]} names */
export const isFlat = (names) => names.includes("scale_1") && !names.includes("scale_2") && !names.includes("scale");

/** Return a job's render mode, which may replace the file's. @param {Rendering} stated @param {any} parameters */
export function requestedRendering(stated, { render_mode = "auto", eps2d }) {
  const antialiased = render_mode === "auto" ? stated.antialiased : render_mode === "antialiased";
  const own = antialiased === stated.antialiased ? stated.eps2d : EPS2D;
  return { antialiased, eps2d: eps2d ?? own };
}

/** @param {number} eps2d */
const usable = (eps2d) => (eps2d > 0 && eps2d <= MAX_EPS2D ? eps2d : null);
