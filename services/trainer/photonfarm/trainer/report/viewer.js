// The large pictures of a report: two layers of a view with a divider between them, brightened, darkened and enlarged.
// Without it the page shows the same layers as rows of pictures.
"use strict";
(() => {
  const $ = (id) => document.getElementById(id);
  const views = [...document.querySelectorAll("details.view")];
  if (!views.length) return;
  const stage = $("stage"), canvas = stage.querySelector("canvas"), context = canvas.getContext("2d");
  const bar = $("bar"), split = $("split"), exposure = $("exposure"), sides = { left: $("left"), right: $("right") };
  const lights = JSON.parse($("light").textContent);
  const state = { view: 0, zoom: 1, x: 0.5, y: 0.5 }; // x, y: the middle of what is shown, as shares of the image
  const ZOOMS = [1, 2, 4, 8, 16];
  const light = new Map(), drawn = new Map(); // by view and layer

  // ------------------------------------------------------------------------------------------------------- layers

  const figure = (name) => views[state.view].querySelector(`figure[data-layer="${CSS.escape(name)}"]`);
  const picture = (name) => figure(name).querySelector("img");

  function fromHalf(bits) {
    const exponent = (bits >> 10) & 31, fraction = bits & 1023, sign = bits >> 15 ? -1 : 1;
    return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
  }

  function pixels(image) {
    const copy = document.createElement("canvas");
    Object.assign(copy, { width: image.naturalWidth, height: image.naturalHeight });
    copy.getContext("2d").drawImage(image, 0, 0);
    return copy.getContext("2d").getImageData(0, 0, copy.width, copy.height).data;
  }

  // Linear light of a layer, three values a pixel: its half floats, or else its picture, which is cut at white.
  function linear(name) {
    const key = `${state.view} ${name}`;
    if (!light.has(key)) {
      const text = lights[state.view][name];
      if (text) {
        const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
        light.set(key, Float32Array.from(new Uint16Array(bytes.buffer), fromHalf));
      } else {
        light.set(key, Float32Array.from(pixels(picture(name)).filter((_, i) => i % 4 < 3), (v) => (v / 255) ** 2.2));
      }
    }
    return light.get(key);
  }

  // What is drawn for a layer: light at the chosen exposure, all else as it is.
  function image(name) {
    const original = picture(name), key = `${state.view} ${name}`;
    if (!("light" in figure(name).dataset)) return original;
    if (drawn.get(key)?.exposure !== exposure.value) {
      drawn.set(key, { exposure: exposure.value, canvas: exposed(linear(name), original, 2 ** exposure.value) });
    }
    return drawn.get(key).canvas;
  }

  function exposed(values, { naturalWidth: width, naturalHeight: height }, factor) {
    const made = Object.assign(document.createElement("canvas"), { width, height });
    const shown = new ImageData(width, height);
    values.forEach((value, i) => {
      shown.data[i + Math.floor(i / 3)] = 255 * Math.min(Math.max(factor * value, 0), 1) ** (1 / 2.2);
    });
    for (let i = 3; i < shown.data.length; i += 4) shown.data[i] = 255;
    made.getContext("2d").putImageData(shown, 0, 0);
    return made;
  }

  // ------------------------------------------------------------------------------------------------------ drawing

  const part = () => ({ left: state.x - 0.5 / state.zoom, top: state.y - 0.5 / state.zoom, size: 1 / state.zoom });

  function draw() {
    const { naturalWidth, naturalHeight } = picture(sides.left.value);
    const width = Math.round(stage.clientWidth * devicePixelRatio);
    const height = Math.round((width * naturalHeight) / naturalWidth);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const seen = part(), at = (split.value / 100) * width;
    for (const [side, from, to] of [["left", 0, at], ["right", at, width]]) {
      const source = image(sides[side].value);
      const w = source.naturalWidth ?? source.width, h = source.naturalHeight ?? source.height;
      context.save();
      context.beginPath();
      context.rect(from, 0, to - from, height);
      context.clip();
      context.imageSmoothingEnabled = state.zoom === 1;
      context.imageSmoothingQuality = "high";
      context.drawImage(source, seen.left * w, seen.top * h, seen.size * w, seen.size * h, 0, 0, width, height);
      context.restore();
      stage.querySelector(`.side.${side}`).textContent = sides[side].value;
    }
    bar.style.left = `${split.value}%`;
    exposure.nextElementSibling.textContent = `${exposure.value > 0 ? "+" : ""}${Number(exposure.value)} EV`;
    $("zoom").textContent = `zoom × ${state.zoom}`;
    stage.classList.toggle("zoomed", state.zoom > 1);
  }

  // ------------------------------------------------------------------------------------------------ what is chosen

  function choose(side, name) {
    sides[side].value = name;
    views[state.view].querySelectorAll("figure").forEach((each) => {
      each.classList.toggle("on", [sides.left.value, sides.right.value].includes(each.dataset.layer));
    });
    draw();
  }

  function show(number) {
    state.view = number;
    views.forEach((view, i) => { view.open = i === number; });
    [...$("strip").children].forEach((button, i) => button.setAttribute("aria-pressed", i === number));
    const names = [...views[number].querySelectorAll("figure")].map((each) => each.dataset.layer);
    for (const [side, usual] of [["left", "prediction"], ["right", views[number].dataset.target]]) {
      const before = sides[side].value;
      sides[side].replaceChildren(...names.map((name) => new Option(name)));
      sides[side].value = names.includes(before) ? before : usual;
    }
    choose("left", sides.left.value);
  }

  function zoomTo(zoom, x = state.x, y = state.y) {
    const [low, high] = [0.5 / zoom, 1 - 0.5 / zoom];
    Object.assign(state, { zoom, x: Math.min(Math.max(x, low), high), y: Math.min(Math.max(y, low), high) });
    draw();
  }

  const step = (by) => zoomTo(ZOOMS[Math.min(Math.max(ZOOMS.indexOf(state.zoom) + by, 0), ZOOMS.length - 1)]);

  // ------------------------------------------------------------------------------------------------------ pointer

  // The place of an event in the image, as shares of it.
  function place(event) {
    const box = stage.getBoundingClientRect(), seen = part();
    return [seen.left + ((event.clientX - box.left) / box.width) * seen.size,
            seen.top + ((event.clientY - box.top) / box.height) * seen.size];
  }

  function values([x, y]) {
    const lines = Object.values(sides).filter((side) => "light" in figure(side.value).dataset).map((side) => {
      const { naturalWidth: w, naturalHeight: h } = picture(side.value);
      const column = Math.min(Math.floor(x * w), w - 1), row = Math.min(Math.floor(y * h), h - 1);
      const rgb = linear(side.value).subarray(3 * (row * w + column), 3 * (row * w + column) + 3);
      return `${side.value}, pixel (${column}, ${row}): ${[...rgb].map((v) => v.toPrecision(3)).join("  ")}`;
    });
    $("values").replaceChildren(...lines.flatMap((line) => [line, document.createElement("br")]));
  }

  let moving = null; // "divider", or the place that is dragged along

  function moveDivider(event) {
    const box = stage.getBoundingClientRect();
    split.value = (100 * (event.clientX - box.left)) / box.width;
    draw();
  }

  stage.addEventListener("pointerdown", (event) => {
    const box = stage.getBoundingClientRect();
    const near = Math.abs(event.clientX - box.left - (split.value / 100) * box.width) < 24;
    moving = state.zoom === 1 || near ? "divider" : place(event);
    stage.setPointerCapture(event.pointerId);
    if (moving === "divider") moveDivider(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (moving === "divider") moveDivider(event);
    else if (moving) {
      const [x, y] = place(event);
      zoomTo(state.zoom, state.x + moving[0] - x, state.y + moving[1] - y);
    }
    values(place(event));
  });
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => { moving = null; });
  stage.addEventListener("dblclick", (event) => zoomTo(state.zoom === 1 ? 4 : 1, ...place(event)));

  // ------------------------------------------------------------------------------------------------------ controls

  for (const side of Object.keys(sides)) sides[side].addEventListener("change", () => choose(side, sides[side].value));
  for (const control of [split, exposure]) control.addEventListener("input", draw);
  exposure.addEventListener("dblclick", () => { exposure.value = 0; draw(); });
  $("in").addEventListener("click", () => step(1));
  $("out").addEventListener("click", () => step(-1));
  $("fit").addEventListener("click", () => zoomTo(1));
  views.forEach((view, i) => {
    view.querySelectorAll("figure").forEach((each) => each.addEventListener("click", () => {
      choose("left", each.dataset.layer);
      stage.scrollIntoView({ block: "nearest", behavior: "smooth" });
    }));
    const button = document.createElement("button"), small = new Image();
    Object.assign(small, { src: view.querySelector('[data-layer="prediction"] img').src, alt: `view ${i + 1}` });
    Object.assign(button, { type: "button", title: view.querySelector("summary").textContent });
    button.append(small);
    button.addEventListener("click", () => show(i));
    $("strip").append(button);
  });

  // before the pictures are decoded there is nothing to draw, also where the window changes its size
  Promise.all([...document.querySelectorAll(".view img")].map((each) => each.decode())).then(() => {
    document.documentElement.classList.add("viewing");
    $("viewer").hidden = false;
    addEventListener("resize", draw);
    show(0);
  });
})();
