// The pages: what the server says, drawn. Text goes in as text, never as HTML.

import { curves, map, short, spark } from "./charts.js";
import { PointView } from "./points.js";

const EVERY_MS = 3000;
const main = document.getElementById("main"), pulse = document.getElementById("pulse"), nav = document.getElementById("scenes");

function h(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes))
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  made.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return made;
}

const card = (kind, title, small, ...children) =>
  h("section", { class: kind }, h("h2", {}, title, small ? h("small", {}, ` ${small}`) : null), ...children);

async function ask(address) {
  const answer = await fetch(address), document_ = await answer.json();
  if (!answer.ok) throw new Error(document_.error ?? answer.statusText);
  return document_;
}

function span(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 100) return `${Math.round(seconds)} s`;
  if (seconds < 5940) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${(seconds / 3600).toFixed(1)} h` : `${(seconds / 86400).toFixed(1)} days`;
}

const perTime = (rate) => (rate >= 1 ? `${rate.toFixed(1)} samples/s` : `${(60 * rate).toFixed(1)} samples/min`);
const count = (number) => number.toLocaleString("en");
const words = (name) => ({ a: "A", b: "B", mean: "mean of A and B" })[name] ?? name.replaceAll("_", " ");

// A place on the page: filled anew only if something else belongs there, so that what is in use stays as it is.
const places = Object.fromEntries(["progress", "workers", "wall", "training", "predictions", "maps"].map((name) => [name, h("div", { class: "place" })]));
function fill(where, ...nodes) {
  if (nodes.length !== where.children.length || nodes.some((node, i) => node !== where.children[i])) where.replaceChildren(...nodes);
}

// A command with a button that copies it; where the browser allows no page to do that, the button selects it.
function copyable(command) {
  const shown = h("code", {}, command);
  return [shown, " ", h("button", { onclick: async ({ target }) => {
    try { await navigator.clipboard.writeText(command); target.textContent = "Copied"; } catch { getSelection().selectAllChildren(shown); }
  } }, "Copy")];
}

function track(done, total, hand = 0) {
  const [bar, rest] = [h("i"), h("i", { class: "hand" })];
  bar.style.width = `${(100 * done) / (total || 1)}%`;
  rest.style.width = `${(100 * Math.min(done + hand, total)) / (total || 1)}%`;
  return h("div", { class: "track", role: "progressbar", "aria-valuenow": done, "aria-valuemax": total }, rest, bar);
}

// ---------------------------------------------------------------------------------------------------------- the farm

const rates = {}; // by scene, of every look since the page was opened

function progress(state) {
  const scenes = state.scenes.map((scene) => {
    if (scene.error) return h("p", { class: "note" }, `${scene.name} ${scene.scene_id}: cannot be read: ${scene.error}`);
    const facts = [
      scene.rate && scene.missing ? perTime(scene.rate) : null,
      scene.left_s !== null && scene.missing ? `${span(scene.left_s)} left` : scene.missing ? null : "complete",
      scene.jobs_planned ? `${count(scene.jobs_committed)}/${count(scene.jobs_planned)} jobs` : null,
      scene.passes[1] ? `${count(scene.passes[0])}/${count(scene.passes[1])} further passes` : null,
      scene.core_s ? `${span(scene.core_s)} of a core` : null,
      `${(scene.size_bytes / 1e6).toFixed(1)} MB`,
    ].filter(Boolean).join(" · ");
    const hand = scene.in_hand ? ` (+${scene.in_hand} in hand)` : "";
    return h("div", { class: "progress" },
      h("div", {}, h("span", {}, scene.name), h("span", { class: "figure" },
        h("b", {}, `${count(scene.samples[0])} of ${count(scene.samples[1])}`), ` samples${hand}`)),
      track(scene.samples[0], scene.samples[1], scene.in_hand), h("div", { class: "figure" }, facts));
  });
  const trainings = state.trainings.filter((run) => run.steps || run.step).map((run) => h("div", { class: "progress" },
    h("div", {}, h("span", {}, `training ${run.run}`), h("span", { class: "figure" },
      h("b", {}, run.step > run.steps ? count(run.step) : `${count(run.step)} of ${count(run.steps)}`),
      run.step > run.steps ? ` steps (${count(run.steps)} wanted)` : " steps")),
    track(Math.min(run.step, run.steps), run.steps),
    h("div", { class: "figure" }, (run.ended ? `ended (${run.ended})` : run.phase ?? "not at work") + run.figures)));
  const shown = rates[current]?.some((rate) => rate) ? [spark(rates[current], "samples per second"),
    h("p", { class: "note" }, "Throughput since this page was opened.")] : [];
  return card("half", "Progress", null, ...(scenes.length ? scenes : [h("p", { class: "note" }, "No scene is planned yet; ",
    "“photonfarm submit” or “photonfarm up” plans one.")]), ...trainings, ...shown);
}

function workers(state) {
  const list = state.workers.map((worker) => h("div", { class: "worker" }, h("span", {}, worker.name),
    worker.total ? track(worker.done, worker.total) : h("span", { class: "figure" }, "…"),
    h("span", { class: "figure" }, worker.total ? `${worker.done}/${worker.total}` : ""),
    h("span", { class: "figure" }, worker.phase)));
  const waits = state.waits.map((wait) => h("li", {}, wait));
  const failures = state.failed_before.map((failure) => h("li", { class: "bad" }, `before: ${failure}`));
  return card("half", "Queue and workers", null, h("p", { class: "figure" }, `queue: ${state.queue}`), ...list,
    waits.length + failures.length ? h("ul", { class: "plain" }, ...failures, ...waits) : null,
    list.length || waits.length || failures.length ? null : h("p", { class: "note" }, "Nothing waits for anything."));
}

const nothing = h("p", { class: "note" }, "None has landed yet.");
let wall = null; // the section of what landed last, kept so that only what is new is drawn

function drawWall(scene, rows) {
  if (!wall || wall.scene !== scene) {
    const grid = h("div", { class: "wall" });
    wall = { scene, grid, rows: new Map(), section: card("", "Samples as they land", "the latest first, with the spec's exposure", grid,
      h("form", { class: "controls", onsubmit: (event) => {
        event.preventDefault();
        location.hash = `#/sample/${scene}/${event.target.row.value}`;
      } }, h("label", {}, "open row ", h("input", { name: "row", type: "number", min: 0, value: 0, size: 8 })), h("button", {}, "open"))) };
  }
  const first = !wall.rows.size;
  for (const [row, element] of wall.rows) if (!rows.includes(row)) { element.remove(); wall.rows.delete(row); }
  for (const row of rows) {
    if (!wall.rows.has(row))
      wall.rows.set(row, h("a", { href: `#/sample/${scene}/${row}`, class: first ? "" : "new", onanimationend: (event) => event.currentTarget.classList.remove("new") },
        h("img", { src: `sample/${scene}/${row}/thumbnail.jpg`, alt: `sample in row ${row}`, width: 128, height: 128 }), h("span", {}, row)));
  }
  fill(wall.grid, ...(rows.length ? rows.map((row) => wall.rows.get(row)) : [nothing]));
  return wall.section;
}

