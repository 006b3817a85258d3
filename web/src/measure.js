/** Measures the distance between two points of the splat that the user clicks or taps. */

import { BufferAttribute, BufferGeometry, Line, LineBasicMaterial, Points, PointsMaterial, Raycaster, Vector2 } from "three";

/** Distance in CSS pixels up to which a pointer that moves still clicks. */
const CLICK = 5;

export class Measure {
  /** `onChange` is called when the points have changed. */
  constructor(stage, canvas, onChange) {
    Object.assign(this, { stage, canvas, onChange, isOn: false, places: [] });
    const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(6), 3));
    const look = { color: 0xffb43a, depthTest: false, transparent: true };
    this.marks = [new Points(geometry, new PointsMaterial({ ...look, size: 10, sizeAttenuation: false })), new Line(geometry, new LineBasicMaterial(look))];
    for (const mark of this.marks) {
      // Drawn over the splat, also where the splat hides it.
      mark.renderOrder = 1;
      mark.frustumCulled = false;
    }
    stage.world.add(...this.marks);
    canvas.addEventListener("pointerdown", (event) => (this.down = event));
    canvas.addEventListener("pointerup", (event) => {
      const isClick = this.down && Math.hypot(event.clientX - this.down.clientX, event.clientY - this.down.clientY) <= CLICK;
      if (this.isOn && isClick && event.isPrimary && event.button === 0 && this.stage.splat) this.pick(event.clientX, event.clientY);
    });
    this.update();
  }

  toggle() {
    this.isOn = !this.isOn;
    this.places = [];
    this.update();
  }

  /** Adds the nearest point of the splat at a position in CSS pixels. A third point begins another measurement. */
  pick(x, y) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const raycaster = new Raycaster();
    raycaster.setFromCamera(new Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height), this.stage.camera);
    const [hit] = raycaster.intersectObject(this.stage.splat);
    if (!hit) return;
    if (this.places.length === 2) this.places = [];
    this.places.push(this.stage.world.worldToLocal(hit.point.clone()));
    this.update();
  }

  update() {
    const { places } = this;
    const positions = this.marks[0].geometry.getAttribute("position");
    places.forEach((place, index) => positions.setXYZ(index, ...place.toArray()));
    positions.needsUpdate = true;
    this.marks[0].geometry.setDrawRange(0, places.length);
    this.marks[0].visible = places.length > 0;
    this.marks[1].visible = places.length === 2;
    this.stage.touch();
    this.onChange();
  }

  /** Returns what the user has measured, in the unit of the file: { distance, option }, the latter for `convert`; `null` before. */
  result() {
    if (this.places.length < 2) return null;
    const { origin, scale } = this.stage.scene.frame;
    const [from, to] = this.places;
    const text = (place) => place.toArray().map((x, axis) => Number((origin[axis] + scale * x).toPrecision(9))).join(",");
    return { distance: scale * from.distanceTo(to), option: `--length ${text(from)} ${text(to)} METRES` };
  }
}
