/** The WebGL scene: the splat, its Gaussians' centers, and the cameras that photographed it. */

import { SparkRenderer, SplatMesh, dyno } from "@sparkjsdev/spark";
import {
  BufferAttribute, BufferGeometry, DoubleSide, Group, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial,
  PlaneGeometry, Points, PointsMaterial, SRGBColorSpace, Scene, TextureLoader, Vector3, WebGLRenderer,
} from "three";
import { LensCamera, pose } from "./lens.js";

/** Fraction of Gaussians at each end of the depth range that is clamped in the depth view. */
const OUTLIERS = 0.02;

export class Stage {
  /** Creates the renderer. `world` is rotated so that the scene's up direction is y, the axis that the controls turn around. */
  constructor(canvas, scene) {
    this.scene = scene;
    this.renderer = new WebGLRenderer({ canvas, antialias: false });
    this.world = new Group();
    this.world.quaternion.setFromUnitVectors(new Vector3(...scene.up), new Vector3(0, 1, 0));
    this.world.updateMatrixWorld();
    this.camera = new LensCamera();
    // Match our rasterizer: sorted by depth, with the blur that the splat was optimized with. Spark reduces opacities by what `blurAmount`
    // adds to the area of a Gaussian, and not by what `preBlurAmount` does.
    const [preBlurAmount, blurAmount] = scene.antialiased ? [0, scene.blur] : [scene.blur, 0];
    this.spark = new SparkRenderer({
      renderer: this.renderer, preBlurAmount, blurAmount, sortRadial: false, maxStdDev: 3.3, onDirty: () => this.touch(),
    });
    this.all = new Scene();
    this.all.add(this.world, this.spark);
    this.mode = "color";
    this.place = new Vector3();
    this.lookedFrom = new Matrix4();
    this.touch();
  }

  /** Marks the scene as changed, so that the next frame redraws it. */
  touch() {
    this.isDirty = true;
  }

  async load(bytes) {
    this.splat = new SplatMesh({ fileBytes: bytes, fileType: "spz" });
    // In an SPZ file, y points up and z backward.
    this.splat.rotation.x = Math.PI;
    this.world.add(this.splat);
    await this.splat.initialized;
    this.addCenters();
    this.addDepth();
    this.addFrustums();
    this.touch();
  }

  addCenters() {
    const [places, colors] = [[], []];
    this.splat.splats.forEachSplat((_, center, _scales, _quaternion, _opacity, color) => {
      places.push(center.x, center.y, center.z);
      colors.push(color.r, color.g, color.b);
    });
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
    geometry.setAttribute("color", new BufferAttribute(new Float32Array(colors), 3));
    // A splat's colors are display (sRGB) values already, so skip the shader's color space conversion.
    const material = new PointsMaterial({ size: 2 * this.renderer.getPixelRatio(), sizeAttenuation: false, vertexColors: true });
    material.onBeforeCompile = (shader) => {
      shader.fragmentShader = shader.fragmentShader.replace("#include <colorspace_fragment>", "");
    };
    this.centers = new Points(geometry, material);
    this.centers.rotation.copy(this.splat.rotation);
    this.centers.visible = false;
    this.world.add(this.centers);
  }