function maps(scene, found) {
  const open = (row) => { location.hash = `#/sample/${scene}/${row}`; };
  const one = (title, place, unit) => {
    const dots = found.samples.filter((dot) => dot[place] !== null).map((dot) => [dot[0], dot[1], dot[2], dot[place]]);
    if (!dots.length) return h("p", { class: "note" }, "Nothing is known yet.");
    const values = dots.map(([, , , value]) => value).sort((a, b) => a - b);
    const [low, high] = [values[Math.floor(.02 * (values.length - 1))], values[Math.ceil(.98 * (values.length - 1))]];
    return h("div", {}, map(dots, found.axes, low, high, title, open), h("div", { class: "scale" }, `${short(low)}${unit}`, h("i"), `${short(high)}${unit}`));
  };
  return [card("half", "Noise", "by where the camera stands", one("noise by camera position", 3, ""),
    h("p", { class: "note" }, "Standard deviation of the mean of A and B over local brightness. Each dot is a sample; a click opens it.")),
  card("half", "Cost", "by where the camera stands", one("core-seconds by camera position", 4, " s"),
    h("p", { class: "note" }, "Core-seconds of a sample: an equal share of its job's."))];
}

function training(runs) {
  const held = (each) => `${count(each[5])} held-out view${each[5] === 1 ? "" : "s"}`;
  const by = (axis) => runs.map((run, place) => ({ place, points: run.validations.map((each) => [each[axis], each[2], each[3],
    { hollow: each[5] < run.validations.at(-1)[5], title: `step ${count(each[0])}: ${each[2].toFixed(5)} on ${held(each)}` }]) }));
  if (!runs.some((run) => run.validations.length)) return card("half", "Training", null, h("p", { class: "note" }, "No validation yet."));
  const every = runs.map((run) => run.steps_between).find(Boolean);
  const legend = runs.map((run, place) => {
    const last = run.validations.at(-1);
    return h("span", { class: `run-${place % 6}` }, last ? `${run.run}: ${last[2].toFixed(5)} at step ${count(last[0])}, on ${held(last)}` : run.run);
  });
  return card("half", "Training", "held-out error, noise removed; shaded: its standard error", curves(by(0), "step"),
    curves(by(1), "seconds, with waiting"), h("div", { class: "legend" }, ...legend),
    h("p", { class: "note" }, `Each point is a validation${every ? `, one every ${count(every)} steps` : ""}; hollow ones were measured on fewer held-out views than the last: the others had not been rendered. A pointer on a point tells how many.`));
}

