// Spark (sparkjs.dev), on three.js, as its first steps say: for tests/viewers.rs.

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from "three";

/**
 * What `camera` sees of the splat in `bytes`, a file whose name ends in `ending`, as a PNG, with the number of Gaussians and the
 * corners of their means' box. `camera` has a pose c2w [3, 4] with y down and z forward, and the angle between the picture's
 * upper and lower border.
 */
window.show = async (bytes, ending, { c2w, angle, aspect, width, height }) => {
  const renderer = new WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(width, height, false);
  const scene = new Scene();
  scene.add(new SparkRenderer({ renderer }));
  const splat = new SplatMesh({ fileBytes: bytes, fileType: ending });
  await splat.initialized;
  // Its axes are the file's: an SPZ's y points up.
  if (ending === "spz") splat.rotation.x = Math.PI;
  scene.add(splat);
  splat.updateMatrixWorld();
  const camera = new PerspectiveCamera((angle * 180) / Math.PI, aspect, 0.01, 1000);
  const pose = new Matrix4().set(...c2w, 0, 0, 0, 1).multiply(new Matrix4().makeScale(1, -1, -1));
  pose.decompose(camera.position, camera.quaternion, camera.scale);
  // It sorts in another thread, for the picture after the next.
  for (let picture = 0; picture < 10; picture++) {
    renderer.render(scene, camera);
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  const box = splat.getBoundingBox(true).applyMatrix4(splat.matrixWorld);
  return {
    count: splat.splats.getNumSplats(), low: box.min.toArray(), high: box.max.toArray(), png: renderer.domElement.toDataURL(),
  };
};
