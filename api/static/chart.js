// @ts-check
/** Chart of the loss over time, on logarithmic axes. */
import { h, put, svg } from "./dom.js";
import { rough, words } from "./words.js";

/** @typedef {{attempt: number, stage: string, step: number, seconds: number | null, loss: number | null, mean_loss?: number | null}} Point */

const HEIGHT = 240, LEFT = 56, RIGHT = 12, TOP = 26, BOTTOM = 34;

/** Return the values to label on a logarithmic axis. @param {number} low @param {number} high */
function ticks(low, high) {
  const decades = Math.log10(high / low);
  const digits = decades < 0.15 ? Array.from({ length: 90 }, (_, i) => (10 + i) / 10) : decades < 0.5 ? [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9] : decades < 1.2 ? [1, 2, 3, 5, 7] : decades < 4 ? [1, 2, 5] : [1];
  const found = [], every = Math.max(1, Math.ceil(decades / 8));
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
    if (power % every) continue;
    for (const digit of digits) {
      const value = Number(`${digit}e${power}`);
      if (value >= low * 0.999 && value <= high * 1.001) found.push(value);
    }
  }
  return found.length ? found : [low];
}

export class LossChart {
  constructor() {
    this.picture = h("div.plot");
    this.legend = h("p.legend");
    this.empty = h("p.quiet", words.job.noLoss);
    this.element = h("div.chart", this.empty, this.picture, this.legend);
    /** @type {Map<string, Point>} */
    this.points = new Map();
    this.requested = 0;
    this.resized = new ResizeObserver(() => this.later());
    this.resized.observe(this.picture);
  }

  /** @param {Point[]} points */
  add(points) {
    for (const { ...point } of points) {
      if (point.stage === "measuring") {
        const before = [...this.points.values()].filter(({ step }) => step <= point.step).sort((a, b) => b.step - a.step);
        point.stage = before[0]?.stage ?? "sos";
      }
      if ((point.stage !== "coarse" && point.stage !== "sos") || !((point.seconds ?? 0) > 0) || !((point.loss ?? 0) > 0)) continue;
      this.points.set(`${point.stage}/${point.step}`, { ...this.points.get(`${point.stage}/${point.step}`), ...point });
    }
    this.later();
  }

  later() {
    this.requested ||= requestAnimationFrame(() => {
      this.requested = 0;
      this.draw();
    });
  }

  /** @returns {{name: string, kind: string, line: [number, number][]}[]} */
  lines() {
    const all = [...this.points.values()].sort((a, b) => Number(a.seconds) - Number(b.seconds));
    const of = (/** @type {string} */ stage) => all.filter((point) => point.stage === stage), sos = of("sos");
    const line = (/** @type {Point[]} */ points, /** @type {(p: Point) => number | null | undefined} */ value) =>
      /** @type {[number, number][]} */ (points.filter((p) => (value(p) ?? 0) > 0).map((p) => [p.seconds, value(p)]));
    const mean = (/** @type {Point} */ p) => p.mean_loss ?? p.loss;
    return [
      ...(sos.some((p) => p.mean_loss) ? [{ name: words.chart.single, kind: "single", line: line(sos, (p) => p.loss) }] : []),
      { name: words.chart.coarse, kind: "coarse", line: line(of("coarse"), mean) },
      { name: words.chart.all, kind: "all", line: line(sos, mean) },
    ].filter((each) => each.line.length);
  }

  draw() {
    const lines = this.lines(), width = this.picture.clientWidth;
    this.empty.hidden = lines.length > 0;
    this.element.classList.toggle("nothing", !lines.length);
    if (!lines.length || !width) return;
    const xs = lines.flatMap((each) => each.line.map(([x]) => x)), ys = lines.flatMap((each) => each.line.map(([, y]) => y));
    const range = (/** @type {number[]} */ values) => {
      const low = Math.min(...values), high = Math.max(...values);
      return high > low * 1.2 ? [low, high] : [low / 1.2, high * 1.2];
    };
    const [x0, x1] = range(xs), [y0, y1] = range(ys);
    const x = (/** @type {number} */ value) => LEFT + ((width - LEFT - RIGHT) * Math.log(value / x0)) / Math.log(x1 / x0);
    const y = (/** @type {number} */ value) => TOP + ((HEIGHT - TOP - BOTTOM) * Math.log(y1 / value)) / Math.log(y1 / y0);
    const main = lines[lines.length - 1].line;
    let lastX = -99, lastY = 1e9;
    const across = ticks(x0, x1).filter((value) => x(value) - lastX > 36 && ((lastX = x(value)), true));
    const upward = ticks(y0, y1).filter((value) => lastY - y(value) > 18 && ((lastY = y(value)), true));
    put(this.picture, svg("svg", { width, height: HEIGHT, role: "img", "aria-label": words.chart.told(main[0][1], main[main.length - 1][1], main[main.length - 1][0]) },
      upward.flatMap((value) => [svg("path.grid", { d: `M${LEFT} ${y(value).toFixed(1)}H${width - RIGHT}` }), svg("text", { x: LEFT - 8, y: y(value) + 4, "text-anchor": "end" }, short(value))]),
      across.map((value) => svg("text", { x: x(value), y: HEIGHT - BOTTOM + 18, "text-anchor": "middle" }, short(value))),
      svg("text.axis", { x: width - RIGHT, y: HEIGHT - 2, "text-anchor": "end" }, words.chart.seconds),
      svg("text.axis", { x: 0, y: 11 }, words.chart.loss),
      lines.map(({ kind, line }) => (line.length > 1
        ? svg("path", { class: `line ${kind}`, d: line.map(([px, py], i) => `${i ? "L" : "M"}${x(px).toFixed(1)} ${y(py).toFixed(1)}`).join("") })
        : svg("circle", { class: `dot ${kind}`, cx: x(line[0][0]), cy: y(line[0][1]), r: 3 })))));
    put(this.legend, lines.map(({ name, kind }) => h("span", svg("svg.key", { viewBox: "0 0 18 4", "aria-hidden": "true" }, svg("path", { class: `line ${kind}`, d: "M0 2h18" })), name)));
  }

  end() {
    this.resized.disconnect();
  }
}

/** Return the label of a value, such as 0.05 or 3×10¹⁰. @param {number} value */
function short(value) {
  if (value < 1e6 && value >= 1e-3) return rough(value);
  const [digit, power] = Number(value.toPrecision(2)).toExponential().split("e");
  return `${digit}×10${[...String(Number(power))].map((char) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(char)]).join("")}`;
}
