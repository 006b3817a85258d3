"use strict";

/** Between questions; the run may have got further. */
const PAUSE = 2000;
const SIZE = { width: 440, height: 270, left: 46, right: 14, top: 12, bottom: 44 };
const SVG = "http://www.w3.org/2000/svg";

const at = (id) => document.getElementById(id);

/** An element; texts are texts whatever is in them. */
function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

function drawn(name, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

const whole = (value) => Math.round(value).toLocaleString("en").replaceAll(",", "\u202f");

/** Three or four digits of any number. */
function short(value) {
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2).replace("-", "−");
  return value.toFixed(size >= 100 ? 1 : size >= 1 ? 2 : 4).replace("-", "−");
}

/** A tick, with as many digits as tell it from the next one. */
function label(tick, step) {
  if (step < 1e-3 && tick !== 0) return tick.toExponential(Math.max(0, exponent(tick) - exponent(step))).replace("-", "−");
  return step < 1e-3 ? "0" : tick.toFixed(Math.max(0, -exponent(step))).replace("-", "−");
}

/** Of a number as 10 to the power of it; what rounding takes from a power of ten is nothing. */
const exponent = (value) => Math.floor(Math.log10(Math.abs(value)) + 1e-9);

function duration(seconds) {
  const [days, hours, minutes] = [seconds / 86400, (seconds / 3600) % 24, (seconds / 60) % 60].map(Math.floor);
  if (days > 0) return `${days} d ${hours} h`;
  if (hours > 0) return `${hours} h ${minutes} min`;
  return minutes > 0 ? `${minutes} min` : `${Math.floor(seconds)} s`;
}

function size(bytes) {
  const unit = Math.min(3, Math.floor(Math.log10(Math.max(bytes, 1)) / 3));
  return `${(bytes / 1000 ** unit).toFixed(unit ? 1 : 0)} ${["B", "kB", "MB", "GB"][unit]}`;
}

function tile(name, value, unit = "") {
  const number = value === null ? element("span", { class: "absent" }, "none yet") : value;
  const parts = value !== null && unit ? [number, " ", element("span", { class: "unit" }, unit)] : [number];
  return element("div", {}, element("dt", {}, name), element("dd", {}, ...parts));
}

const told = (value, words) => (value === null || value === undefined ? null : words(value));

function showTiles(state) {
  const heldOut = state.curves.held_out.at(-1);
  at("tiles").replaceChildren(
    tile("Time left", told(state.seconds_left, duration)),
    tile("Speed", told(state.samples_per_second, short), "samples/s"),
    tile("Stage", told(state.stage, (stage) => ((state.mix ?? 1) < 1 ? `${stage}, λ ${state.mix.toFixed(2)}` : `${stage}`))),
    tile("Learning rate", told(state.learning_rate, short)),
    tile("Loss", told(state.loss, short)),
    tile("PSNR in training", told(state.psnr, (psnr) => psnr.toFixed(2)), "dB"),
    tile("PSNR held out", told(heldOut, (point) => point[1].toFixed(2)), "dB"),
  );
}

function showProgress(state) {
  at("progress").value = state.steps ? state.step / state.steps : 0;
  const steps = state.steps ? `${whole(state.step)} of ${whole(state.steps)} steps` : `${whole(state.step)} steps`;
  const share = state.steps ? `, ${((100 * state.step) / state.steps).toFixed(1)} %` : "";
  const since = told(state.seconds_since, (seconds) => `; last heard of ${duration(seconds)} ago`) ?? "";
  at("progress-words").textContent = steps + share + since;
}

function showNotices(notices) {
  at("notices").hidden = notices.length === 0;
  const list = at("notices").querySelector("ul");
  // Said anew only when they are, or a screen reader would read them all day.
  if (list.textContent !== notices.join("")) list.replaceChildren(...notices.map((text) => element("li", {}, text)));
}

