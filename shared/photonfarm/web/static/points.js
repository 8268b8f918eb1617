// Points in 3-D that a mouse or a finger turns, drawn by hand into an image: some ten thousand points need no more,
// and it works on every machine, also where a browser has no graphics card to itself.

import { listenToPointers } from "./pointers.js";

// The bytes of a point: position as three float32; colour, and whether it is seen, as four uint8; normal as three int8.
const SIZE = 20, FLOATS = SIZE / 4, COLOUR = 12, SEEN = 15, NORMAL = 16;

const sub = (a, b) => a.map((value, i) => value - b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));

// The middle 98 % of places along each axis: single points far away do not count.
function extent({ place, count }) {
  const sorted = [0, 1, 2].map((axis) => Float32Array.from({ length: count }, (_, i) => place[FLOATS * i + axis]).sort());
  const at = (share) => sorted.map((values) => values[Math.floor(share * (count - 1))] ?? 0);
  return [at(.01), at(.99)];
}

export class PointView {
  constructor(canvas, about) {
    Object.assign(this, { canvas, about, clouds: {}, shown: { points: true, photons: true }, onlySeen: false, through: true, waiting: false });
    this.up = about.up;
    // two axes across, so that yaw turns about `up`
    this.ahead = unit(cross(this.up, Math.abs(this.up[0]) > .5 ? [0, 1, 0] : [1, 0, 0]));
    this.side = cross(this.ahead, this.up);
    this.seeAsCamera();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  async load(name, address) {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error((await answer.json()).error);
    const bytes = await answer.arrayBuffer();
    const cloud = { place: new Float32Array(bytes), colour: new Uint8Array(bytes), normal: new Int8Array(bytes), count: bytes.byteLength / SIZE };
    [cloud.low, cloud.high] = extent(cloud);
    // some points lie on surfaces around all of it: so large, they nearly touch
    cloud.radius = (name === "points" ? .4 : .1) * Math.hypot(...sub(cloud.high, cloud.low)) / Math.sqrt(cloud.count || 1);
    this.clouds[name] = cloud;
    this.draw();
  }

  seeAsCamera() {
    this.middle = this.about.target;
    const back = sub(this.about.origin, this.about.target);
    this.distance = Math.hypot(...back) || 1;
    this.pitch = Math.asin(Math.min(1, Math.max(-1, dot(back, this.up) / this.distance)));
    this.yaw = Math.atan2(dot(back, this.side), dot(back, this.ahead));
    this.draw();
  }

  seeAll() {
    const cloud = this.clouds.points ?? this.clouds.photons;
    if (!cloud?.count) return;
    const { low, high } = cloud;
    this.middle = low.map((value, i) => (value + high[i]) / 2);
    this.distance = .58 * Math.hypot(...sub(high, low)) / Math.tan((this.about.fov_deg * Math.PI) / 360);
    this.yaw += .7;
    this.pitch = .6;
    this.draw();
  }

  listen() {
    const { canvas } = this;
    listenToPointers(canvas, {
      turn: (dx, dy) => {
        this.yaw -= dx / 180;
        this.pitch = Math.min(1.55, Math.max(-1.55, this.pitch + dy / 180));
        this.draw();
      },
      slide: (dx, dy) => { this.slide(dx, dy); this.draw(); },
      approach: (factor) => { this.distance *= factor; this.draw(); },
    });
    canvas.addEventListener("keydown", (event) => {
      const turn = { ArrowLeft: [.1, 0], ArrowRight: [-.1, 0], ArrowUp: [0, .1], ArrowDown: [0, -.1] }[event.key];
      if (turn) { this.yaw += turn[0]; this.pitch = Math.min(1.55, Math.max(-1.55, this.pitch + turn[1])); }
      else if (event.key === "+" || event.key === "-") this.distance *= event.key === "+" ? .9 : 1.1;
      else return;
      event.preventDefault();
      this.draw();
    });
  }

  slide(dx, dy) {
    const { right, down } = this.axes(), size = this.distance / this.canvas.clientWidth;
    this.middle = this.middle.map((value, i) => value - (right[i] * dx + down[i] * dy) * size);
  }

  axes() {
    const level = Math.cos(this.pitch);
    const back = [0, 1, 2].map((i) => level * (Math.cos(this.yaw) * this.ahead[i] + Math.sin(this.yaw) * this.side[i]) + Math.sin(this.pitch) * this.up[i]);
    const right = unit(cross(this.up, back)), down = cross(right, back);
    return { back, right, down, eye: this.middle.map((value, i) => value + this.distance * back[i]) };
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.paint(); });
  }

  paint() {
    const { canvas } = this, ratio = Math.min(devicePixelRatio || 1, 1.5);
    const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
    if (!wide || !high) return;
    if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
    const context = canvas.getContext("2d"), image = context.createImageData(wide, high);
    const pixels = new Uint32Array(image.data.buffer), near = new Float32Array(wide * high).fill(Infinity);
    pixels.fill(0xff130e0b);
    const axes = this.axes(), focal = .5 * wide / Math.tan((this.about.fov_deg * Math.PI) / 360);
    for (const name of ["points", "photons"])
      if (this.shown[name] && this.clouds[name]) this.splat(this.clouds[name], { pixels, near, wide, high, focal, ratio, ...axes });
    context.putImageData(image, 0, 0);
    this.paintCamera(context, { wide, high, focal, ...axes });
  }

  splat({ place, colour, normal, count, radius }, { pixels, near, wide, high, focal, ratio, eye, right, down, back }) {
    const least = this.distance * .02;
    for (let i = 0; i < count; i++) {
      const at = SIZE * i, seen = colour[at + SEEN];
      if (this.onlySeen && !seen) continue;
      const x = place[FLOATS * i] - eye[0], y = place[FLOATS * i + 1] - eye[1], z = place[FLOATS * i + 2] - eye[2];
      if (this.through && x * normal[at + NORMAL] + y * normal[at + NORMAL + 1] + z * normal[at + NORMAL + 2] > 0) continue;
      const depth = -(x * back[0] + y * back[1] + z * back[2]);
      if (depth < least) continue;
      const across = wide / 2 + (focal * (x * right[0] + y * right[1] + z * right[2])) / depth;
      const below = high / 2 + (focal * (x * down[0] + y * down[1] + z * down[2])) / depth;
      const r = Math.min(12 * ratio, Math.max(.8 * ratio, (focal * radius) / depth));
      const x0 = Math.max(0, Math.ceil(across - r)), x1 = Math.min(wide - 1, Math.floor(across + r));
      const y0 = Math.max(0, Math.ceil(below - r)), y1 = Math.min(high - 1, Math.floor(below + r));
      const dim = seen || this.onlySeen ? 1 : .5;
      const value = 0xff000000 | ((colour[at + COLOUR + 2] * dim) << 16) | ((colour[at + COLOUR + 1] * dim) << 8) | (colour[at + COLOUR] * dim);
      for (let row = y0; row <= y1; row++) {
        const over = r * r - (row - below) ** 2;
        for (let column = x0, pixel = row * wide + x0; column <= x1; column++, pixel++)
          if (depth < near[pixel] && (column - across) ** 2 <= over) { near[pixel] = depth; pixels[pixel] = value; }
      }
    }
  }

  // The sample's own camera, as a small pyramid.
  paintCamera(context, { wide, high, focal, eye, right, down, back }) {
    const { origin, target, up, fov_deg, size } = this.about;
    const forward = unit(sub(target, origin)), aside = unit(cross(forward, up)), under = cross(forward, aside);
    const long = .18 * Math.hypot(...sub(target, origin)), w = long * Math.tan((fov_deg * Math.PI) / 360), h = (w * size[1]) / size[0];
    const corners = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([a, b]) => origin.map((value, i) => value + long * forward[i] + a * aside[i] + b * under[i]));
    const seen = [origin, ...corners].map((point) => {
      const from = sub(point, eye), depth = -dot(from, back);
      return depth > this.distance * .02 ? [wide / 2 + (focal * dot(from, right)) / depth, high / 2 + (focal * dot(from, down)) / depth] : null;
    });
    if (seen.some((point) => !point)) return;
    context.strokeStyle = "#ffc35c";
    context.lineWidth = 1.5;
    context.beginPath();
    for (const corner of seen.slice(1)) { context.moveTo(...seen[0]); context.lineTo(...corner); }
    context.moveTo(...seen[4]);
    for (const corner of seen.slice(1)) context.lineTo(...corner);
    context.stroke();
  }
}