  /**
   * Prepares the depth view: each Gaussian is gray by its center's depth, linear in 1/depth, near ones bright. The page's filter maps
   * grays to colors.
   */
  addDepth() {
    this.eye = dyno.dynoVec3(new Vector3());
    this.forward = dyno.dynoVec3(new Vector3());
    this.far = dyno.dynoFloat(0);
    this.range = dyno.dynoFloat(1);
    const number = (value) => dyno.dynoConst("float", value);
    this.depthOf = dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
      const depth = dyno.dot(dyno.sub(dyno.splitGsplat(gsplat).outputs.center, this.eye), this.forward);
      const inverse = dyno.div(number(1), dyno.max(depth, number(1e-6)));
      const gray = dyno.clamp(dyno.div(dyno.sub(inverse, this.far), this.range), number(0), number(1));
      return { gsplat: dyno.combineGsplat({ gsplat, r: gray, g: gray, b: gray }) };
    });
    const places = this.centers.geometry.getAttribute("position");
    const [eye, forward, place] = [new Vector3(), new Vector3(), new Vector3()];
    const turned = new Matrix4().makeRotationFromEuler(this.centers.rotation);
    const inverses = [];
    for (const camera of this.scene.cameras) {
      const matrix = pose(camera.c2w);
      eye.setFromMatrixPosition(matrix);
      forward.setFromMatrixColumn(matrix, 2).negate();
      // A sample of the Gaussians is enough to estimate the range.
      const step = Math.max(1, Math.floor((places.count * this.scene.cameras.length) / 50_000));
      for (let index = 0; index < places.count; index += step) {
        const depth = place.fromBufferAttribute(places, index).applyMatrix4(turned).sub(eye).dot(forward);
        if (depth > 0) inverses.push(1 / depth);
      }
    }
    inverses.sort((a, b) => a - b);
    const at = (share) => inverses[Math.floor(share * (inverses.length - 1))] ?? 0;
    this.far.value = at(OUTLIERS);
    this.range.value = Math.max(at(1 - OUTLIERS) - this.far.value, 1e-9);
  }

  addFrustums() {
    this.frustums = new Group();
    const size = this.scene.frustum;
    for (const { c2w, lens, photo } of this.scene.cameras) {
      if (!photo) continue;
      const camera = new Group();
      pose(c2w).decompose(camera.position, camera.quaternion, camera.scale);
      const corner = (x, y) => [((x - lens.cx) / lens.fx) * size, (-(y - lens.cy) / lens.fy) * size, -size];
      const corners = [corner(0, 0), corner(lens.width, 0), corner(lens.width, lens.height), corner(0, lens.height)];
      const lines = corners.flatMap((from, index) => [from, corners[(index + 1) % 4], [0, 0, 0], from]).flat();
      const edges = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(lines), 3));
      camera.add(new LineSegments(edges, new LineBasicMaterial({ color: 0xffb43a })));
      const [left, top] = corners[0];
      const [right, bottom] = corners[2];
      const plane = new PlaneGeometry(right - left, top - bottom).translate((left + right) / 2, (top + bottom) / 2, -size);
      const texture = new TextureLoader().load(photo, () => this.touch());
      texture.colorSpace = SRGBColorSpace;
      camera.add(new Mesh(plane, new MeshBasicMaterial({ map: texture, side: DoubleSide, toneMapped: false })));
      this.frustums.add(camera);
    }
    this.frustums.visible = false;
    this.world.add(this.frustums);
  }

  /** Sets what is shown: `color`, `depth` or `centers`. */
  show(mode) {
    this.mode = mode;
    this.splat.visible = mode !== "centers";
    this.centers.visible = mode === "centers";
    this.splat.worldModifier = mode === "depth" ? this.depthOf : undefined;
    this.splat.updateGenerator();
    this.touch();
  }

  /** Redraws the scene if it changed; returns `true` if it did. */
  draw() {
    if (!this.isDirty) return false;
    this.isDirty = false;
    this.camera.updateMatrixWorld();
    if (this.mode === "depth" && !this.camera.matrixWorld.equals(this.lookedFrom)) {
      // The grays hold for one camera pose and are recomputed when it changes, which marks the scene as changed again.
      this.lookedFrom.copy(this.camera.matrixWorld);
      this.eye.value.setFromMatrixPosition(this.lookedFrom);
      this.forward.value.setFromMatrixColumn(this.lookedFrom, 2).negate();
      this.splat.updateVersion();
    }
    for (const frustum of this.frustums?.children ?? []) {
      // Hide a photo right in front of the camera, as it would hide everything else, and all photos in the depth view.
      const isNear = frustum.getWorldPosition(this.place).distanceTo(this.camera.position) < 3 * this.scene.frustum;
      frustum.visible = !isNear && this.mode !== "depth";
    }
    this.renderer.render(this.all, this.camera);
    return true;
  }
}
