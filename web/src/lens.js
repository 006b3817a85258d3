/** A camera with pinhole intrinsics, whose whole image is fitted and centered in a canvas of any aspect ratio. */

import { Matrix4, PerspectiveCamera } from "three";

/**
 * Returns the rectangle of the camera's image in a canvas of `width`×`height`: as large as it fits, centered.
 * `lens` has intrinsics (fx, fy, cx, cy) and the size (width, height) of the photo, in pixels.
 */
export function frame(lens, width, height) {
  const scale = Math.min(width / lens.width, height / lens.height);
  const size = { width: lens.width * scale, height: lens.height * scale };
  return { scale, left: (width - size.width) / 2, top: (height - size.height) / 2, ...size };
}

/** A camera whose projection matrix is computed from intrinsics instead of a field of view. */
export class LensCamera extends PerspectiveCamera {
  /** Sets the intrinsics, the canvas size in pixels, and the near and far planes, and updates the projection matrix. */
  setLens(lens, width, height, near, far) {
    Object.assign(this, { lens, near, far });
    const { scale, left, top } = frame(lens, width, height);
    // Pixel x = fx X/Z + cx in a camera that looks along +z with y down; OpenGL's camera looks along -z with y up.
    const x = [(2 * scale * lens.fx) / width, 1 - (2 * (scale * lens.cx + left)) / width];
    const y = [(2 * scale * lens.fy) / height, (2 * (scale * lens.cy + top)) / height - 1];
    const z = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    this.projectionMatrix.set(x[0], 0, x[1], 0, 0, y[0], y[1], 0, 0, 0, z[0], z[1], 0, 0, -1, 0);
    this.projectionMatrixInverse.copy(this.projectionMatrix).invert();
    this.aspect = width / height;
    this.fov = (2 * Math.atan(1 / y[0]) * 180) / Math.PI;
  }

  /** Does nothing: `setLens` alone sets the projection matrix. */
  updateProjectionMatrix() {}
}

const FLIP = new Matrix4().makeScale(1, -1, -1);

/** Returns the pose of an OpenGL camera from `c2w`, the 12 elements of a camera-to-world matrix [3, 4] with y down and z forward. */
export function pose(c2w) {
  return new Matrix4().set(...c2w, 0, 0, 0, 1).multiply(FLIP);
}