function showPictures(steps) {
  at("pictures").hidden = steps.length === 0;
  const shown = at("pictures").querySelector(".shown");
  if (shown.dataset.steps === steps.join()) return;
  shown.dataset.steps = steps.join();
  shown.replaceChildren(
    ...steps.map((step) =>
      element(
        "figure",
        {},
        element("figcaption", {}, `Step ${whole(step)}`),
        element("img", { src: `/picture/${step}.png`, alt: `Photo, target, picture, depth and opacity at step ${step}` }),
      ),
    ),
  );
}

function showCheckpoints(state) {
  const rows = [...state.checkpoints].reverse();
  if (state.best) rows.unshift(state.best);
  at("checkpoints").hidden = rows.length === 0;
  const cells = (kept) => [
    whole(kept.step),
    size(kept.bytes),
    duration(kept.age),
    kept.psnr === undefined ? "" : `${kept.psnr.toFixed(2)} dB`,
  ];
  at("checkpoints")
    .querySelector("tbody")
    .replaceChildren(
      ...rows.map((kept) =>
        element(
          "tr",
          kept === state.best ? { class: "measured" } : {},
          element("th", { scope: "row" }, element("code", {}, kept.name)),
          ...cells(kept).map((text) => element("td", { class: "number" }, text)),
        ),
      ),
    );
}

/** Round ticks that enclose the values. */
function ticks(low, high, count) {
  const span = Math.max(high - low, Math.abs(high) * 1e-3, 1e-9);
  const power = 10 ** Math.floor(Math.log10(span / count));
  const step = [1, 2, 5, 10].map((times) => times * power).find((tick) => span / tick <= count);
  const first = Math.floor(low / step);
  const last = Math.max(Math.ceil(high / step), first + 1);
  return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * step);
}

/** Plot of curves over the steps. A label shows the values under the pointer. */
class Plot {
  constructor(title, unit, lines) {
    Object.assign(this, { unit, lines, curves: [] });
    this.svg = drawn("svg", { viewBox: `0 0 ${SIZE.width} ${SIZE.height}`, role: "img", "aria-label": title });
    this.reading = element("p", { class: "reading" });
    const legend = lines.map(([name, colour]) => element("li", {}, element("span", { class: `swatch ${colour}` }), name));
    const parts = [element("figcaption", {}, title), this.svg, this.reading];
    if (lines.length > 1) parts.splice(1, 0, element("ul", { class: "legend" }, ...legend));
    at("plots").append(element("figure", { class: "plot" }, ...parts));
    this.svg.addEventListener("pointermove", (event) => this.read(event));
    this.svg.addEventListener("pointerleave", () => this.forget());
  }

  draw(curves) {
    const text = JSON.stringify(curves);
    if (text === this.drawn) return;
    this.drawn = text;
    this.curves = curves;
    this.svg.replaceChildren();
    const points = curves.flat();
    if (points.length === 0) {
      this.svg.append(drawn("text", { x: SIZE.width / 2, y: SIZE.height / 2, class: "middle" }, "nothing yet"));
      this.forget();
      return;
    }
    const values = points.map((point) => point[1]);
    // One step alone is still a place on the axis.
    const last = Math.max(1, ...points.map((point) => point[0]));
    const across = ticks(0, last, 4).filter((tick) => tick <= last && Number.isInteger(tick));
    const up = ticks(Math.min(...values), Math.max(...values), 5);
    const [low, high] = [up[0], up.at(-1)];
    this.x = (step) => SIZE.left + (step / last) * (SIZE.width - SIZE.left - SIZE.right);
    this.y = (value) => SIZE.height - SIZE.bottom - ((value - low) / (high - low)) * (SIZE.height - SIZE.top - SIZE.bottom);
    for (const tick of up) {
      const y = this.y(tick);
      this.svg.append(
        drawn("line", { class: "grid", x1: SIZE.left, x2: SIZE.width - SIZE.right, y1: y, y2: y }),
        drawn("text", { class: "end", x: SIZE.left - 8, y: y + 4 }, label(tick, up[1] - up[0])),
      );
    }
    const bottom = SIZE.height - SIZE.bottom;
    this.svg.append(drawn("line", { class: "axis", x1: SIZE.left, x2: SIZE.width - SIZE.right, y1: bottom, y2: bottom }));
    for (const tick of across) {
      const anchor = this.x(tick) > SIZE.width - 50 ? "end" : "middle";
      this.svg.append(drawn("text", { class: anchor, x: this.x(tick), y: bottom + 18 }, whole(tick)));
    }
    const middle = (SIZE.left + SIZE.width - SIZE.right) / 2;
    this.svg.append(drawn("text", { class: "middle title", x: middle, y: SIZE.height - 8 }, "Steps"));
    curves.forEach((curve, index) => {
      const colour = this.lines[index][1];
      const line = curve.map(([step, value]) => `${this.x(step).toFixed(1)},${this.y(value).toFixed(1)}`).join(" ");
      this.svg.append(drawn("polyline", { class: `line ${colour}`, points: line }));
      // A single point makes no line; validations are few enough to show each.
      if (curve.length < 60 && (curve.length === 1 || index > 0)) {
        for (const [step, value] of curve) {
          this.svg.append(drawn("circle", { class: `point ${colour}`, cx: this.x(step), cy: this.y(value), r: 4 }));
        }
      }
    });
    this.here = drawn("line", { class: "here", y1: SIZE.top, y2: bottom, visibility: "hidden" });
    this.svg.append(this.here);
    if (!this.isRead) this.forget();
  }

