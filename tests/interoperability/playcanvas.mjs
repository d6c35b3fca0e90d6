// Reads PLY, compressed PLY or GLB, or the meta.json of a SOG whose images lie decoded beside it, with PlayCanvas.
const { pathToFileURL } = await import("url");
const [path, out] = process.argv.slice(1);
const part = (name) => import(pathToFileURL(`node_modules/playcanvas/build/playcanvas/src/${name}.js`));
const { NullGraphicsDevice } = await part("platform/graphics/null/null-graphics-device");
const device = new NullGraphicsDevice();
let data;
if (path.endsWith(".ply")) {
  const { PlyParser } = await part("framework/parsers/ply");
  const asset = {
    data: { reorder: false },
    file: { contents: new Response(readFileSync(path)) },
    fire: (name, loaded) => { if (name === "load:data") data = loaded; },
  };
  await new PlyParser({ graphicsDevice: device }).load({}, (error) => { if (error) throw error; }, asset);
  if (data.isCompressed) data = data.decompress();
} else if (path.endsWith(".glb")) {
  const { GlbParser } = await part("framework/parsers/glb-parser");
  const { GSplatResource } = await part("scene/gsplat/gsplat-resource");
  const { khrGaussianSplatting } = await part("framework/parsers/glb/extensions/khr-gaussian-splatting");
  GSplatResource.prototype.updateColorData = (found) => { data = found; };
  const bytes = new Uint8Array(readFileSync(path)).buffer;
  await new Promise((resolve, reject) => {
    const registry = { loader: { _app: { graphicsDevice: device } } };
    const done = (error) => (error ? reject(error) : resolve());
    GlbParser.parse(path, "", bytes, device, registry, {}, [khrGaussianSplatting], done);
  });
} else {
  const { GSplatSogData } = await part("scene/gsplat/gsplat-sog-data");
  const sog = new GSplatSogData();
  sog.meta = JSON.parse(readFileSync(path, "utf8"));
  sog.numSplats = sog.meta.count;
  const { means, quats, scales, sh0, shN } = sog.meta;
  const texture = (name) => {
    const [width, height] = JSON.parse(readFileSync(path.replace("meta.json", `${name}.json`), "utf8"));
    const pixels = new Uint8Array(readFileSync(path.replace("meta.json", `${name}.rgba`)));
    return { device, width, height, _levels: [pixels] };
  };
  device.isNull = false;
  for (const [key, name] of Object.entries({
    means_l: means.files[0], means_u: means.files[1], quats: quats.files[0], scales: scales.files[0],
    sh0: sh0.files[0], sh_centroids: shN.files[0], sh_labels: shN.files[1],
  })) {
    const found = texture(name);
    sog[key] = { ...found, read: async () => found._levels[0] };
  }
  sog.shBands = GSplatSogData.calcBands(sog.sh_centroids.width);
  data = await sog.decompress();
}
const columns = {};
for (const { name, storage } of data.elements[0].properties) if (storage) columns[name] = Array.from(storage);
if (data.activated) {
  columns.opacity = columns.opacity.map((value) => Math.log(value / (1 - value)));
  for (const axis of [0, 1, 2]) columns[`scale_${axis}`] = columns[`scale_${axis}`].map(Math.log);
}
writePly(out, columns);
process.exit(0);
