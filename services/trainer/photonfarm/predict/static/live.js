// The page of `photonfarm live`: it holds the configuration and the camera, asks for the network's picture of them,
// and, as soon as nothing moves any more, for the truth, which the server refines from one request to the next.

import { Plan } from "./plan.js";
import { listenToPointers } from "./pointers.js";

const REST_MS = 150; // without a change, after which the truth is rendered
const LOOK_MS = 1000; // without a request, after which one asks whether the server is still there
const WALK = .02; // of the room's size, a step

const $ = (id) => document.getElementById(id);
const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
const inDegrees = (value) => `${Math.round(value)}°`;
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

async function ask(path, more = {}) {
  const answer = await fetch(path, more).catch(() => null), told = await answer?.json().catch(() => null);
  if (!told) throw new Error("the server does not answer");
  if (!answer.ok) throw new Error(told.error);
  return told;
}

class Live {
  constructor(room) {
    Object.assign(this, { room, changed: performance.now(), answered: 0, dirty: true, seconds: [] });
    this.start();
    this.plan = new Plan($("plan"), this);
    this.listen($("network"));
    this.listGroups();
    this.listActions();
    $("about").textContent = `${room.name}: ${room.network}, ${room.film[0]} × ${room.film[1]}`;
  }

  start() {
    this.place = Object.fromEntries(this.room.groups.map((group) => [group.name, [...group.at]]));
    this.turn = Object.fromEntries(this.room.groups.map(({ name }) => [name, 0]));
    this.power = Object.fromEntries(this.room.groups.map(({ name }) => [name, 1]));
    this.without = new Set();
    this.camera = [...this.room.camera];
    this.target = [...this.room.look_at];
    this.fov = this.room.fov;
  }

  // What the server is asked about.
  state() {
    const said = { place: {}, without: [...this.without], camera: this.camera, look_at: this.target };
    const say = (key, name, value) => { (said[key] ??= {})[name] = value; };
    for (const { name, at, turn, power } of this.room.groups) {
      if (this.without.has(name)) continue;
      if (this.place[name].some((value, i) => value !== at[i])) say("place", name, this.place[name]);
      if (turn && this.turn[name]) say("turn", name, this.turn[name]);
      if (power && this.power[name] !== 1) say("power", name, this.power[name]);
    }
    return this.room.fov_range ? { ...said, fov: this.fov } : said;
  }

