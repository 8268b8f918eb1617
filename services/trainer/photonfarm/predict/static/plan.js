// The room from above: points of its surfaces, and what can be dragged.

const GRAB = 16; // px
const CAMERA = "#5fd39a";

export class Plan {
  constructor(canvas, live) {
    Object.assign(this, { canvas, live, held: null, pictures: null, waiting: false });
    const { across, down, up } = live.room;
    Object.assign(this, { across, down });
    // seen from above: rows go down the page or up, so that nothing is mirrored
    const height = 3 - across - down;
    this.sign = height === 1 ? up[1] : -up[height];
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  async load() {
    const load = async (name) => createImageBitmap(await (await fetch(`plan/${name}.png`)).blob());
    const groups = await Promise.all(this.live.room.groups.map((_, i) => load(i)));
    this.pictures = { still: await load("still"), groups };
    this.draw();
  }

  fit() {
    const { canvas, live } = this, ratio = Math.min(devicePixelRatio || 1, 2), { low, high } = live.room;
    const wide = Math.round(canvas.clientWidth * ratio), tall = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== wide || canvas.height !== tall) Object.assign(canvas, { width: wide, height: tall });
    const size = [high[this.across] - low[this.across], high[this.down] - low[this.down]];
    this.ratio = ratio;
    this.scale = .96 * Math.min(wide / size[0], tall / size[1]); // px of a scene unit
    this.middle = [(low[this.across] + high[this.across]) / 2, (low[this.down] + high[this.down]) / 2];
  }

  to(place) {
    return [
      this.canvas.width / 2 + this.scale * (place[this.across] - this.middle[0]),
      this.canvas.height / 2 + this.sign * this.scale * (place[this.down] - this.middle[1]),
    ];
  }

