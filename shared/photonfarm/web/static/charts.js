// Plots as SVG. Everything that is drawn comes in as arguments.

const SVG = "http://www.w3.org/2000/svg";

export function s(tag, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

const SHORT = new Intl.NumberFormat("en", { maximumSignificantDigits: 3, notation: "compact" });
export const short = (value) => (value !== 0 && Math.abs(value) < 1e-3 ? value.toExponential(0) : SHORT.format(value));

function ticks(low, high, count) {
  const rough = (high - low) / count || 1, size = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((each) => each * size).find((each) => each >= rough);
  const found = [];
  for (let at = Math.ceil(low / step) * step; at <= high + step / 1e6; at += step) found.push(at);
  return found;
}

function logTicks(low, high) {
  const found = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
    for (const digit of high > 300 * low ? [1] : [1, 2, 5]) if (digit * 10 ** power >= low && digit * 10 ** power <= high) found.push(digit * 10 ** power);
  return found;
}

// Lines of [x, y, error or null, {hollow, title}] with y on a logarithmic scale; `runs` are {place, points}.
export function curves(runs, label) {
  const wide = 640, high = 280, left = 58, right = 14, top = 12, bottom = 38;
  const plot = s("svg", { viewBox: `0 0 ${wide} ${high}`, class: "plot", role: "img", "aria-label": label });
  const all = runs.flatMap((run) => run.points).filter(([, y]) => y > 0);
  if (!all.length) return plot;
  const most = Math.max(1, ...all.map(([x]) => x));
  const ys = all.map(([, y]) => y).sort((a, b) => a - b);
  // a run that went astray once, and went back, would leave no room for the rest: its peak is cut off
  const low = ys[0] / 1.15, up = Math.min(ys.at(-1), 40 * ys[ys.length >> 1]) * 1.15;
  const X = (x) => left + (x / most) * (wide - left - right);
  const Y = (y) => top + (Math.log(up / Math.min(Math.max(y, low), up)) / Math.log(up / low)) * (high - top - bottom);
  for (const tick of ticks(0, most, 6)) {
    plot.append(s("line", { class: "grid", x1: X(tick), x2: X(tick), y1: top, y2: high - bottom }),
      s("text", { x: X(tick), y: high - bottom + 16, "text-anchor": "middle" }, short(tick)));
  }
  let marks = logTicks(low, up);
  if (marks.length < 2) marks = [low * 1.15, up / 1.15];
  for (const tick of marks)
    plot.append(s("line", { class: "grid", x1: left, x2: wide - right, y1: Y(tick), y2: Y(tick) }),
      s("text", { x: left - 6, y: Y(tick) + 4, "text-anchor": "end" }, short(tick)));
  plot.append(s("text", { x: (left + wide) / 2, y: high - 6, "text-anchor": "middle" }, label));
  for (const { place, points } of runs) {
    const there = points.filter(([, y]) => y > 0);
    const path = there.map(([x, y], i) => `${i ? "L" : "M"}${X(x).toFixed(1)} ${Y(y).toFixed(1)}`).join("");
    const edges = there.filter(([, , error]) => error);
    if (edges.length > 1) {
      const upper = edges.map(([x, y, error]) => `${X(x).toFixed(1)} ${Y(y + error).toFixed(1)}`);
      const lower = edges.map(([x, y, error]) => `${X(x).toFixed(1)} ${Y(y - error).toFixed(1)}`).reverse();
      plot.append(s("path", { class: `band run-${place % 6}`, d: `M${[...upper, ...lower].join("L")}Z` }));
    }
    plot.append(s("path", { class: `run run-${place % 6}`, d: path }));
    for (const [i, [x, y, , { hollow, title }]] of there.entries())
      plot.append(s("circle", { class: `run run-${place % 6}${hollow ? " hollow" : ""}`, cx: X(x).toFixed(1), cy: Y(y).toFixed(1),
        r: i === there.length - 1 ? 3.5 : there.length > 60 ? 1.6 : 2.6 }, s("title", {}, title)));
  }
  return plot;
}

const STOPS = [[59, 28, 107], [138, 39, 120], [217, 81, 78], [252, 166, 54], [247, 232, 122]];
function colour(share) {
  const place = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1), i = Math.min(Math.floor(place), STOPS.length - 2);
  return `rgb(${STOPS[i].map((low, c) => Math.round(low + (place - i) * (STOPS[i + 1][c] - low))).join(" ")})`;
}

// Where samples were seen from, coloured by a value: `dots` are [row, x, y, value].
export function map(dots, axes, low, high, title, open) {
  const size = 300, edge = 26;
  const xs = dots.map(([, x]) => x), ys = dots.map(([, , y]) => y);
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const scale = (size - 2 * edge) / Math.max(x1 - x0, y1 - y0, 1e-6);
  const wide = (x1 - x0) * scale + 2 * edge, tall = (y1 - y0) * scale + 2 * edge;
  const plot = s("svg", { viewBox: `0 0 ${wide.toFixed(0)} ${tall.toFixed(0)}`, class: "plot map", role: "img", "aria-label": title });
  plot.append(s("text", { x: wide / 2, y: tall - 4, "text-anchor": "middle" }, `${axes[0]}: ${short(x0)} … ${short(x1)}`),
    s("text", { x: 12, y: tall / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${tall / 2})` }, `${axes[1]}: ${short(y0)} … ${short(y1)}`));
  for (const [row, x, y, value] of dots) {
    const dot = s("circle", { cx: (edge + (x - x0) * scale).toFixed(1), cy: (edge + (y - y0) * scale).toFixed(1), r: 4.2,
      fill: colour((value - low) / (high - low || 1)), stroke: "#0006", "stroke-width": .6 });
    dot.append(s("title", {}, `row ${row}: ${short(value)}`));
    dot.addEventListener("click", () => open(row));
    plot.append(dot);
  }
  return plot;
}

// A small line of values over time, from 0.
export function spark(values, label) {
  const wide = 300, high = 46;
  const plot = s("svg", { viewBox: `0 0 ${wide} ${high}`, preserveAspectRatio: "none", class: "plot spark", role: "img", "aria-label": label });
  const most = Math.max(...values, 1e-9);
  const path = values.map((value, i) => `${i ? "L" : "M"}${((i / Math.max(values.length - 1, 1)) * wide).toFixed(1)} ${(high - 3 - (value / most) * (high - 8)).toFixed(1)}`);
  plot.append(s("path", { class: "run run-0", d: path.join(""), "vector-effect": "non-scaling-stroke" }));
  return plot;
}