const chosen = {}; // the step of each run that is shown; none: the last one

function predictions(runs) {
  return runs.map((run, place) => {
    if (!run.steps.length || !run.scene_id) return null;
    const last = run.steps.length - 1, at = chosen[place] === undefined ? last : Math.min(chosen[place], last);
    const caption = h("span", { class: "figure" }), picture = h("img", { class: "whole", alt: "predictions" });
    const show = (index) => {
      const step = run.steps[index], found = run.validations.filter(([each]) => each <= step).at(-1);
      picture.src = `run/${place}/${step}.png`;
      caption.textContent = `step ${count(step)}${found ? `, held-out error ${found[2].toFixed(5)}` : ""}`;
    };
    show(at);
    const references = h("div", { class: "pair" }, ...run.rows.map((row) => h("a", { href: `#/sample/${run.scene_id}/${row}` },
      h("img", { class: "whole", src: `sample/${run.scene_id}/${row}/reference.png`, alt: `reference of row ${row}`, title: `row ${row}` }))));
    references.style.setProperty("--columns", run.rows.length);
    return card("half", `Predictions of ${run.run}`, "of views that training never sees",
      references, h("p", { class: "note" }, "Above: the mean of all passes of these views. Below: what the network makes of them. ",
        ...copyable(run.live), " shows any other configuration beside its truth."), picture,
      h("div", { class: "controls" }, h("input", { type: "range", min: 0, max: last, value: at, "aria-label": "step", oninput: (event) => {
        chosen[place] = +event.target.value === last ? undefined : +event.target.value;
        show(+event.target.value);
      } }), caption));
  });
}

let current = null, held = null; // the scene that is shown; the predictions on the page