  tell(points, start) {
    const words = points.flatMap((point, index) =>
      point ? [`${this.lines[index][0]} ${short(point[1])}${this.unit && ` ${this.unit}`}${start ? "" : ` (step ${whole(point[0])})`}`] : [],
    );
    this.reading.textContent = start + words.join(", ");
  }

  read(event) {
    const points = this.curves.flat();
    if (points.length === 0) return;
    const area = this.svg.getBoundingClientRect();
    const x = ((event.clientX - area.left) / area.width) * SIZE.width;
    const nearest = (curve) => curve.reduce((a, b) => (Math.abs(this.x(b[0]) - x) < Math.abs(this.x(a[0]) - x) ? b : a));
    const found = this.curves.map((curve) => (curve.length ? nearest(curve) : null));
    const here = this.x(nearest(points)[0]);
    for (const end of ["x1", "x2"]) this.here.setAttribute(end, here);
    this.here.setAttribute("visibility", "visible");
    this.isRead = true;
    this.tell(found, "");
  }

  forget() {
    this.isRead = false;
    this.here?.setAttribute("visibility", "hidden");
    this.tell(this.curves.map((curve) => curve.at(-1)), this.curves.flat().length ? "now: " : "");
  }
}

const psnr = new Plot("PSNR", "dB", [["in training", "colour-1"], ["held out", "colour-2"]]);
const loss = new Plot("Loss", "", [["loss", "colour-3"]]);
const learningRate = new Plot("Learning rate", "", [["learning rate", "colour-4"]]);

function show(state) {
  const name = state.run.split(/[\\/]/).filter(Boolean).at(-1) ?? state.run;
  at("name").textContent = name;
  const share = state.steps ? `${Math.floor((100 * state.step) / state.steps)} % of ` : "";
  document.title = share + name;
  showProgress(state);
  showNotices(state.notices);
  showTiles(state);
  psnr.draw([state.curves.psnr, state.curves.held_out]);
  loss.draw([state.curves.loss]);
  learningRate.draw([state.curves.learning_rate]);
  showPictures(state.pictures);
  showCheckpoints(state);
  at("footer").textContent = `${state.run}, read every ${PAUSE / 1000} s by globalsplat watch.`;
}

/** Returns the run's current state, or an error if globalsplat watch doesn't answer. */
async function ask() {
  try {
    return await (await fetch("/state", { cache: "no-store" })).json();
  } catch {
    return { error: "globalsplat watch doesn't answer any more: what is shown is from before" };
  }
}

async function look() {
  const state = await ask();
  // The next request is scheduled before the state is shown, so that an exception in showing it doesn't end the updates.
  setTimeout(look, PAUSE);
  if (state.error) showNotices([state.error]);
  else show(state);
}

look();
