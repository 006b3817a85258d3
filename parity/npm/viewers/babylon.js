// Renders a splat with Babylon.js, as its documentation of Gaussian splatting shows, for tests/viewers/viewers.rs. spark.js documents
// `show`.

import { TargetCamera } from "@babylonjs/core/Cameras/targetCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Matrix, Quaternion, Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/2.0/index.js";
import "@babylonjs/loaders/SPLAT/index.js";
import * as fflate from "fflate";
import spzLibrary from "../node_modules/@adobe/spz/dist/spz.js" with { type: "text" };

// Signs of our axes in a file's: in an SPZ file, y points up and z backward; in glTF, x points left and y up.
const SIGNS = { spz: [1, -1, -1], glb: [-1, -1, 1] };

window.show = async (bytes, ending, { c2w, angle, width, height }) => {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  document.body.append(canvas);
  const scene = new Scene(new Engine(canvas, false, { preserveDrawingBuffer: true }));
  scene.clearColor = new Color4(0, 0, 0, 1);
  // Nothing is fetched from the network.
  const spzLibraryUrl = URL.createObjectURL(new Blob([spzLibrary], { type: "text/javascript" }));
  const options = { fflate, spzLibraryUrl };
  const { meshes } = await ImportMeshAsync(new File([bytes], `scene.${ending}`), scene, { pluginOptions: { splat: options } });
  const splat = meshes.find((mesh) => mesh.getClassName() === "GaussianSplattingMesh");
  // Convert from our axes to the file's. The mesh and its parents convert these to Babylon.js' own left-handed axes.
  const signs = SIGNS[ending] ?? [1, 1, 1];
  splat.computeWorldMatrix(true);
  const world = splat.getWorldMatrix();
  const turned = ([x, y, z]) => Vector3.TransformNormal(new Vector3(signs[0] * x, signs[1] * y, signs[2] * z), world);
  const column = (index, sign = 1) => turned([0, 1, 2].map((row) => sign * c2w[4 * row + index]));
  const [right, up, forward] = [column(0), column(1, -1), column(2)];
  const camera = new TargetCamera("camera", column(3), scene);
  Object.assign(camera, { minZ: 0.01, maxZ: 1000, fov: angle });
  const rows = [right, up, forward].flatMap((axis) => [axis.x, axis.y, axis.z, 0]);
  camera.rotationQuaternion = Quaternion.FromRotationMatrix(Matrix.FromValues(...rows, 0, 0, 0, 1));
  for (let picture = 0; picture < 10; picture++) {
    scene.render();
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  // Bounding box of the file's means, converted back to our axes.
  const { minimum, maximum } = splat.getBoundingInfo();
  const corners = [minimum, maximum].map(({ x, y, z }) => [x, y, z].map((number, axis) => signs[axis] * number));
  const [low, high] = [Math.min, Math.max].map((choose) => [0, 1, 2].map((axis) => choose(corners[0][axis], corners[1][axis])));
  return { count: splat.splatCount, low, high, png: canvas.toDataURL() };
};
