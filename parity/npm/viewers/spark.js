// Renders a splat with Spark (sparkjs.dev), on three.js, as its quick start shows, for tests/viewers/viewers.rs.

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from "three";

/**
 * Renders the splat in `bytes`, the contents of a file whose name ends in `ending`, from `camera`, and returns a PNG, the number of
 * Gaussians and the corners of their means' bounding box. `camera` has a pose c2w [3, 4] with y down and z forward, and the vertical
 * field of view `angle`, in radians.
 */
window.show = async (bytes, ending, { c2w, angle, aspect, width, height }) => {
  const renderer = new WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(width, height, false);
  const scene = new Scene();
  scene.add(new SparkRenderer({ renderer }));
  const splat = new SplatMesh({ fileBytes: bytes, fileName: `scene.${ending}` });
  await splat.initialized;
  // Spark uses the file's axes: in an SPZ file, y points up.
  if (ending === "spz") splat.rotation.x = Math.PI;
  scene.add(splat);
  splat.updateMatrixWorld();
  const camera = new PerspectiveCamera((angle * 180) / Math.PI, aspect, 0.01, 1000);
  const pose = new Matrix4().set(...c2w, 0, 0, 0, 1).multiply(new Matrix4().makeScale(1, -1, -1));
  pose.decompose(camera.position, camera.quaternion, camera.scale);
  // Spark sorts in another thread, so the order is up to date only a few frames later.
  for (let picture = 0; picture < 10; picture++) {
    renderer.render(scene, camera);
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  const box = splat.getBoundingBox(true).applyMatrix4(splat.matrixWorld);
  return {
    count: splat.splats.getNumSplats(), low: box.min.toArray(), high: box.max.toArray(), png: renderer.domElement.toDataURL(),
  };
};
