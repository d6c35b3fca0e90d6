// Writes what Babylon.js reads from a GLB, before it is sent to a GPU: records of .splat, then harmonics of 8 bits.
globalThis.XMLHttpRequest = class {};
const { NullEngine } = await import("@babylonjs/core/Engines/nullEngine.js");
const { Scene } = await import("@babylonjs/core/scene.js");
const { GaussianSplattingMesh } = await import("@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js");
const { AppendSceneAsync } = await import("@babylonjs/core/Loading/sceneLoader.js");
await import("@babylonjs/loaders/glTF/glTFFileLoader.js");
await import("@babylonjs/loaders/glTF/2.0/glTFLoader.js");
await import("@babylonjs/loaders/glTF/2.0/Extensions/KHR_gaussian_splatting.js");
const [glb, out] = process.argv.slice(1);
GaussianSplattingMesh.prototype.updateDataAsync = async (records, harmonics) => {
  writeFileSync(out, Buffer.from(records));
  harmonics.forEach((part, index) => writeFileSync(out + index, Buffer.from(part)));
};
await AppendSceneAsync(readFileSync(glb), new Scene(new NullEngine()), { pluginExtension: ".glb" });
process.exit(0);
