// Reads a PLY with gsplat.js, as antimatter15's viewer reads it, and writes the .splat that both draw.
const { PLYLoader, Scene } = await import("gsplat");
const [path, out] = process.argv.slice(1);
const scene = new Scene();
PLYLoader.LoadFromArrayBuffer(new Uint8Array(readFileSync(path)).buffer, scene);
writeFileSync(out, Buffer.from(scene.objects[0].data.serialize()));
