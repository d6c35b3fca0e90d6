// Writes columns of values as a PLY, which the tests read. Put in front of the scripts of viewers.
const { readFileSync, writeFileSync } = await import("fs");
const writePly = (path, columns) => {
  const names = Object.keys(columns);
  const count = columns.x.length;
  const header = ["ply", "format binary_little_endian 1.0", `element vertex ${count}`];
  header.push(...names.map((name) => `property float ${name}`), "end_header\n");
  const rows = new Float32Array(count * names.length);
  names.forEach((name, column) => {
    for (let i = 0; i < count; i++) rows[i * names.length + column] = columns[name][i];
  });
  writeFileSync(path, Buffer.concat([Buffer.from(header.join("\n")), Buffer.from(rows.buffer)]));
};
