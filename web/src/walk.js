/** Camera navigation: free movement, jumps to a photo's camera, and playback along the camera path. */

import { SparkControls } from "@sparkjsdev/spark";
import { Quaternion, Vector3 } from "three";
import { pose } from "./lens.js";

/** Duration of a jump in milliseconds, and speed of playback along the path in cameras per second. */
const JUMP = 700;
const CAMERAS_A_SECOND = 1.5;
/** Movement below this threshold counts as none: in radians, or relative to the scene's size. */
const STILL = 1e-5;

export class Walk {
  constructor(stage, canvas) {
    this.stage = stage;
    this.controls = new SparkControls({ canvas });
    // Speeds are proportional to the scene's size.
    const { scene } = stage;
    this.controls.fpsMovement.moveSpeed = 0.5 * scene.distance;
    this.controls.pointerControls.slideSpeed *= 0.5 * scene.distance;
    this.controls.pointerControls.scrollSpeed *= 0.3 * scene.distance;
    // The page uses the Home key to jump to the first photo, so it must not turn the camera.
    const { Home, End, ...turning } = this.controls.fpsMovement.keycodeRotateMapping;
    this.controls.fpsMovement.keycodeRotateMapping = turning;
    this.poses = scene.path.map((c2w) => this.placeOf(c2w));
    /** Index of the camera whose view is shown, or `null`. */
    this.at = null;
    this.jump = null;
    this.isPlaying = false;
    /** Position along the path, from 0 to 1. */
    this.along = 0;
  }

  placeOf(c2w) {
    const matrix = pose(c2w).premultiply(this.stage.world.matrixWorld);
    const place = { position: new Vector3(), quaternion: new Quaternion() };
    matrix.decompose(place.position, place.quaternion, new Vector3());
    return place;
  }

  /** Moves to camera `index`: at once if `smoothly` is false. */
  jumpTo(index, smoothly) {
    this.isPlaying = false;
    this.halt();
    const to = this.placeOf(this.stage.scene.cameras[index].c2w);
    const { position, quaternion } = this.stage.camera;
    this.jump = { to, index, from: { position: position.clone(), quaternion: quaternion.clone() }, begun: performance.now(), takes: smoothly ? JUMP : 0 };
    this.at = null;
    this.stage.touch();
  }

  play(isPlaying) {
    this.isPlaying = isPlaying && this.poses.length > 1;
    if (this.isPlaying && this.along >= 1) this.along = 0;
    this.halt();
    this.leave();
  }

  /** Stops the controls' remaining motion, which would otherwise be taken for new user input. */
  halt() {
    const { scroll, rotateVelocity, moveVelocity } = this.controls.pointerControls;
    for (const motion of [scroll, rotateVelocity, moveVelocity]) motion.set(0, 0, 0);
  }

  seek(along) {
    this.along = along;
    this.leave();
    this.stand();
  }

  leave() {
    this.jump = null;
    this.at = null;
    this.stage.touch();
  }

  /** Moves the camera to the current position on the path. */
  stand() {
    const place = this.along * (this.poses.length - 1);
    const before = Math.min(Math.floor(place), this.poses.length - 2);
    this.between(this.poses[before], this.poses[before + 1], place - before);
  }

  between(from, to, share) {
    this.stage.camera.position.lerpVectors(from.position, to.position, share);
    this.stage.camera.quaternion.slerpQuaternions(from.quaternion, to.quaternion, share);
    this.stage.touch();
  }

  /** Advances a jump, playback or movement by `seconds`. */
  step(seconds) {
    if (this.jump) {
      const { from, to, index, begun, takes } = this.jump;
      const share = takes > 0 ? Math.min(1, (performance.now() - begun) / takes) : 1;
      this.between(from, to, share * share * (3 - 2 * share));
      if (share === 1) [this.jump, this.at] = [null, index];
    } else if (this.isPlaying) {
      this.along = Math.min(1, this.along + (seconds * CAMERAS_A_SECOND) / this.stage.scene.cameras.length);
      if (this.along === 1) this.isPlaying = false;
      this.stand();
    }
    const { position, quaternion } = this.stage.camera;
    const before = [position.clone(), quaternion.clone()];
    this.controls.update(this.stage.camera);
    const hasMoved = position.distanceTo(before[0]) > STILL * this.stage.scene.distance || quaternion.angleTo(before[1]) > STILL;
    if (hasMoved) {
      this.isPlaying = false;
      this.leave();
    } else {
      // The difference is rounding error only.
      position.copy(before[0]);
      quaternion.copy(before[1]);
    }
  }
}
