/** The page's controls (buttons, keys and the strip of photos) and their effects on the stage. */

import { scene, splat } from "./data.js";
import { frame } from "./lens.js";
import { Measure } from "./measure.js";
import { Stage } from "./stage.js";
import { Walk } from "./walk.js";

const at = (id) => document.getElementById(id);
const canvas = at("canvas");

/** Shows an error message in place of the scene. */
function give_up(words) {
  at("message").textContent = words;
  at("message").hidden = false;
  document.body.dataset.state = "failed";
}

class Page {
  constructor() {
    this.stage = new Stage(canvas, scene);
    this.walk = new Walk(this.stage, canvas);
    this.measure = new Measure(this.stage, canvas, () => this.showMeasurement());
    this.lens = scene.cameras[0].lens;
    this.stillness = matchMedia("(prefers-reduced-motion: reduce)");
    this.addStrip();
    this.addButtons();
    this.addKeys();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  async begin() {
    this.jumpTo(0, false);
    this.walk.step(0);
    await this.stage.load(splat());
    document.body.dataset.state = "ready";
    at("message").hidden = true;
    let last = performance.now();
    this.stage.renderer.setAnimationLoop((now) => {
      this.walk.step((now - last) / 1000);
      last = now;
      if (this.stage.draw()) this.follow();
    });
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0 || height === 0) return;
    this.stage.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.stage.renderer.setSize(width, height, false);
    this.setLens(this.lens);
  }

  setLens(lens) {
    this.lens = lens;
    this.stage.camera.setLens(lens, canvas.clientWidth, canvas.clientHeight, scene.distance / 200, scene.distance * 200);
    this.stage.touch();
  }

  jumpTo(index, smoothly = !this.stillness.matches) {
    const { lens } = scene.cameras[index];
    this.setLens(lens);
    this.walk.jumpTo(index, smoothly);
    this.last = index;
  }

  /** Jumps `count` photos forward (or backward, if negative) from the photo that was last jumped to. */
  jumpBy(count) {
    const { length } = scene.cameras;
    this.jumpTo((this.last + count + length) % length);
  }

  addStrip() {
    at("strip").append(
      ...scene.cameras.map(({ name, photo }, index) => {
        const button = document.createElement("button");
        button.type = "button";
        button.title = name;
        if (photo) {
          const image = Object.assign(new Image(), { src: photo, alt: name, loading: "lazy", draggable: false });
          button.append(image);
        } else button.textContent = name;
        button.addEventListener("click", () => this.jumpTo(index));
        return button;
      }),
    );
  }

  addButtons() {
    for (const mode of ["color", "depth", "centers"]) at(mode).addEventListener("click", () => this.show(mode));
    at("cameras").addEventListener("click", () => this.toggleCameras());
    at("measure").addEventListener("click", () => this.measure.toggle());
    at("play").addEventListener("click", () => this.togglePlay());
    at("along").addEventListener("input", () => this.walk.seek(at("along").valueAsNumber));
    at("share").addEventListener("input", () => this.compare());
    at("help-button").addEventListener("click", () => this.toggleHelp());
  }

  addKeys() {
    const keys = {
      Digit1: () => this.show("color"), Digit2: () => this.show("depth"), Digit3: () => this.show("centers"),
      Space: () => this.togglePlay(), KeyC: () => this.toggleCameras(), KeyH: () => this.toggleControls(), KeyM: () => this.measure.toggle(),
      Comma: () => this.jumpBy(-1), Period: () => this.jumpBy(1), Home: () => this.jumpTo(0), Slash: () => this.toggleHelp(),
    };
    addEventListener("keydown", (event) => {
      // Leave a key to the focused control if that control handles it itself.
      const isTaken = event.target.matches("input, dialog *") || (event.code === "Space" && event.target.matches("button"));
      if (isTaken || event.ctrlKey || event.metaKey || event.altKey || !(event.code in keys)) return;
      event.preventDefault();
      keys[event.code]();
    });
    // Arrow keys on a focused slider must not move the camera.
    for (const slider of document.querySelectorAll("input")) slider.addEventListener("keydown", (event) => event.stopPropagation());
  }

  show(mode) {
    this.stage.show(mode);
    canvas.classList.toggle("depth", mode === "depth");
    for (const other of ["color", "depth", "centers"]) at(other).setAttribute("aria-pressed", other === mode);
  }

  toggleCameras() {
    this.stage.frustums.visible = !this.stage.frustums.visible;
    at("cameras").setAttribute("aria-pressed", this.stage.frustums.visible);
    this.stage.touch();
  }

  showMeasurement() {
    const { measure } = this;
    if (!measure) return;
    at("measure").setAttribute("aria-pressed", measure.isOn);
    canvas.classList.toggle("measuring", measure.isOn);
    const result = measure.result();
    at("measurement").hidden = !measure.isOn;
    at("distance").textContent = result
      ? `${Number(result.distance.toPrecision(4))} ${scene.frame.unit}`
      : `Click ${measure.places.length ? "the other point" : "two points"}`;
    at("length").textContent = result?.option ?? "";
  }

  togglePlay() {
    this.walk.play(!this.walk.isPlaying);
  }

  toggleControls() {
    document.body.classList.toggle("bare");
  }

  toggleHelp() {
    at("help").open ? at("help").close() : at("help").showModal();
  }

  /** Overlays the photo on the rendered image, up to the slider's position. */
  compare() {
    const index = this.walk.at;
    const photo = index === null ? undefined : scene.cameras[index].photo;
    at("compare").hidden = !photo;
    if (!photo) return;
    const image = at("photo");
    if (image.src !== photo) image.src = photo;
    const { left, top, width, height } = frame(this.lens, canvas.clientWidth, canvas.clientHeight);
    Object.assign(at("compare").style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
    at("compare").style.setProperty("--share", at("share").valueAsNumber);
  }

  /** Updates the controls to match the current view. */
  follow() {
    this.compare();
    const { at: here, isPlaying, along } = this.walk;
    if (document.body.dataset.at !== String(here)) {
      document.body.dataset.at = here;
      [...at("strip").children].forEach((button, index) => {
        if (index === here) button.setAttribute("aria-current", "true");
        else button.removeAttribute("aria-current");
      });
      if (here !== null) at("strip").children[here].scrollIntoView({ block: "nearest", inline: "nearest" });
    }
    at("play").setAttribute("aria-pressed", isPlaying);
    at("play").textContent = isPlaying ? "Pause" : "Play";
    at("along").valueAsNumber = along;
  }
}

try {
  window.page = new Page();
  window.page.begin().catch((error) => {
    console.error(error);
    give_up(`The scene can't be shown: ${error.message ?? error}`);
  });
} catch (error) {
  console.error(error);
  give_up("This page needs WebGL2, which this browser doesn't have or doesn't allow.");
}
