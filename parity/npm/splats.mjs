// Reads or writes a splat with a third-party library, for parity/tests/test_splat_formats.py.
//
//     node splats.mjs read  adobe|babylon FILE NUMBERS.json
//     node splats.mjs write adobe NUMBERS.json FILE VERSION
//
// NUMBERS.json has one flat list per property, with the values of a 3DGS PLY for all Gaussians; rotations are x, y, z, w.

import { readFileSync, writeFileSync } from "node:fs";
import { dirname, extname, join } from "node:path";
import createSpz from "@adobe/spz";

const LISTS = ["positions", "scales", "rotations", "alphas", "colors", "sh"];

/** Loads Niantic's own library, compiled to WebAssembly; it converts to and from the axes of a PLY. */
async function adobe() {
  const spz = await createSpz({ print() {}, printErr() {} });
  const axes = spz.CoordinateSystem.RDF;
  return {
    read: (file) => spz.loadSpzFromBuffer(new Uint8Array(readFileSync(file)), { to: axes }),
    write: (cloud, version) => {
      const options = { version: Number(version), from: axes, sh1Bits: 5, shRestBits: 4 };
      return spz.saveSpzToBuffer({ ...cloud, extensions: [] }, options);
    },
  };
}

/**
 * Loads Babylon.js' glTF loader, with an engine that renders nothing. The loader rounds all values to bytes, except for positions and
 * scales. They are converted to the axes of a PLY, half a turn about z away.
 */
async function babylon() {
  const { NullEngine } = await import("@babylonjs/core/Engines/nullEngine.js");
  const { LoadAssetContainerAsync } = await import("@babylonjs/core/Loading/sceneLoader.js");
  const { GaussianSplattingMesh } = await import("@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js");
  const { Scene } = await import("@babylonjs/core/scene.js");
  await import("@babylonjs/loaders/glTF/2.0/index.js");
  const loadMesh = async (file) => {
    let loaded;
    GaussianSplattingMesh.prototype.updateDataAsync = async (rows, sh, _, degree = 0) => (loaded = { rows, sh, degree });
    const inline = (bytes) => `data:;base64,${Buffer.from(bytes).toString("base64")}`;
    let contents = readFileSync(file);
    if (file.endsWith(".gltf")) {
      const document = JSON.parse(contents);
      document.buffers.forEach((buffer) => (buffer.uri = inline(readFileSync(join(dirname(file), buffer.uri)))));
      contents = JSON.stringify(document);
    }
    const engine = new NullEngine();
    await LoadAssetContainerAsync(inline(contents), new Scene(engine), { pluginExtension: extname(file) });
    engine.dispose();
    return loaded;
  };
  const read = async (file) => {
    const { rows, sh, degree } = await loadMesh(file);
    const [floats, bytes] = [new Float32Array(rows), new Uint8Array(rows)];
    const count = rows.byteLength / 32;
    const cloud = { numPoints: count, shDegree: degree, antialiased: false };
    LISTS.forEach((name) => (cloud[name] = []));
    for (let i = 0; i < count; i++) {
      const [x, y, z, ...scale] = floats.subarray(8 * i, 8 * i + 6);
      const [red, green, blue, alpha, ...turn] = bytes.subarray(32 * i + 24, 32 * i + 32);
      const [a, b, c, d] = turn.map((byte) => (byte - 127.5) / 127.5);
      cloud.positions.push(-x, -y, z);
      cloud.scales.push(...scale.map(Math.log));
      cloud.rotations.push(c, -b, -a, d); // the turn times the rotation
      cloud.alphas.push(Math.log(alpha / (255 - alpha)));
      cloud.colors.push(...[red, green, blue].map((byte) => (byte / 255 - 0.5) * 2 * Math.sqrt(Math.PI)));
      for (let l = 1, at = 0; l <= degree; l++) {
        for (let m = -l; m <= l; m++) {
          const sign = m % 2 === 0 ? 1 : -1;
          for (let channel = 0; channel < 3; channel++, at++) {
            cloud.sh.push((sign * (sh[at >> 4][16 * i + (at & 15)] - 128)) / 128);
          }
        }
      }
    }
    return cloud;
  };
  return { read };
}

const [verb, program, from, to, version] = process.argv.slice(2);
const { read, write } = await { adobe, babylon }[program]();
if (verb === "read") {
  const cloud = await read(from);
  const lists = LISTS.map((name) => [name, Array.from(cloud[name])]);
  writeFileSync(to, JSON.stringify({ numPoints: cloud.numPoints, shDegree: cloud.shDegree, antialiased: cloud.antialiased, ...Object.fromEntries(lists) }));
} else {
  const cloud = JSON.parse(readFileSync(from));
  LISTS.forEach((name) => (cloud[name] = new Float32Array(cloud[name])));
  writeFileSync(to, Buffer.from(write(cloud, version)));
}
