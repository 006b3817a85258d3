// Reads or writes a splat by a program that isn't ours, for parity/tests/test_splat_formats.py.
//
//     node splats.mjs read  adobe|spz-js FILE NUMBERS.json
//     node splats.mjs write adobe|spz-js NUMBERS.json FILE [VERSION]
//
// Numbers are those of a PLY of 3DGS, all Gaussians' of a kind one after the other; rotations are x, y, z, w.

import { createReadStream, readFileSync, writeFileSync } from "node:fs";
import { Readable } from "node:stream";
import createSpz from "@adobe/spz";
import * as spzJs from "spz-js";

const LISTS = ["positions", "scales", "rotations", "alphas", "colors", "sh"];

/** Niantic's own library, compiled; its numbers have a PLY's axes. */
async function adobe() {
  const spz = await createSpz({ print() {}, printErr() {} });
  const axes = spz.CoordinateSystem.RDF;
  return {
    read: (file) => spz.loadSpzFromBuffer(new Uint8Array(readFileSync(file)), { to: axes }),
    write: (cloud, file, version) => {
      const options = { version: Number(version), from: axes, sh1Bits: 5, shRestBits: 4 };
      return spz.saveSpzToBuffer({ ...cloud, antialiased: false, extensions: [] }, options);
    },
  };
}

/** The same formats once more, in JavaScript, which leaves axes as they are. */
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
  writeFileSync(to, JSON.stringify({ numPoints: cloud.numPoints, shDegree: cloud.shDegree, ...Object.fromEntries(lists) }));
} else {
  const cloud = JSON.parse(readFileSync(from));
  LISTS.forEach((name) => (cloud[name] = new Float32Array(cloud[name])));
  writeFileSync(to, Buffer.from(await write(cloud, to, ...more)));
}
