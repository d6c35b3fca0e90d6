// Converts a PLY or compressed PLY to .ksplat at a compression level and an SH degree, with mkkellogg's viewer.
globalThis.window = globalThis.document = {};
const { PlyParser, SplatBufferGenerator } = await import("@mkkellogg/gaussian-splats-3d");
const [ply, out, level, degree] = process.argv.slice(1);
const data = new Uint8Array(readFileSync(ply)).buffer;
const splats = PlyParser.parseToUncompressedSplatArray(data, Number(degree));
const generator = SplatBufferGenerator.getStandardGenerator(1, Number(level), 0);
writeFileSync(out, Buffer.from(generator.generateFromUncompressedSplatArray(splats).bufferData));