  address(state) {
    return btoa(JSON.stringify(state)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  }

  change() {
    this.changed = performance.now();
    this.dirty = true;
    this.age(true);
    this.say(""); // of what was shown before
    this.plan.draw();
  }

  // ------------------------------------------------------------------------------------------------------ pictures

  async run() {
    for (;;) {
      try {
        const rests = performance.now() - this.changed > REST_MS;
        if (this.dirty) await this.showNetwork(false);
        else if (rests && !this.isFull) await this.showNetwork(true);
        else if (rests && !document.hidden && !this.isDone) await this.showTruth();
        else if (!document.hidden && performance.now() - this.answered > LOOK_MS) await ask("room");
        else {
          await sleep(30);
          continue;
        }
        this.answered = performance.now();
        this.fail("");
      } catch (error) {
        this.fail(error.message);
        await sleep(500);
      }
    }
  }

  async showNetwork(isFull) {
    Object.assign(this, { dirty: false, isFull: false, isDone: false }); // it is asked for again if this fails
    const began = performance.now(), asked = this.state();
    const told = await ask(`${isFull ? "full" : "frame"}/${this.address(asked)}`);
    const image = await paint($("network"), told.picture);
    this.isFull = isFull;
    this.seconds = [...this.seconds.slice(-9), performance.now() - began];
    const mean = this.seconds.reduce((sum, value) => sum + value) / this.seconds.length;
    $("of-network").textContent = `network · ${told.ms.toFixed(0)} ms a frame, ${image.width} × ${image.height}`;
    $("pulse").textContent = `${(1000 / mean).toFixed(1)} frames a second`;
    $("doubts").textContent = told.warnings.join("\n");
  }

  async showTruth() {
    const told = await ask(`truth/${this.address(this.state())}`);
    if (this.dirty) return;
    await paint($("truth"), told.picture);
    this.age(false);
    this.isDone = told.done;
    $("of-truth").textContent = `truth · ${told.spp} samples per pixel, ${told.seconds.toFixed(1)} s`;
    $("error").textContent = `the network's ${told.error}`;
  }

  // The truth and what is said by it are of what is shown, or of what was shown before.
  age(isOld) {
    for (const id of ["truth", "of-truth", "error"]) $(id).classList.toggle("old", isOld);
  }

  // Why the last request failed, or "": what the network shows may be of before.
  fail(why) {
    if ($("failed").textContent === why) return; // else it would be read aloud again
    $("failed").textContent = why;
    $("pulse").hidden = why !== "";
    for (const id of ["network", "of-network"]) $(id).classList.toggle("old", why !== "");
  }

  say(sentence) {
    $("said").textContent = sentence;
  }

  // ------------------------------------------------------------------------------------------------------ camera

  axes() {
    const up = this.room.up, back = unit(add(this.camera, this.target, -1));
    const right = unit(cross(up, back));
    return { up, back, right, above: cross(back, right), distance: Math.hypot(...add(this.camera, this.target, -1)) };
  }

  orbit(dx, dy) {
    const { up, distance } = this.axes(), from = add(this.camera, this.target, -1);
    const side = unit(cross(Math.abs(up[0]) > .5 ? [0, 1, 0] : [1, 0, 0], up)), ahead = cross(up, side);
    const yaw = Math.atan2(dot(from, side), dot(from, ahead)) - dx / 180;
    const pitch = Math.min(1.5, Math.max(-1.5, Math.asin(dot(from, up) / distance) + dy / 180));
    const level = distance * Math.cos(pitch);
    this.camera = [0, 1, 2].map((i) => this.target[i] + level * (Math.cos(yaw) * ahead[i] + Math.sin(yaw) * side[i]) + distance * Math.sin(pitch) * up[i]);
    this.change();
  }

  slide(right, above, back) {
    const axes = this.axes();
    const by = [0, 1, 2].map((i) => right * axes.right[i] + above * axes.above[i] + back * axes.back[i]);
    this.camera = add(this.camera, by);
    this.target = add(this.target, by);
    this.change();
  }

  approach(factor) {
    const { back, distance } = this.axes();
    this.camera = add(this.target, back, Math.max(distance * factor, .05));
    this.change();
  }

  listen(canvas) {
    listenToPointers(canvas, {
      turn: (dx, dy) => this.orbit(dx, dy),
      slide: (dx, dy) => {
        const size = this.axes().distance / canvas.clientWidth;
        this.slide(-dx * size, dy * size, 0);
      },
      approach: (factor) => this.approach(factor),
    });
    canvas.addEventListener("keydown", (event) => {
      const step = WALK * Math.hypot(...add(this.room.high, this.room.low, -1));
      const by = { w: [0, 0, -step], s: [0, 0, step], a: [-step, 0, 0], d: [step, 0, 0], q: [0, -step, 0], e: [0, step, 0] }[event.key.toLowerCase()];
      if (!by || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      this.slide(...by);
    });
  }

  // ------------------------------------------------------------------------------------------------------ groups

  listGroups() {
    const height = 3 - this.room.across - this.room.down;
    $("groups").replaceChildren(...this.room.groups.map((group) => {
      const row = document.createElement("tr"), name = document.createElement("td"), there = document.createElement("td"), more = document.createElement("td");
      name.textContent = group.name;
      group.show = [];
      if (group.removable) {
        const box = Object.assign(document.createElement("input"), { type: "checkbox", ariaLabel: `${group.name} is there` });
        box.addEventListener("change", () => { this.without[box.checked ? "delete" : "add"](group.name); this.change(); });
        group.show.push(() => { box.checked = !this.without.has(group.name); });
        there.append(box, group.light ? " on" : " there");
      }
      const slide = (what, range, of, key, say) => {
        const { show, parts } = this.makeSlider(`${what} of ${group.name}`, range, () => of()[key], (value) => { of()[key] = value; }, say);
        group.show.push(show);
        const label = document.createElement("label");
        label.append(`${what} `, ...parts);
        more.append(label, " ");
      };
      const [min, max] = [group.box.min[height], group.box.max[height]];
      if (max > min) slide("height", { min, max }, () => this.place[group.name], height, (value) => value.toFixed(2));
      if (group.turn) slide("turn", group.turn, () => this.turn, group.name, inDegrees);
      if (group.power) slide("power", group.power, () => this.power, group.name, (value) => `× ${value.toFixed(2)}`);
      for (const show of group.show) show();
      row.hidden = !group.show.length; // what is only dragged
      row.append(name, there, more);
      return row;
    }));
  }

  // A slider with its value beside it, and what brings both to the value that is set.
  makeSlider(ariaLabel, range, get, set, say) {
    const slider = Object.assign(document.createElement("input"), { type: "range", ...range, step: "any", ariaLabel });
    const told = document.createElement("output");
    const show = () => { slider.value = get(); told.textContent = say(get()); };
    slider.addEventListener("input", () => { set(Number(slider.value)); show(); this.change(); });
    return { show, parts: [slider, " ", told] };
  }

  listActions() {
    const button = (text, act) => {
      const made = Object.assign(document.createElement("button"), { textContent: text });
      made.addEventListener("click", async () => {
        try { await act(made); } catch (error) { this.say(`${text}: ${error.message}`); }
      });
      $("actions").append(made);
    };
    const lens = this.makeSlider("field of view", this.room.fov_range ?? {}, () => this.fov, (value) => { this.fov = value; }, inDegrees);
    this.showLens = lens.show;
    if (this.room.fov_range) $("actions").append("field of view ", ...lens.parts);
    this.showLens();
    button("At rest", () => this.set(() => this.start()));
    button("Random", () => this.set(() => {
      const between = ({ min, max }) => min + Math.random() * (max - min);
      for (const { name, box, removable, turn, power } of this.room.groups) {
        this.place[name] = box.min.map((min, i) => between({ min, max: box.max[i] }));
        if (turn) this.turn[name] = between(turn);
        if (power) this.power[name] = between(power);
        this.without[removable && Math.random() < .2 ? "add" : "delete"](name);
      }
    }));
    button("Copy as a command", async () => {
      const { changed } = this, { command } = await ask(`command/${this.address(this.state())}`);
      let copied = "copied: ";
      try { await navigator.clipboard.writeText(command); } catch { copied = ""; }
      if (changed === this.changed) this.say(copied + command);
    });
    button("Record", (made) => this.record(made));
    if (this.room.may_submit) button("Render and train on this", async () => {
      const { said } = await ask(`submit/${this.address(this.state())}`, { method: "POST" });
      this.say(said);
    });
  }

  set(act) {
    act();
    for (const group of this.room.groups) for (const show of group.show) show();
    this.showLens();
    this.change();
  }

  // A clip of both pictures beside each other, until the button is pressed again.
  record(button) {
    if (this.recorder) { this.recorder.stop(); return; }
    const [wide, high] = [$("network").width, $("network").height], factor = Math.max(1, Math.round(480 / wide));
    const both = Object.assign(document.createElement("canvas"), { width: 2 * factor * wide, height: factor * high });
    const context = both.getContext("2d", { alpha: false }), parts = [];
    const draw = () => {
      context.imageSmoothingEnabled = false;
      context.globalAlpha = 1;
      context.clearRect(0, 0, both.width, both.height);
      context.drawImage($("network"), 0, 0, factor * wide, factor * high);
      context.globalAlpha = getComputedStyle($("truth")).opacity; // an old truth is as pale as on the page
      context.drawImage($("truth"), factor * wide, 0, factor * wide, factor * high);
    };
    const drawing = setInterval(draw, 40);
    this.recorder = new MediaRecorder(both.captureStream(25));
    this.recorder.addEventListener("dataavailable", (event) => parts.push(event.data));
    this.recorder.addEventListener("stop", () => {
      clearInterval(drawing);
      this.recorder = null;
      button.textContent = "Record";
      const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(new Blob(parts, { type: "video/webm" })), download: `${this.room.name}.webm` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    });
    this.recorder.start();
    button.textContent = "Stop and save";
  }
}

async function paint(canvas, base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const image = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
  if (canvas.width !== image.width || canvas.height !== image.height) Object.assign(canvas, { width: image.width, height: image.height });
  canvas.getContext("2d").drawImage(image, 0, 0);
  return canvas;
}

try {
  const live = (window.live = new Live(await ask("room"))); // for tests, and for who wants to know
  await live.plan.load();
  await live.run();
} catch (error) {
  $("pulse").textContent = error.message;
}