async function farm() {
  const [state, runs] = await Promise.all([ask("api/state"), ask("api/curves")]);
  const scenes = state.scenes.filter((scene) => !scene.error);
  const asked = location.hash.match(/^#\/scene\/([0-9a-f]{32})$/)?.[1];
  current = scenes.find((scene) => scene.scene_id === asked)?.scene_id ?? scenes.find((scene) => scene.missing)?.scene_id ?? scenes[0]?.scene_id ?? null;
  for (const scene of scenes) if (scene.rate !== null || !scene.missing) (rates[scene.scene_id] ??= []).push(scene.rate ?? 0);
  for (const values of Object.values(rates)) if (values.length > 600) values.shift();
  nav.replaceChildren(...(scenes.length > 1 ? scenes.map((scene) => h("a", { href: `#/scene/${scene.scene_id}`,
    "aria-current": scene.scene_id === current ? "page" : false }, scene.name)) : []));
  const found = current ? await ask(`api/wall/${current}`) : { rows: [], map: { axes: [], samples: [] } };
  const signature = JSON.stringify(runs.map((run) => [run.run, run.steps, run.rows]));
  if (held?.signature !== signature) held = { signature, cards: predictions(runs).filter(Boolean) };
  fill(places.progress, progress(state));
  fill(places.workers, workers(state));
  fill(places.wall, ...(current ? [drawWall(current, found.rows)] : []));
  fill(places.training, ...(runs.length ? [training(runs)] : []));
  fill(places.predictions, ...held.cards);
  fill(places.maps, ...(current ? maps(current, found.map) : []));
  fill(main, ...Object.values(places));
  return state;
}

// ----------------------------------------------------------------------------------------------------------- a sample

const numbers = (vector) => vector.map((value) => value.toFixed(3)).join(", ");

async function sample(scene, row) {
  const about = await ask(`api/sample/${scene}/${row}`), base = `sample/${scene}/${row}`;
  nav.replaceChildren();
  const go = (to, text) => (to === null ? null : h("a", { class: "button", href: `#/sample/${scene}/${to}` }, text));
  const pictures = [...about.images, ...(about.passes > 1 ? ["reference"] : [])].map((name) => {
    const figure = h("figure", { onclick: () => figure.classList.toggle("large") },
      h("img", { src: `${base}/${name}.png`, alt: words(name), width: about.size[0], height: about.size[1] }),
      h("figcaption", {}, name === "reference" ? `mean of ${about.passes} passes` : words(name)));
    return figure;
  });
  const said = h("p", { class: "note" });
  const canvas = h("canvas", { tabindex: 0, role: "img", "aria-label": "points and photons in three dimensions; arrow keys turn them" });
  const facts = [
    ["row", about.row], ["key", about.key], ["pass", `${about.pass}, of ${about.passes}`],
    ["samples per pixel", about.spp], ["noise", about.noise === null ? "the image is black" : `${(100 * about.noise).toFixed(1)} % of local brightness`],
    ["cost", about.core_s === null ? "not known" : `${about.core_s.toFixed(2)} core-seconds, its share of its job`],
    ["camera", numbers(about.origin)], ["looks at", numbers(about.target)], ["exposure", about.exposure],
    ...about.groups.map((group) => [group.name, group.present ? [`moved by ${numbers(group.moved)}`, ...(group.further ? [group.further] : [])].join(", ") : "removed"]),
  ];
  main.replaceChildren(
    h("section", {}, h("div", { class: "top" }, h("h2", {}, `${about.scene}, row ${about.row}`),
      go(about.previous, "← previous"), go(about.next, "next →"), h("a", { class: "button", href: `#/scene/${scene}` }, "farm")),
    h("div", { class: "pictures" }, ...pictures),
    h("p", { class: "note" }, `A and B are independent estimates of ${about.spp / 2} samples per pixel each. Radiance is shown as clip(${about.exposure} · I, 0, 1)^(1/2.2); in the noise map, bright is as noisy as light. A click enlarges.`)),
    card("most view3d", "Points and photons", null, canvas, h("div", { class: "controls" },
      ...["points", "photons"].map((name) => h("label", {}, h("input", { type: "checkbox", checked: true, onchange: (event) => {
        view.shown[name] = event.target.checked;
        view.draw();
      } }), name)),
      h("label", {}, h("input", { type: "checkbox", onchange: (event) => { view.onlySeen = event.target.checked; view.draw(); } }), "only what the view sees"),
      h("label", {}, h("input", { type: "checkbox", checked: true, onchange: (event) => { view.through = event.target.checked; view.draw(); } }), "walls from behind are left out"),
      h("button", { onclick: () => view.seeAsCamera() }, "as the camera"), h("button", { onclick: () => view.seeAll() }, "all of it")),
    said, h("p", { class: "note" }, "Drag turns, the wheel or two fingers zoom, Shift and drag slide. What the view does not see is dimmed.")),
    card("third", "Figures", null, h("table", {}, ...facts.map(([name, value]) => h("tr", {}, h("td", {}, name), h("td", {}, value))))));
  const view = new PointView(canvas, about);
  try {
    await Promise.all(["points", "photons"].map((name) => view.load(name, `${base}/${name}`)));
  } catch (error) {
    said.textContent = error.message;
  }
  view.seeAll();
}

// ------------------------------------------------------------------------------------------------------------ the loop

let at = null, timer = 0;

async function turn() {
  clearTimeout(timer);
  if (document.hidden) return; // nobody looks, so nothing is asked
  const opened = location.hash.match(/^#\/sample\/([0-9a-f]{32})\/(\d{1,12})$/), moved = at !== location.hash;
  try {
    if (opened && moved) await sample(opened[1], opened[2]);
    else if (!opened) await farm();
    pulse.textContent = opened ? "" : `live, ${new Date().toLocaleTimeString()}`;
    at = location.hash;
  } catch (error) {
    pulse.textContent = error instanceof TypeError ? "the server does not answer" : error.message;
    if (opened && moved) main.replaceChildren(h("section", {}, h("p", {}, error.message)));
    at = opened ? location.hash : at;
  }
  if (!opened) timer = setTimeout(turn, EVERY_MS);
}

addEventListener("hashchange", () => { scrollTo(0, 0); turn(); });
document.addEventListener("visibilitychange", turn);
turn();