  // A place that is moved by pixels of the plan; its height stays.
  moved(place, dx, dy) {
    const by = [...place];
    by[this.across] += dx / this.scale;
    by[this.down] += (this.sign * dy) / this.scale;
    return by;
  }

  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.paint(); });
  }

  paint() {
    this.fit();
    const { canvas, live } = this, context = canvas.getContext("2d");
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (this.pictures) this.lay(context, this.pictures.still, live.room.low, live.room.low, 0);
    live.room.groups.forEach((group, i) => {
      const gone = live.without.has(group.name);
      context.globalAlpha = gone ? .2 : 1;
      if (this.pictures) this.lay(context, this.pictures.groups[i], group.at, live.place[group.name], live.turn[group.name]);
      context.globalAlpha = 1;
    });
    if (this.held) this.frame(context, this.held.box);
    this.paintCamera(context);
    const marks = live.room.groups.map(({ name, light }) => [this.to(live.place[name]), light ? "#ffc35c" : "#7cb0ff", live.without.has(name), name]);
    marks.push([this.to(live.camera), CAMERA, false, "camera"], [this.to(live.target), CAMERA, true, ""]);
    for (const mark of marks) this.mark(context, ...mark);
    const taken = marks.map(([[x, y]]) => [x - 6 * this.ratio, y + 4 * this.ratio, 12 * this.ratio]);
    for (const [at, , , text] of marks) this.write(context, at, text, taken);
  }

  // A picture of the plan's extent, so that the place `from` of it comes to `to`, turned about that.
  lay(context, picture, from, to, degrees) {
    const { low, high } = this.live.room, step = (high[this.across] - low[this.across]) / picture.width;
    context.save();
    context.translate(...this.to(to));
    context.rotate((-degrees * Math.PI) / 180);
    context.scale(this.scale * step, this.sign * this.scale * step);
    context.drawImage(picture, -(from[this.across] - low[this.across]) / step, -(from[this.down] - low[this.down]) / step);
    context.restore();
  }

  frame(context, { min, max }) {
    const [x0, y0] = this.to(min), [x1, y1] = this.to(max);
    context.setLineDash([6, 5]);
    context.strokeStyle = "#ffffffb0";
    context.lineWidth = 1.5 * this.ratio;
    context.strokeRect(Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0), Math.abs(y1 - y0));
    context.setLineDash([]);
  }

  mark(context, [x, y], colour, hollow) {
    context.beginPath();
    context.arc(x, y, 6 * this.ratio, 0, 7);
    context.lineWidth = 2 * this.ratio;
    context.strokeStyle = hollow ? colour : "#0b0e13";
    context.fillStyle = colour;
    if (!hollow) context.fill();
    context.stroke();
  }

  // A name beside its mark, on the first side where it covers nothing that is `taken`: [left, base line, width] of each.
  write(context, [x, y], text, taken) {
    context.font = `${12 * this.ratio}px system-ui, sans-serif`;
    context.strokeStyle = "#0b0e13";
    context.fillStyle = "#ffffff";
    context.lineWidth = 3 * this.ratio;
    const wide = context.measureText(text).width, side = 10 * this.ratio, base = y + 4 * this.ratio;
    const sides = [[x + side, base], [x - side - wide, base], [x - wide / 2, base - 15 * this.ratio], [x - wide / 2, base + 15 * this.ratio]];
    const isFree = ([left, line]) => left >= 0 && left + wide <= this.canvas.width
      && taken.every(([other, its, width]) => left + wide < other || other + width < left || Math.abs(line - its) >= 14 * this.ratio);
    const [left, line] = sides.find(isFree) ?? sides[0];
    taken.push([left, line, wide]);
    context.strokeText(text, left, line);
    context.fillText(text, left, line);
  }

  paintCamera(context) {
    const { camera, target, fov } = this.live, from = this.to(camera), to = this.to(target);
    const angle = Math.atan2(to[1] - from[1], to[0] - from[0]), half = (fov * Math.PI) / 360, long = 46 * this.ratio;
    context.beginPath();
    context.moveTo(...from);
    for (const side of [-half, half]) context.lineTo(from[0] + long * Math.cos(angle + side), from[1] + long * Math.sin(angle + side));
    context.closePath();
    context.fillStyle = `${CAMERA}50`;
    context.fill();
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.strokeStyle = `${CAMERA}80`;
    context.lineWidth = this.ratio;
    context.stroke();
  }

  // What lies under a pointer, the nearest first: groups before the camera, as these are smaller.
  find(x, y) {
    const { live } = this;
    const things = [
      ...live.room.groups.map(({ name, box }) => ({ box, at: live.place[name], put: (at) => { live.place[name] = at; } })),
      { box: live.room.camera_box, at: live.camera, put: (at) => { live.camera = at; } },
      { box: live.room.look_at_box, at: live.target, put: (at) => { live.target = at; } },
    ];
    const far = (thing) => { const [a, b] = this.to(thing.at); return Math.hypot(a - x, b - y); };
    const [nearest] = things.map((thing) => ({ ...thing, far: far(thing) })).sort((a, b) => a.far - b.far);
    return nearest.far <= GRAB * this.ratio ? nearest : null;
  }

  listen() {
    const { canvas, live } = this;
    const at = (event) => { const box = canvas.getBoundingClientRect(); return [(event.clientX - box.left) * this.ratio, (event.clientY - box.top) * this.ratio]; };
    canvas.addEventListener("pointerdown", (event) => {
      this.held = this.find(...at(event));
      this.last = at(event);
      if (!this.held) return;
      canvas.setPointerCapture(event.pointerId);
      this.draw();
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.held) { canvas.style.cursor = this.find(...at(event)) ? "grab" : "default"; return; }
      const [x, y] = at(event), by = [x - this.last[0], y - this.last[1]];
      this.last = [x, y];
      this.held.at = this.moved(this.held.at, ...by);
      const { at: place, box, put } = this.held;
      put(place.map((value, i) => Math.min(box.max[i], Math.max(box.min[i], value))));
      live.change();
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { this.held = null; this.draw(); });
  }
}
