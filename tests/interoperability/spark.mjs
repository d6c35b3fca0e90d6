// Reads a scene with Spark, whose parsers run in a web worker: here a thread of Node.js.
const { Worker: Thread } = await import("worker_threads");
const WORKER_GLOBALS = `
  const { parentPort } = require("worker_threads");
  const postMessage = (data, { transfer } = {}) => parentPort.postMessage(data, transfer);
  globalThis.self = Object.assign(new EventTarget(), { postMessage });
  parentPort.on("message", (data) => self.dispatchEvent(Object.assign(new Event("message"), { data })));
`;
globalThis.Worker = class {
  constructor(url) {
    this.thread = new Thread(WORKER_GLOBALS + decodeURIComponent(url.slice(url.indexOf(",") + 1)), { eval: true, execArgv: [] });
    this.thread.on("message", (data) => this.onmessage({ data }));
  }
  postMessage(data, { transfer } = {}) { this.thread.postMessage(data, transfer); }
};
const { ExtSplats, utils } = await import("@sparkjsdev/spark");
const [path, out] = process.argv.slice(1);
const splats = new ExtSplats({ fileBytes: new Uint8Array(readFileSync(path)), fileName: path });
await splats.initialized;
const { sh1, sh2, sh3a, sh3b } = splats.extra;
const columns = {};
const set = (index, values) => {
  for (const [name, value] of Object.entries(values)) (columns[name] ??= [])[index] = value;
};
splats.forEachSplat((index, center, scales, quat, opacity, color) => {
  const [red, green, blue] = color.toArray().map((value) => (value - 0.5) / 0.28209479177387814);
  set(index, { x: center.x, y: center.y, z: center.z, rot_0: quat.w, rot_1: quat.x, rot_2: quat.y, rot_3: quat.z });
  const [scale_0, scale_1, scale_2] = scales.toArray().map(Math.log);
  set(index, { scale_0, scale_1, scale_2, f_dc_0: red, f_dc_1: green, f_dc_2: blue });
  set(index, { opacity: Math.log(opacity / (1 - opacity)) });
  const words = [sh1, sh2, sh3a, sh3b].flatMap((part) => [...part.subarray(4 * index, 4 * index + 4)]).slice(0, 15);
  words.forEach((word, degree) => {
    const { r, g, b } = utils.decodeExtRgb(word);
    set(index, { [`f_rest_${degree}`]: r, [`f_rest_${degree + 15}`]: g, [`f_rest_${degree + 30}`]: b });
  });
});
writePly(out, columns);
process.exit(0);
