// Reads or writes a splat with a third-party library, for parity/tests/test_splat_formats.py.
//
//     node splats.mjs read  adobe|spz-js FILE NUMBERS.json
//     node splats.mjs write adobe|spz-js NUMBERS.json FILE [VERSION]
//
// NUMBERS.json has one flat list per property, with the values of a 3DGS PLY for all Gaussians; rotations are x, y, z, w.

import { createReadStream, readFileSync, writeFileSync } from "node:fs";
import { Readable } from "node:stream";
import createSpz from "@adobe/spz";
import * as spzJs from "spz-js";

const LISTS = ["positions", "scales", "rotations", "alphas", "colors", "sh"];

/** Loads Niantic's own library, compiled to WebAssembly; it converts to and from the axes of a PLY. */
async function adobe() {
  const spz = await createSpz({ print() {}, printErr() {} });
  const axes = spz.CoordinateSystem.RDF;
  return {
    read: (file) => spz.loadSpzFromBuffer(new Uint8Array(readFileSync(file)), { to: axes }),
    write: (cloud, file, version) => {
      const options = { version: Number(version), from: axes, sh1Bits: 5, shRestBits: 4 };
      return spz.saveSpzToBuffer({ ...cloud, extensions: [] }, options);
    },
  };
}

/** spz-js, an implementation of the same formats in JavaScript, which does not convert axes. */
const inJavaScript = {
  read: (file) => {
    const stream = Readable.toWeb(createReadStream(file));
    return file.endsWith(".compressed.ply") ? spzJs.loadCompressedPly(stream) : spzJs.loadPly(stream);
  },
  write: (cloud, file) => {
    if (file.endsWith(".spz")) return spzJs.serializeSpz(cloud);
    return file.endsWith(".compressed.ply") ? spzJs.serializeCompressedPly(cloud) : spzJs.serializePly(cloud);
  },
};

const [verb, program, from, to, ...more] = process.argv.slice(2);
const { read, write } = program === "adobe" ? await adobe() : inJavaScript;
if (verb === "read") {
  const cloud = await read(from);
  const lists = LISTS.map((name) => [name, Array.from(cloud[name])]);
  writeFileSync(to, JSON.stringify({ numPoints: cloud.numPoints, shDegree: cloud.shDegree, antialiased: cloud.antialiased, ...Object.fromEntries(lists) }));
} else {
  const cloud = JSON.parse(readFileSync(from));
  LISTS.forEach((name) => (cloud[name] = new Float32Array(cloud[name])));
  writeFileSync(to, Buffer.from(await write(cloud, to, ...more)));
}
